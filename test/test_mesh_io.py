"""Meshes from files: what is read, what is mended, and one sentence for whatever cannot be used."""

import logging
from pathlib import Path

import meshio
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from meshes import box, irregular_box

from cutting_trainer.node_common.errors import MeshError
from cutting_trainer.tissue_sim.assembly import load_tissue
from cutting_trainer.tissue_sim.mesh.checks import (
    EDGES,
    _coincident,
    check_mesh,
    quality,
    select_fixed,
)
from cutting_trainer.tissue_sim.mesh.files import load_mesh
from cutting_trainer.tissue_sim.scene_schema import FixedRegion, MaterialSettings, TissueSettings

MESHES = Path(__file__).resolve().parents[1] / 'config' / 'meshes'
SHIPPED = sorted(MESHES.glob('*.msh'))
UNDERSIDE = FixedRegion.model_validate({'below': {'axis': 'z', 'value': 1e-4}})
NOWHERE = FixedRegion.model_validate({'below': {'axis': 'z', 'value': -1}})
EVERYWHERE = FixedRegion.model_validate({'below': {'axis': 'z', 'value': 1}})


def cube():
    nodes, tetrahedra = box((2, 2, 2), 0.02)
    return nodes, tetrahedra.astype(np.int32)


def volumes(nodes, tetrahedra):
    a, b, c, d = (nodes[tetrahedra[:, i]] for i in range(4))
    return np.einsum('ij,ij->i', np.cross(b - a, c - a), d - a) / 6


def surface_only(nodes, tetrahedra):
    return nodes, [('triangle', tetrahedra[:, :3])]


def second_order(nodes, tetrahedra):
    middles = np.tile(tetrahedra[:, :1], (1, 6))
    return nodes, [('tetra10', np.hstack((tetrahedra, middles)))]


def hexahedra(nodes, tetrahedra):
    return nodes, [('tetra', tetrahedra), ('hexahedron', np.arange(8)[None])]


BAD_CONTENTS = [
    ('surface without volume', surface_only, ['no tetrahedra', '48 triangle', 'mesher']),
    ('second order', second_order, ['48 tetra10', 'first order']),
    ('bricks', hexahedra, ['1 hexahedron', 'four-node tetrahedra']),
    ('lines', lambda nodes, t: (nodes, [('line', t[:, :2])]), ['no tetrahedra', '48 line']),
]


@pytest.mark.parametrize(
    ('make', 'parts'), [c[1:] for c in BAD_CONTENTS], ids=[c[0] for c in BAD_CONTENTS]
)
def test_a_file_of_other_cells_is_named_with_what_it_holds(tmp_path, make, parts):
    path = tmp_path / 'organ.vtk'
    meshio.Mesh(*make(*cube())).write(path)
    refused(path, parts)


BAD_FILES = [
    ('empty file', 'organ.msh', b'', ['cannot be read', 'export']),
    ('text', 'organ.msh', b'my organ\n', ['cannot be read', 'export']),
    ('cut short', 'organ.msh', SHIPPED[0].read_bytes()[:1500], ['cannot be read', 'export']),
    (
        'word for a coordinate',
        'organ.msh',
        SHIPPED[0].read_bytes().replace(b' -0.02 ', b' width ', 1),
        ['cannot be read', 'export'],
    ),
    ('unknown format', 'organ.xyz', b'0 0 0', ['cannot be read', 'export']),
    ('no extension', 'organ', b'0 0 0', ['cannot be read', 'export']),
    ('broken XML', 'organ.vtu', b'<VTKFile', ['cannot be read', 'export']),
    ('binary noise', 'organ.vtk', bytes(range(256)) * 4, ['cannot be read', 'export']),
]


@pytest.mark.parametrize(
    ('name', 'content', 'parts'), [f[1:] for f in BAD_FILES], ids=[f[0] for f in BAD_FILES]
)
def test_an_unreadable_file_is_refused_in_one_sentence(tmp_path, capfd, name, content, parts):
    path = tmp_path / name
    path.write_bytes(content)
    refused(path, parts)
    assert capfd.readouterr() == ('', '')


def test_a_missing_mesh_names_its_nearest_neighbour(tmp_path):
    (tmp_path / 'organ.msh').touch()
    refused(tmp_path / 'orgn.msh', ['did you mean organ.msh?'])
    refused(tmp_path, ['is a folder'])


def refused(path, parts):
    with pytest.raises(MeshError) as caught:
        load_mesh(path, 1.0)
    message = str(caught.value)
    assert str(path) in message
    assert '\n' not in message
    for part in parts:
        assert part in message


def node_is_nan(nodes, tetrahedra):
    nodes[3, 1] = np.nan
    return nodes, tetrahedra


