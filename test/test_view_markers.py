"""Claims about the markers for RViz and Foxglove, decoded by the classes of their messages."""

import json
from pathlib import Path

import numpy as np
import pytest
from geometry_msgs.msg import Point
from meshes import box
from rclpy.serialization import deserialize_message
from ruamel.yaml import YAML
from scipy.spatial.transform import Rotation
from strokes import draw, mesh_of, method_named, straight
from visualization_msgs.msg import Marker, MarkerArray

from haptic_bridge.chain import TOUCHING
from haptic_bridge.settings import DeviceSettings
from tissue_sim.messages import mesh_message
from tissue_sim.replica import MeshReplica
from tissue_sim.ros import ARM, CONTACT, DIAGNOSTICS, FRAME, MARKERS
from viewer.frames import device_frame
from viewer.markers import Markers, shades, von_mises
from viewer.moment import Moment
from viewer.stage import METRES_A_NEWTON

CONFIG = Path(__file__).resolve().parents[1] / 'config'
LARGEST = 0.004
STAMP = 12_000_000_034
E, NU = 5400.0, 0.45
FORCE = np.array([0.3, -0.4, 1.2])


@pytest.fixture(scope='module')
def replica() -> MeshReplica:
    """A block that was cut, and bent."""
    mesh = mesh_of(*box((4, 3, 2), 0.01))
    path = straight((-0.005, 0.0151, 0.012), (0.025, 0.0151, 0.012), (0, 0, 0.02), 8)
    draw(method_named(), mesh, path)
    displacement = np.zeros_like(mesh.rest)
    displacement[:, 2] = -3 * mesh.rest[:, 0] ** 2
    replica = MeshReplica()
    replica.load(mesh_message(mesh, displacement, 'block', 3, 7, 0))
    assert (replica.triangle_kind == 1).any()
    return replica


@pytest.fixture(scope='module')
def moment() -> Moment:
    return Moment(
        tip=np.array([0.01, 0.02, 0.03]),
        turn=np.array([1.0, 0.0, 0.0, 0.0]),
        blade=np.array([[0.01, 0.02, 0.05], [0.01, 0.02, 0.026]]),
        proxy=np.array([0.01, 0.02, 0.034]),
        contact=TOUCHING,
        force=FORCE,
    )


def decoded(replica: MeshReplica, moment: Moment | None) -> dict[str, Marker]:
    data = Markers('tissue', 'displacement', LARGEST, E, NU).array(replica, moment, 0.004, STAMP)
    return {marker.ns: marker for marker in deserialize_message(data, MarkerArray).markers}


def xyz(points: list[Point]) -> np.ndarray:
    return np.array([(p.x, p.y, p.z) for p in points])


@pytest.mark.parametrize(('name', 'kind'), [('tissue', 0), ('cut', 1)])
def test_triangles_are_those_of_the_mesh_after_a_cut(replica, moment, name, kind):
    marker = decoded(replica, moment)[name]
    chosen = replica.triangles[replica.triangle_kind == kind]
    assert marker.type == Marker.TRIANGLE_LIST
    np.testing.assert_array_equal(xyz(marker.points).reshape(-1, 3, 3), replica.positions()[chosen])


def test_colour_of_the_tissue_is_its_displacement(replica, moment):
    marker = decoded(replica, moment)['tissue']
    corners = replica.triangles[replica.triangle_kind == 0].ravel()
    lengths = np.linalg.norm(replica.displacement[corners], axis=1)
    colours = np.array([(c.r, c.g, c.b, c.a) for c in marker.colors])
    np.testing.assert_array_equal(colours, shades(lengths / LARGEST))
    assert len(np.unique(colours, axis=0)) > 3
    assert (colours[:, 3] == 1).all()


def test_every_marker_is_in_the_frame_of_the_tissue_and_of_one_time(replica, moment):
    markers = decoded(replica, moment)
    assert set(markers) == {'tissue', 'cut', 'tool', 'proxy', 'force'}
    for marker in markers.values():
        assert marker.header.frame_id == 'tissue'
        assert (marker.header.stamp.sec, marker.header.stamp.nanosec) == (12, 34)
        assert marker.pose.orientation.w == 1.0
        assert marker.action == Marker.ADD


