"""The page of a session and the files it can be exported to say what its bag says."""

import csv
import re
from pathlib import Path

import meshio
import numpy as np
import pytest
import trimesh
from meshes import box
from pyarrow import parquet as pq

from cutting_trainer.bags.errors import BagError
from cutting_trainer.bags.reader import open_bag
from cutting_trainer.bags.recorded_tissue import tissue_at
from cutting_trainer.bags.topic_names import FORCE, MESH, SERVO_CF
from cutting_trainer.node_common.cdr_codec import ForceSampleCodec
from cutting_trainer.recordings.export_command import export
from cutting_trainer.recordings.html_report import force_peaks, incision_area, write_report
from cutting_trainer.recordings.incision_metrics import (
    distance_to_paths,
    extent,
    planned_paths,
    surface_length,
)
from cutting_trainer.recordings.recorded_scene import restore_scene
from cutting_trainer.session.errors import SessionError
from cutting_trainer.session.scene_loader import load_scene
from cutting_trainer.tissue_sim.mesh.depth import SurfaceDepth
from cutting_trainer.tissue_sim.mesh.replica import MeshReplica
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh

pytestmark = pytest.mark.long

SAMPLES = Path(__file__).parents[1] / 'bags' / 'samples' / 'format_2'
CUT, PALPATION = SAMPLES / 'straight_cut', SAMPLES / 'palpation'


def block_of(kinds: np.ndarray | None = None) -> MeshReplica:
    """A block of 40 x 20 x 20 mm, as a replica."""
    nodes, tetrahedra = box((4, 2, 2), 0.01)
    mesh = TetMesh(nodes, tetrahedra)
    replica = MeshReplica()
    message = type('Message', (), {})()
    message.revision = message.topology = message.step = 0
    message.rest, message.displacement = nodes.ravel(), np.zeros(nodes.size)
    message.fixed = (nodes[:, 2] == 0).astype(np.uint8)
    message.tetrahedra, message.triangles = mesh.tetrahedra.ravel(), mesh.triangles.ravel()
    message.triangle_kind = mesh.triangle_kind if kinds is None else kinds
    replica.load(message)
    return replica


def test_the_length_of_an_incision_is_half_of_its_lips() -> None:
    whole = block_of()
    assert surface_length(whole) == 0.0
    end = whole.rest[whole.triangles][:, :, 0].max(axis=1) == 0.0  # one face, as if cut open
    opened = block_of(end.astype(np.uint8))
    assert surface_length(opened) == pytest.approx(0.5 * 4 * 0.02)


def test_depth_is_the_distance_of_the_blades_end_from_the_surface_that_it_enters() -> None:
    upright = np.array([[0.02, 0.01, 0.04], [0.02, 0.01, 0.017]])
    above, low, through = upright.copy(), upright.copy(), upright.copy()
    above[1, 2], low[1, 2], through[1, 2] = 0.025, 0.001, -0.004
    tilted = np.array([[0.0371, 0.0113, 0.03], [0.0171, 0.0133, 0.014]])
    within = np.array([[0.02, 0.01, 0.015], [0.02, 0.0115, 0.001]])
    from_below = np.array([[0.02, 0.01, -0.01], [0.02, 0.01, -0.004]])
    blades = np.array([upright, above, low, through, tilted, within, from_below])
    np.testing.assert_allclose(
        SurfaceDepth(block_of()).depths(blades),
        [0.003, 0.0, 0.019, 0.024, 0.006, 0.0085, 0.0],
        atol=1e-12,
    )


def test_depth_grows_with_the_way_of_a_blade_through_a_thin_sheet() -> None:
    ends = np.linspace(0.03, -0.01, 41)
    blades = np.tile([[0.013, 0.0071, 0.05], [0.013, 0.0071, 0.0]], (len(ends), 1, 1))
    blades[:, 1, 2] = ends
    depths = SurfaceDepth(block_of()).depths(blades)
    np.testing.assert_allclose(depths, np.maximum(0.02 - ends, 0.0), atol=1e-12)


def test_distance_to_the_plan_is_seen_from_above() -> None:
    way = np.array([[0.0, 0.0, 0.1], [0.1, 0.0, 0.0], [0.05, 0.0, 0.0]])
    assert extent(way) == pytest.approx(0.1)
    points = np.array([[0.05, 0.01, 0.3], [-0.03, 0.04, 0.0]])
    np.testing.assert_allclose(distance_to_paths(points, [way]), [0.01, 0.05])


def test_peaks_are_the_largest_of_their_half_second() -> None:
    times = np.linspace(0, 4, 4001)
    forces = np.column_stack([times, np.abs(np.sin(np.pi * times)) * (1 + 0.1 * times)])
    peaks = force_peaks(forces)
    assert np.round(np.sort(peaks[:, 0]) - 0.5).tolist() == [0, 1, 2, 3]
    assert (np.diff(peaks[:, 1]) < 0).all()
    assert len(force_peaks(np.zeros((0, 2)))) == 0