def node_is_infinite(nodes, tetrahedra):
    nodes[3, 1] = np.inf
    return nodes, tetrahedra


def index_too_large(nodes, tetrahedra):
    tetrahedra[7, 2] = 27
    return nodes, tetrahedra


def index_negative(nodes, tetrahedra):
    tetrahedra[7, 2] = -1
    return nodes, tetrahedra


def node_twice_in_element(nodes, tetrahedra):
    tetrahedra[7, 2] = tetrahedra[7, 0]
    return nodes, tetrahedra


def element_twice(nodes, tetrahedra):
    return nodes, np.vstack((tetrahedra, tetrahedra[5, [1, 0, 3, 2]]))


def orphan(nodes, tetrahedra):
    return np.vstack((nodes, [[0.1, 0.0, 0.0]])), tetrahedra


def unmerged(nodes, tetrahedra):
    copies = np.vstack((nodes, nodes + np.array([0.04, 0, 0])))
    return copies, np.vstack((tetrahedra, tetrahedra + 27))


def flat_element(nodes, tetrahedra):
    extra = np.vstack((nodes, [[0.06, 0.02, 0.04]]))
    top = [np.flatnonzero((nodes == corner).all(axis=1))[0] for corner in TOP_TRIANGLE]
    return extra, np.vstack((tetrahedra, [*top, 27]))


TOP_TRIANGLE = np.array([[0.04, 0, 0.04], [0.04, 0.02, 0.04], [0.04, 0.04, 0.04]])


def third_on_a_face(nodes, tetrahedra):
    inner = np.flatnonzero((nodes[tetrahedra] == 0.02).all(axis=2).any(axis=1))[0]
    face = tetrahedra[inner][np.argsort(~(nodes[tetrahedra[inner]] == 0.02).all(axis=1))][:3]
    return np.vstack((nodes, [[0.1, 0.05, 0.03]])), np.vstack((tetrahedra, [*face, 27]))


def folded(nodes, tetrahedra):
    nodes[13] = [0.05, 0.05, 0.05]
    return nodes, tetrahedra


def joined_at_a_node(nodes, tetrahedra):
    more, elements = box((1, 1, 1), 0.02)
    return np.vstack((nodes, more[1:] + 0.04)), np.vstack(
        (tetrahedra, np.where(elements == 0, 26, elements + 26))
    )


def joined_at_an_edge(*_):
    """Two layers hold two columns apart that touch along one edge only."""
    nodes, tetrahedra = box((2, 2, 3), 0.01)
    x, y, z = nodes[tetrahedra].mean(axis=1).T // 0.01
    kept = tetrahedra[(z != 1) | (x == y)].astype(np.int32)
    return nodes, kept


BAD_MESHES = [
    ('NaN', node_is_nan, ['node 3', 'nan', 'finite']),
    ('infinite', node_is_infinite, ['node 3', 'inf', 'finite']),
    ('node number too large', index_too_large, ['tetrahedron 7', '27', '0 to 26']),
    ('node number negative', index_negative, ['tetrahedron 7', '-1', '0 to 26']),
    ('node twice in an element', node_twice_in_element, ['tetrahedron 7', 'twice', 'delete']),
    ('element twice', element_twice, ['tetrahedron 48', 'tetrahedron 5', 'delete']),
    ('orphan', orphan, ['node 27', '(0.1, 0, 0) m', 'in no tetrahedron', 'delete']),
    ('not merged', unmerged, ['nodes 18 and 27', '9 pairs in all', 'merge']),
    ('flat element', flat_element, ['tetrahedron 48', 'volume is 0', 'flat', 'optimise']),
    ('three elements on a face', third_on_a_face, ['face', 'more than two', '48', 'mesh']),
    ('folded', folded, ['same side', 'folded', 'mesh the solid again']),
    ('pinched node', joined_at_a_node, ['node 26', '2 parts', 'own nodes']),
    ('pinched edge', joined_at_an_edge, ['edge of the nodes [17, 18]', '2 parts', 'own nodes']),
    ('in millimetres', lambda n, t: (n * 1000, t), ['40 m', 'tissue.unit: mm', '0.04 m']),
    ('in centimetres', lambda n, t: (n * 100, t), ['4 m', 'tissue.unit: cm', '0.04 m']),
    ('scaled down', lambda n, t: (n / 1000, t), ['4e-05 m', 'tissue.unit: m']),
    ('two coordinates', lambda n, t: (n[:, :2], t), ['(27, 2)', '(n, 3)']),
    ('no elements', lambda n, t: (n, t[:0]), ['(0, 4)', 'm >= 1']),
    ('triangles', lambda n, t: (n, t[:, :3]), ['(48, 3)', '(m, 4)']),
]