def test_tool_proxy_and_force_are_where_they_are(replica, moment):
    markers = decoded(replica, moment)
    np.testing.assert_array_equal(xyz(markers['tool'].points), moment.blade)
    place = markers['proxy'].pose.position
    assert (place.x, place.y, place.z) == tuple(moment.proxy)
    assert markers['proxy'].scale.x == markers['proxy'].scale.z == 0.008
    begin, end = xyz(markers['force'].points)
    np.testing.assert_allclose(begin, moment.tip)
    np.testing.assert_allclose(end - begin, METRES_A_NEWTON * FORCE)


def test_what_is_not_there_is_taken_from_the_screen(replica, moment):
    whole = MeshReplica()
    whole.load(mesh_message(mesh_of(*box((2, 2, 2), 0.01)), np.zeros((27, 3)), 'block', 0, 0, 0))
    markers = decoded(whole, moment._replace(force=np.zeros(3)))
    assert markers['cut'].action == markers['force'].action == Marker.DELETE
    assert set(decoded(whole, None)) == {'tissue', 'cut'}


def stretched(gradient: np.ndarray) -> MeshReplica:
    """A block under one deformation gradient."""
    mesh = mesh_of(*box((2, 2, 2), 0.01))
    replica = MeshReplica()
    displacement = mesh.rest @ (gradient - np.eye(3)).T
    replica.load(mesh_message(mesh, displacement, 'block', 0, 0, 0))
    return replica


def test_stress_of_uniaxial_tension_is_its_tension_and_of_a_rotation_none():
    small = 1e-4
    pulled = np.diag([1 + small, 1 - NU * small, 1 - NU * small])
    np.testing.assert_allclose(von_mises(stretched(pulled), E, NU), E * small, rtol=1e-3)
    turned = Rotation.from_euler('xyz', (40, 20, 70), degrees=True).as_matrix()
    assert von_mises(stretched(turned), E, NU).max() < 1e-9 * E
    np.testing.assert_allclose(von_mises(stretched(turned @ pulled), E, NU), E * small, rtol=1e-3)


def test_frame_of_the_device_maps_its_points_to_the_tissue():
    placed = {'translation': (0.1, -0.2, 0.3), 'rotation_rpy_deg': (90, 0, 30)}
    device = DeviceSettings.model_validate({'tissue_from_device': placed})
    message = device_frame(device)
    assert (message.header.frame_id, message.child_frame_id) == ('tissue', 'arm_base')
    to, q = message.transform.translation, message.transform.rotation
    point = np.array([0.01, 0.02, 0.03])
    mapped = np.add(Rotation.from_quat([q.x, q.y, q.z, q.w]).apply(point), (to.x, to.y, to.z))
    np.testing.assert_allclose(mapped, device.tissue_from_device.to_tissue(point), atol=1e-12)


def test_layouts_that_are_shipped_name_what_is_published():
    rviz = YAML(typ='safe').load(CONFIG / 'rviz' / 'trainer.rviz')['Visualization Manager']
    shown = {display['Name']: display for display in rviz['Displays']}
    markers = shown['Tissue and tool']
    assert rviz['Global Options']['Fixed Frame'] == FRAME
    assert markers['Topic']['Value'] == f'/{MARKERS}'
    assert set(markers['Namespaces']) == {'tissue', 'cut', 'tool', 'proxy', 'force'}
    layout = json.loads((CONFIG / 'foxglove' / 'trainer.json').read_text())['configById']
    scene = layout['3D!tissue']
    assert scene['followTf'] == FRAME
    topics = set(scene['topics'])
    for panel in layout.values():
        topics |= {path['value'].partition('.')[0] for path in panel.get('paths', [])}
    published = {f'/{MARKERS}', f'/{CONTACT}', f'/{ARM}/servo_cf', f'/{ARM}/measured_cp'}
    assert topics == published
    assert layout['DiagnosticSummary!nodes']['topicToRender'] == DIAGNOSTICS