def test_the_plan_is_the_way_of_the_phases_that_cut(tmp_path: Path) -> None:
    scene = load_scene(str(restore_scene(open_bag(CUT), tmp_path)))
    (way,) = planned_paths(scene.arm.script)
    assert extent(way) == pytest.approx(0.026)
    scene = load_scene(str(restore_scene(open_bag(PALPATION), tmp_path)))
    assert planned_paths(scene.arm.script) == []


def test_a_page_is_one_file_with_the_figures_of_the_cut(tmp_path: Path) -> None:
    page = tmp_path / 'report.html'
    write_report(CUT, page)
    text = page.read_text()
    assert not re.search(r'(src|href)="(?!data:)', text)
    assert text.count('data:image/png;base64,') == 3
    plain = re.sub(r'<[^>]+>', '|', text)
    length = float(re.search(r'length of the incision[^|]*\|+([\d.]+)', plain)[1])
    planned = float(re.search(r'length of the planned lines[^|]*\|+([\d.]+)', plain)[1])
    assert planned == 26.0
    assert 0.5 * planned < length < 1.6 * planned
    area = float(re.search(r'area of the incision[^|]*\|+([\d.]+)', plain)[1])
    assert area == pytest.approx(incision_area(open_bag(CUT)) * 1e4, abs=0.006)
    assert 'lost: none' in plain


def test_a_page_of_a_session_without_a_cut_has_no_plan(tmp_path: Path) -> None:
    write_report(PALPATION, tmp_path / 'report.html')
    assert 'the scene has none' in (tmp_path / 'report.html').read_text()


def test_streams_are_exported_number_for_number(tmp_path: Path) -> None:
    files = export(PALPATION, tmp_path / 'csv', None)
    assert sorted(file.stem for file in files) == [
        *('arm_measured_cf', 'arm_measured_cp', 'arm_measured_cv', 'arm_servo_cf'),
        *('tissue_force', 'tool_contact'),
    ]
    with (tmp_path / 'csv' / 'tissue_force.csv').open() as file:
        rows = list(csv.DictReader(file))
    codec, bag = ForceSampleCodec(), open_bag(PALPATION)
    samples = [codec.decode(m.data) for m in bag.messages([FORCE])]
    assert [float(row['force_z']) for row in rows] == [
        s.values[codec.fields['force']][2] for s in samples
    ]
    assert [int(row['stamp_ns']) for row in rows] == [s.stamp_ns for s in samples]
    for table in export(PALPATION, tmp_path / 'parquet', None, parquet=True):
        read = pq.read_table(table)
        with (tmp_path / 'csv' / f'{table.stem}.csv').open() as lines:
            names, *texts = csv.reader(lines)
        assert read.column_names == names
        for column, name in zip(zip(*texts, strict=True), names, strict=True):
            got = read[name].to_numpy()
            exact = got.round(9) if name == 'time' else got
            assert exact.tolist() == [float(x) if got.dtype == float else int(x) for x in column]
    with (tmp_path / 'csv' / 'arm_servo_cf.csv').open() as file:
        assert sum(1 for _ in file) == 1 + sum(1 for _ in bag.messages([SERVO_CF]))


def test_the_exported_solid_is_the_tissue_of_the_moment(tmp_path: Path) -> None:
    bag = open_bag(CUT)
    start = next(iter(bag.messages())).log_time
    first = next(iter(bag.messages([MESH]))).log_time
    for file, at in (
        (tmp_path / 'begin.vtk', (first - start) * 1e-9),
        (tmp_path / 'end.vtu', None),
    ):
        export(CUT, file, at)
        mesh, tissue = meshio.read(file), tissue_at(bag, at)
        np.testing.assert_array_equal(mesh.points, tissue.positions())
        np.testing.assert_array_equal(mesh.cells_dict['tetra'], tissue.tetrahedra)
        np.testing.assert_array_equal(mesh.point_data['displacement'], tissue.displacement)
    assert tissue.topology > 0


@pytest.mark.parametrize('ending', ['ply', 'stl'])
def test_the_exported_surface_is_closed_and_holds_the_volume(tmp_path: Path, ending: str) -> None:
    file = tmp_path / f'surface.{ending}'
    export(PALPATION, file, None)
    surface = trimesh.load(file)
    tissue = tissue_at(open_bag(PALPATION))
    volume = TetMesh(tissue.positions(), tissue.tetrahedra).volumes().sum()
    assert surface.is_watertight
    assert surface.volume == pytest.approx(volume, rel=1e-3)


def test_outputs_that_cannot_be_are_refused_in_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(SessionError, match='a mesh file ends in'):
        export(CUT, tmp_path / 'mesh.obj', None)
    with pytest.raises(SessionError, match='does not exist'):
        export(CUT, tmp_path / 'none' / 'mesh.vtk', None)
    with pytest.raises(BagError, match='there is no tissue'):
        export(CUT, tmp_path / 'mesh.vtk', -1.0)
    with pytest.raises(SessionError, match=r'end its name in \.html'):
        write_report(CUT, tmp_path / 'report.pdf')