@pytest.mark.parametrize(
    ('spoil', 'parts'), [m[1:] for m in BAD_MESHES], ids=[m[0] for m in BAD_MESHES]
)
def test_a_bad_mesh_gives_one_sentence_with_place_value_and_remedy(spoil, parts):
    nodes, tetrahedra = spoil(*cube())
    with pytest.raises(MeshError) as caught:
        check_mesh(nodes, tetrahedra)
    message = str(caught.value)
    assert '\n' not in message
    for part in parts:
        assert part in message


def two_cubes():
    nodes, tetrahedra = cube()
    return np.vstack((nodes, nodes + np.array([0, 0, 0.1]))), np.vstack(
        (tetrahedra, tetrahedra + 27)
    )


@pytest.mark.parametrize(
    ('mesh', 'region', 'parts'),
    [
        (cube, NOWHERE, ['tissue.fixed.0', 'no node', '(0, 0, 0) m to (0.04, 0.04, 0.04) m']),
        (cube, EVERYWHERE, ['all 27 nodes', 'smaller']),
        (two_cubes, UNDERSIDE, ['2 separate parts', 'node 27', '(0, 0, 0.1) m', 'tissue.fixed']),
    ],
)
def test_a_tissue_must_be_held_and_able_to_move(mesh, region, parts):
    with pytest.raises(MeshError) as caught:
        select_fixed(*mesh(), [region])
    for part in parts:
        assert part in str(caught.value)


def test_the_error_of_a_scene_names_the_mesh_file(tmp_path):
    path = tmp_path / 'organ.msh'
    nodes, tetrahedra = cube()
    write(path, nodes * 1000, tetrahedra)
    settings = TissueSettings(
        mesh=path, material=MaterialSettings(preset='liver_yi2007'), fixed=(UNDERSIDE,)
    )
    with pytest.raises(MeshError, match=f'^{path}: .*tissue.unit: mm'):
        load_tissue(settings)
    nodes, tetrahedra, fixed, _ = load_tissue(settings.model_copy(update={'unit': 'mm'}))
    assert np.ptp(nodes) == pytest.approx(0.04)
    assert fixed.sum() == 9


@given(st.integers(0, 2**32 - 1), st.sampled_from(['some', 'all']))
def test_inverted_elements_are_turned_over_and_nothing_else_changes(seed, which):
    nodes, good = irregular_box((2, 2, 2), 0.02, seed)
    good = good.astype(np.int32)
    turned = np.random.default_rng(seed).random(len(good)) < (0.5 if which == 'some' else 1.1)
    bad = np.where(turned[:, None], good[:, [1, 0, 2, 3]], good)
    mended = check_mesh(nodes, bad)
    assert (volumes(nodes, mended) > 0).all()
    np.testing.assert_array_equal(np.sort(mended), np.sort(good))
    np.testing.assert_array_equal(mended[~turned], good[~turned])


def test_turning_over_is_told(caplog):
    nodes, tetrahedra = cube()
    tetrahedra[:3] = tetrahedra[:3, [1, 0, 2, 3]]
    check_mesh(nodes, tetrahedra)
    assert '3 of 48 tetrahedra' in caplog.text


def test_nodes_without_tetrahedra_are_dropped_from_a_file_and_told(tmp_path, caplog):
    nodes, tetrahedra = cube()
    path = tmp_path / 'organ.vtu'
    padded = np.vstack(([[9.0, 9.0, 9.0]], nodes))
    meshio.Mesh(padded, [('tetra', tetrahedra + 1)]).write(path)
    read, elements = load_mesh(path, 1.0)
    np.testing.assert_array_equal(read, nodes)
    np.testing.assert_array_equal(elements, tetrahedra)
    assert '1 nodes belong to no tetrahedron' in caplog.text


def test_blocks_of_tetrahedra_become_one_and_surface_elements_are_ignored(tmp_path, caplog):
    nodes, tetrahedra = cube()
    path = tmp_path / 'organ.vtk'
    cells = [
        ('tetra', tetrahedra[:20]),
        ('triangle', tetrahedra[:4, :3]),
        ('tetra', tetrahedra[20:]),
    ]
    meshio.Mesh(nodes, cells).write(path)
    with caplog.at_level(logging.INFO):
        _, elements = load_mesh(path, 1.0)
    np.testing.assert_array_equal(elements, tetrahedra)
    assert "{'triangle': 4}" in caplog.text


@pytest.mark.parametrize('ending', ['msh', 'vtk', 'vtu', 'mesh', 'inp'])
def test_every_usual_format_gives_the_same_mesh(tmp_path, ending):
    nodes, tetrahedra = cube()
    path = tmp_path / f'organ.{ending}'
    meshio.Mesh(nodes * 1000, [('tetra', tetrahedra)]).write(path)
    read, elements = load_mesh(path, 1e-3)
    np.testing.assert_allclose(read, nodes, atol=1e-12)
    np.testing.assert_array_equal(elements, tetrahedra)
    assert (read.dtype, elements.dtype) == (np.float64, np.int32)


