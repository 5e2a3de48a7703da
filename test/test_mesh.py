"""Connectivity, tensors and replica stay those of a mesh built anew, whatever is changed."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from meshes import irregular_box

from cutting_trainer.node_common.errors import MeshError
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.elasticity.models import ElasticModel
from cutting_trainer.tissue_sim.mesh.replica import MeshReplica, state_hash
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh, TopologyDelta
from cutting_trainer.tissue_sim.mesh.topology import CUT, OUTER

MATERIAL = Material(5000.0, 0.45, 1000.0)


def faces(mesh: TetMesh) -> dict[tuple[int, ...], int]:
    count: dict[tuple[int, ...], int] = {}
    for tet in mesh.tetrahedra.tolist():
        for i in range(4):
            key = tuple(sorted(tet[:i] + tet[i + 1 :]))
            count[key] = count.get(key, 0) + 1
    return count


def assert_consistent(mesh: TetMesh) -> None:
    """The incremental connectivity equals what the tetrahedra alone say."""
    count = faces(mesh)
    assert max(count.values(), default=0) <= 2
    surface = [tuple(sorted(t)) for t in mesh.triangles.tolist()]
    assert sorted(surface) == sorted(key for key, number in count.items() if number == 1)
    for t, row in enumerate(mesh.neighbors.tolist()):
        for i, face in enumerate(row):
            if face >= 0:
                assert mesh.neighbors[face // 4, face % 4] == 4 * t + i
                ours = set(mesh.tetrahedra[t]) - {mesh.tetrahedra[t, i]}
                theirs = set(mesh.tetrahedra[face // 4]) - {mesh.tetrahedra[face // 4, face % 4]}
                assert ours == theirs
    stars = [sorted(mesh.star(node)) for node in range(mesh.node_count)]
    expected = [
        np.flatnonzero((mesh.tetrahedra == node).any(axis=1)).tolist()
        for node in range(mesh.node_count)
    ]
    assert stars == expected
    assert all(stars)
    if len(mesh.triangles):
        corners = mesh.rest[mesh.triangles]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        enclosed = np.einsum('ij,ij->', corners[:, 0], normals) / 6
        assert enclosed == pytest.approx(mesh.volumes().sum(), rel=1e-12)


def assert_tensors_equal_a_rebuild(model: ElasticModel) -> None:
    fresh = ElasticModel(model.mesh, MATERIAL)
    ours, theirs = model.dense(), fresh.dense()
    np.testing.assert_allclose(ours, theirs, atol=1e-12 * np.abs(theirs).max())
    np.testing.assert_allclose(model.mass, fresh.mass, rtol=1e-12)


def split_by_centroid(mesh: TetMesh, tet: int) -> TopologyDelta:
    nodes = mesh.tetrahedra[tet].astype(np.int64)
    children = np.tile(nodes, (4, 1))
    children[np.arange(4), np.arange(4)] = mesh.node_count
    return TopologyDelta(
        node_parents=nodes[None],
        node_weights=np.full((1, 4), 0.25),
        removed_tetrahedra=np.array([tet]),
        tetrahedra=children,
        outer_faces=np.array([1, 2, 4, 8], np.uint8),
    )


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 1000), st.lists(st.tuples(st.booleans(), st.integers(0, 10**6)), max_size=8))
def test_every_change_leaves_connectivity_surface_and_tensors_as_built_anew(
    seed: int, changes: list[tuple[bool, int]]
) -> None:
    mesh = TetMesh(*irregular_box((2, 2, 2), 0.01, seed))
    model = ElasticModel(mesh, MATERIAL)
    for removal, number in changes:
        m = len(mesh.tetrahedra)
        if m < 8:
            break
        if removal:
            gone = np.unique(np.random.default_rng(number).integers(0, m, 3))
            delta = TopologyDelta(removed_tetrahedra=gone)
        else:
            delta = split_by_centroid(mesh, number % m)
        before = mesh.volumes()
        removed = before[delta.removed_tetrahedra].sum() if removal else 0.0
        touched = mesh.apply(delta)
        assert mesh.volumes().sum() == pytest.approx(before.sum() - removed, rel=1e-12)
        model.update(touched)
        assert_consistent(mesh)
        assert_tensors_equal_a_rebuild(model)


def test_where_a_node_slides_all_tensors_around_it_follow() -> None:
    mesh = TetMesh(*irregular_box((2, 2, 2), 0.01, 3))
    model = ElasticModel(mesh, MATERIAL)
    inner = int(np.argmin(np.linalg.norm(mesh.rest - 0.01, axis=1)))
    tet = mesh.tetrahedra[mesh.star(inner)[0]].astype(np.int64)
    other = int(tet[tet != inner][0])
    delta = TopologyDelta(
        moved_nodes=np.array([inner]),
        moved_parents=np.array([[inner, other, inner, inner]]),
        moved_weights=np.array([[0.8, 0.2, 0, 0]]),
    )
    volume = mesh.volumes().sum()
    model.update(mesh.apply(delta))
    assert mesh.volumes().sum() == pytest.approx(volume, rel=1e-12)
    assert_tensors_equal_a_rebuild(model)


@pytest.mark.parametrize('count', [1, 40])
def test_all_nodes_around_a_node_that_slides_are_touched(count: int) -> None:
    nodes, tets = irregular_box((2, 2, 2), 0.01, 1, 0.1)
    tets = tets[:count]
    for node in np.unique(tets):
        mesh = TetMesh(nodes, tets)
        delta = TopologyDelta(
            moved_nodes=np.array([node]),
            moved_parents=np.full((1, 4), node),
            moved_weights=np.array([[1.0, 0.0, 0.0, 0.0]]),
        )
        around = np.unique(tets[(tets == node).any(axis=1)])
        assert np.array_equal(mesh.apply(delta).nodes, around), node


def test_a_split_inside_leaves_the_surface_and_its_kind() -> None:
    mesh = TetMesh(*irregular_box((2, 2, 2), 0.01, 1))
    before = {tuple(sorted(t)) for t in mesh.triangles.tolist()}
    for tet in range(0, 40, 7):
        mesh.apply(split_by_centroid(mesh, tet))
    assert {tuple(sorted(t)) for t in mesh.triangles.tolist()} == before
    assert (mesh.triangle_kind == OUTER).all()


def test_what_a_removal_opens_is_cut_surface() -> None:
    mesh = TetMesh(*irregular_box((2, 2, 2), 0.01, 1))
    before = {tuple(sorted(t)) for t in mesh.triangles.tolist()}
    mesh.apply(TopologyDelta(removed_tetrahedra=np.array([3, 17])))
    for triangle, kind in zip(mesh.triangles.tolist(), mesh.triangle_kind, strict=True):
        assert kind == (OUTER if tuple(sorted(triangle)) in before else CUT)


def test_a_copy_of_fixed_nodes_is_fixed_and_a_point_between_is_fixed_only_if_all_are() -> None:
    nodes, tets = irregular_box((1, 1, 1), 0.01, 1)
    fixed = np.zeros(len(nodes), np.uint8)
    fixed[tets[0, :2]] = 1
    a, b, c, _ = (int(i) for i in tets[0])
    mesh = TetMesh(nodes, tets, fixed)
    base = split_by_centroid(mesh, 0)
    delta = TopologyDelta(
        node_parents=np.concatenate(
            [base.node_parents, [[a, a, a, a], [a, b, a, a], [b, c, b, b]]]
        ),
        node_weights=np.concatenate(
            [base.node_weights, [[1, 0, 0, 0], [0.5, 0.5, 0, 0], [0.5, 0.5, 0, 0]]]
        ),
        removed_tetrahedra=base.removed_tetrahedra,
        tetrahedra=base.tetrahedra,
        outer_faces=base.outer_faces,
    )
    mesh._interpolate_nodes(delta, np.zeros(0, np.int64))
    assert mesh.fixed[len(nodes) :].tolist() == [0, 1, 1, 0]


@pytest.mark.parametrize(
    ('delta', 'word'),
    [
        (TopologyDelta(removed_tetrahedra=np.array([10**6])), 'removed_tetrahedra'),
        (TopologyDelta(removed_tetrahedra=np.array([-1])), 'removed_tetrahedra'),
        (
            TopologyDelta(tetrahedra=np.array([[0, 1, 2, 999]]), outer_faces=np.zeros(1, np.uint8)),
            'tetrahedra',
        ),
    ],
)
def test_an_index_out_of_range_is_refused_by_name_and_changes_nothing(
    delta: TopologyDelta, word: str
) -> None:
    mesh = TetMesh(*irregular_box((1, 1, 1), 0.01, 1))
    before = mesh.tetrahedra.copy()
    with pytest.raises(MeshError, match=word):
        mesh.apply(delta)
    assert np.array_equal(mesh.tetrahedra, before)


def as_message(mesh: TetMesh, displacement: np.ndarray, revision: int) -> SimpleNamespace:
    return SimpleNamespace(
        rest=mesh.rest.ravel(),
        displacement=displacement.ravel(),
        fixed=mesh.fixed.copy(),
        tetrahedra=mesh.tetrahedra.ravel().copy(),
        triangles=mesh.triangles.ravel().copy(),
        triangle_kind=mesh.triangle_kind.copy(),
        revision=revision,
        topology=mesh.topology,
        step=0,
    )


def test_a_replica_that_follows_the_deltas_has_the_same_bits() -> None:
    messages = pytest.importorskip('cutting_trainer.tissue_sim.streaming.messages')
    rng = np.random.default_rng(0)
    mesh = TetMesh(*irregular_box((2, 2, 2), 0.01, 3))
    u = np.zeros_like(mesh.rest)
    replica = MeshReplica()
    replica.load(as_message(mesh, u, 0))
    encoder = messages.DeltaEncoder(mesh, u)
    for number in range(12):
        touched = None
        if number % 3 == 1:
            gone = np.unique(rng.integers(0, len(mesh.tetrahedra), 2))
            touched = mesh.apply(TopologyDelta(removed_tetrahedra=gone))
        elif number % 3 == 2:
            touched = mesh.apply(split_by_centroid(mesh, int(rng.integers(len(mesh.tetrahedra)))))
        u = rng.normal(size=mesh.rest.shape) * 1e-3
        if number == 6:
            u = np.zeros_like(mesh.rest)
            u[: mesh.node_count // 3] = 1.0
        delta = encoder.encode(u, number, 0, touched, number)
        assert replica.apply(delta)
        assert replica.hash() == state_hash(mesh.rest, u, mesh.tetrahedra)
        assert np.array_equal(replica.triangles, mesh.triangles)
        assert np.array_equal(replica.triangle_kind, mesh.triangle_kind)
    assert encoder.encode(u, 99, 0, None, 0) is None


def test_of_a_large_tissue_only_the_whole_mesh_carries_a_hash(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    messages = pytest.importorskip(
        'cutting_trainer.tissue_sim.streaming.messages', reason='needs ROS'
    )
    mesh = TetMesh(*irregular_box((2, 2, 2), 0.01, 3))
    u = np.zeros_like(mesh.rest)
    replica = MeshReplica()
    replica.load(as_message(mesh, u, 0))
    encoder = messages.DeltaEncoder(mesh, u)
    for most in (len(mesh.tetrahedra), 10):
        monkeypatch.setattr(messages, '_MAX_HASHED_TETRAHEDRA', most)
        touched = mesh.apply(TopologyDelta(removed_tetrahedra=np.array([0])))
        delta = encoder.encode(u, 1, 0, touched, 1)
        assert replica.apply(delta)
        assert delta.state_hash == (replica.hash() if most > 10 else 0)
    assert messages.mesh_message(mesh, u, '', 2, 1, 0).state_hash == replica.hash()


def test_a_replica_refuses_a_delta_of_another_base_and_passes_over_an_old_one() -> None:
    mesh = TetMesh(*irregular_box((1, 1, 1), 0.01, 3))
    replica = MeshReplica()
    replica.load(as_message(mesh, np.zeros_like(mesh.rest), 5))
    delta = SimpleNamespace(revision=8, base_revision=7)
    assert not replica.apply(delta)
    assert replica.revision == 5
    assert replica.apply(SimpleNamespace(revision=5, base_revision=4))