def write(path, nodes, tetrahedra, file_format='gmsh22'):
    mesh = meshio.Mesh(nodes, [('tetra', tetrahedra)])
    mesh.write(path, file_format=file_format, binary=False)


@pytest.mark.parametrize('file_format', ['gmsh22', 'gmsh'])
@pytest.mark.parametrize('shipped', SHIPPED, ids=lambda path: path.stem)
def test_a_shipped_mesh_survives_writing_and_reading(tmp_path, shipped, file_format):
    nodes, tetrahedra = load_mesh(shipped, 1.0)
    write(tmp_path / 'copy.msh', nodes, tetrahedra, file_format)
    again, elements = load_mesh(tmp_path / 'copy.msh', 1.0)
    np.testing.assert_array_equal(again, nodes)
    np.testing.assert_array_equal(elements, tetrahedra)


@pytest.mark.parametrize('shipped', SHIPPED, ids=lambda path: path.stem)
def test_a_shipped_mesh_needs_no_mending_and_stands_on_its_origin(shipped, caplog):
    nodes, tetrahedra = load_mesh(shipped, 1.0)
    np.testing.assert_array_equal(check_mesh(nodes, tetrahedra), tetrahedra)
    assert caplog.text == ''
    underside = nodes[nodes[:, 2] < 1e-6]
    assert len(underside) > 20
    np.testing.assert_allclose(underside.min(axis=0) + underside.max(axis=0), 0, atol=1e-6)
    assert nodes[:, 2].min() == 0


def test_the_block_is_that_of_the_thesis():
    nodes, tetrahedra = load_mesh(MESHES / 'block_yi2007.msh', 1.0)
    assert (len(nodes), len(tetrahedra)) == (50, 96)
    np.testing.assert_allclose(np.ptp(nodes, axis=0), [0.04, 0.04, 0.01])


def test_the_organ_is_well_shaped():
    nodes, tetrahedra = load_mesh(MESHES / 'liver.msh', 1.0)
    measured = quality(nodes, tetrahedra)
    edges = nodes[tetrahedra][:, EDGES]
    assert 3500 <= len(tetrahedra) <= 5000
    assert np.ptp(nodes, axis=0) == pytest.approx([0.14, 0.09, 0.045], abs=0.003)
    assert np.linalg.norm(edges[:, :, 0] - edges[:, :, 1], axis=2).mean() < 0.010
    assert measured.dihedral.min() > 18
    assert measured.altitude.min() > 0.002
    assert measured.radius_ratio.min() > 0.2
    assert (MESHES / 'liver.msh').stat().st_size < 500_000


@given(st.floats(0.01, 100), st.integers(0, 2**32 - 1))
def test_quality_of_a_regular_tetrahedron_is_one_whatever_its_size_and_place(size, seed):
    corners = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) * size
    turn, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    turn *= np.linalg.det(turn)
    measured = quality(corners @ turn.T + size, np.array([[0, 2, 1, 3]], np.int32))
    assert measured.radius_ratio[0] == pytest.approx(1)
    assert measured.dihedral[0] == pytest.approx(np.degrees(np.arccos(1 / 3)))
    assert measured.altitude[0] == pytest.approx(4 / np.sqrt(3) * size)


def test_quality_of_a_corner_tetrahedron_is_the_textbooks():
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
    measured = quality(corners, np.array([[0, 1, 2, 3]], np.int32))
    inradius, circumradius = 1 / (3 + np.sqrt(3)), np.sqrt(3) / 2
    assert measured.radius_ratio[0] == pytest.approx(3 * inradius / circumradius)
    assert measured.dihedral[0] == pytest.approx(np.degrees(np.arccos(1 / np.sqrt(3))))
    assert measured.altitude[0] == pytest.approx(1 / np.sqrt(3))


@given(st.integers(2, 8), st.integers(0, 2**32 - 1), st.booleans())
def test_nodes_that_coincide_are_found_however_many_lie_in_a_plane(side, seed, regular):
    source = np.random.default_rng(seed)
    places = np.indices((side,) * 3).reshape(3, -1).T / side
    nodes = places if regular else source.random((side**3, 3))
    again = source.integers(0, len(nodes), 4)
    nodes = np.concatenate([nodes, nodes[again] + source.uniform(-6e-10, 6e-10, (4, 3))])
    distances = np.linalg.norm(nodes[:, None] - nodes[None], axis=2)
    wanted = np.argwhere(np.triu(distances <= 1e-9, 1))
    assert set(map(tuple, _coincident(nodes, 1e-9).tolist())) == set(map(tuple, wanted.tolist()))
