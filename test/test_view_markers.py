"""Claims about the markers for RViz and Foxglove, decoded by the classes of their messages."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import trimesh
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point
from meshes import box
from numpy.testing import assert_allclose
from rclpy.serialization import deserialize_message
from scipy.spatial.transform import Rotation
from strokes import draw, mesh_of, method_named, straight
from visualization_msgs.msg import Marker, MarkerArray

from cutting_trainer.haptic_bridge.force_kernels import TOUCHING
from cutting_trainer.haptic_bridge.scene_schema import DeviceSettings, ToolSettings, Vector
from cutting_trainer.node_common import ros
from cutting_trainer.node_common.orientation import from_quaternion
from cutting_trainer.node_common.qos import LATCHED
from cutting_trainer.node_common.ros import STATIC_FRAMES
from cutting_trainer.tissue_sim.mesh.replica import MeshReplica
from cutting_trainer.tissue_sim.streaming.messages import mesh_message
from cutting_trainer.viewer import tf_frames
from cutting_trainer.viewer.appearance import METRES_PER_NEWTON, blade, handle
from cutting_trainer.viewer.markers import CUT_COLOUR, Colouring, Markers, shades, von_mises
from cutting_trainer.viewer.tf_frames import StaticFrames, device_frame, publishing_command
from cutting_trainer.viewer.tool_state import Moment

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
        orientation=np.array([1.0, 0.0, 0.0, 0.0]),
        blade=np.array([[0.01, 0.02, 0.05], [0.01, 0.02, 0.026]]),
        proxy=np.array([0.01, 0.02, 0.034]),
        contact=TOUCHING,
        force=FORCE,
    )


def decoded(
    replica: MeshReplica,
    moment: Moment | None,
    colouring: Colouring = 'displacement',
    largest: float = LARGEST,
) -> dict[str, Marker]:
    data = Markers('tissue', colouring, largest, E, NU).array(replica, moment, 0.004, STAMP)
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


def test_colour_of_the_tissue_is_its_stress_where_that_is_asked_for(replica, moment):
    corners = replica.triangles[replica.triangle_kind == 0].ravel()
    stress = von_mises(replica, E, NU)[corners]
    for largest, last in ((1000.0, 1000.0), (0.0, E / 10)):
        marker = decoded(replica, moment, 'von_mises', largest)['tissue']
        colours = np.array([(c.r, c.g, c.b, c.a) for c in marker.colors])
        np.testing.assert_array_equal(colours, shades(stress / last))
        assert len(np.unique(colours, axis=0)) > 3


def test_cut_surface_has_one_colour_of_its_own(replica, moment):
    markers = decoded(replica, moment)
    assert not markers['cut'].colors and len(markers['cut'].points) > 0
    cut = markers['cut'].color
    assert (cut.r, cut.g, cut.b, cut.a) == pytest.approx(CUT_COLOUR)


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
    np.testing.assert_allclose(end - begin, METRES_PER_NEWTON * FORCE)


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


class Talker:
    """A node, as far as static frames need one."""

    def __init__(self) -> None:
        self.published: list[Any] = []
        self.said: list[str] = []

    def get_logger(self) -> Any:
        return SimpleNamespace(info=self.said.append)

    def get_clock(self) -> Any:
        return SimpleNamespace(now=lambda: SimpleNamespace(to_msg=Time))

    def create_publisher(self, kind: Any, topic: str, qos: Any) -> Any:
        assert (topic, qos) == (STATIC_FRAMES, LATCHED)
        return SimpleNamespace(publish=lambda message: self.published.append(message.transforms))


def placed(x: float) -> DeviceSettings:
    return DeviceSettings.model_validate({'tissue_from_device': {'translation': (x, 0.0, 0.06)}})


def test_static_frames_are_those_of_the_drivers_poses_and_of_the_scene_that_runs(monkeypatch):
    monkeypatch.setattr(tf_frames, 'TFMessage', SimpleNamespace)
    talker: Any = Talker()
    static = StaticFrames(talker, placed(0.0))
    for name in ('arm_base', 'tissue', '', 'MTML_base', 'MTML_base'):
        static.add_frame(name)
    static.place(placed(0.1))
    said = [
        [(t.header.frame_id, t.child_frame_id, t.transform.translation.x) for t in transforms]
        for transforms in talker.published
    ]
    assert said[0] == [('tissue', 'arm_base', 0.0)]
    both = [[('MTML_base', 'tissue', -x), ('tissue', 'arm_base', x)] for x in (0.0, 0.1)]
    assert said[1:] == both


def test_the_tissue_is_below_the_frame_of_a_driver_where_it_is_above_our_own():
    turned = {'translation': (0.1, 0.0, 0.06), 'rotation_rpy_deg': (0.0, 0.0, 90.0)}
    device = DeviceSettings.model_validate({'tissue_from_device': turned})
    matrices = {}
    for name in ('arm_base', 'ECM_view'):
        frame = device_frame(device, name)
        to, q = frame.transform.translation, frame.transform.rotation
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = from_quaternion(np.array([q.x, q.y, q.z, q.w])), vector(to)
        matrices[frame.header.frame_id, frame.child_frame_id] = matrix
    inverse = np.linalg.inv(matrices['ECM_view', 'tissue'])
    assert_allclose(matrices['tissue', 'arm_base'], inverse, atol=1e-12)


def vector(xyz: Any) -> list[float]:
    return [xyz.x, xyz.y, xyz.z]


def test_two_trainers_in_one_domain_share_no_topic_but_the_diagnostics():
    topics = {v for k, v in vars(ros).items() if k.isupper() and isinstance(v, str)}
    assert STATIC_FRAMES in topics
    assert {topic for topic in topics if topic.startswith('/')} == {'/diagnostics'}


def test_frames_that_another_node_owns_get_no_second_parent(monkeypatch):
    for kind in (SimpleNamespace, None):
        monkeypatch.setattr(tf_frames, 'TFMessage', kind)
        talker: Any = Talker()
        static = StaticFrames(talker, placed(0.0), publish=False)
        static.add_frame('MTML_base')
        static.place(placed(0.1))
        assert not talker.published and not talker.said


def test_without_tf2_msgs_the_viewer_says_what_publishes_the_frame(monkeypatch):
    monkeypatch.setattr(tf_frames, 'TFMessage', None)
    talker: Any = Talker()
    StaticFrames(talker, placed(0.1)).add_frame('MTML_base')
    (said,) = talker.said
    assert said.endswith(publishing_command(device_frame(placed(0.1))))
    words = said[said.index('ros2 run tf2_ros static_transform_publisher') :].split()
    given = dict(zip(words[4::2], words[5::2], strict=True))
    assert given == {
        **{'--x': '0.1', '--y': '0', '--z': '0.06'},
        **{'--qx': '0', '--qy': '0', '--qz': '0', '--qw': '1'},
        **{'--frame-id': 'tissue', '--child-frame-id': 'arm_base'},
    }


@pytest.mark.parametrize(
    ('root', 'tip'),
    [
        ((0.0, 0.0, 0.02), (0.0, 0.0, -0.004)),
        ((0.01, 0.0, 0.0), (-0.02, 0.003, 0.0)),
        ((0.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
    ],
)
def test_blade_and_handle_are_closed_solids_with_their_faces_outward(
    root: Vector, tip: Vector
) -> None:
    tool = ToolSettings(blade_root=root, blade_tip=tip)
    for corners, triangles in (blade(tool), handle(tool)):
        solid = trimesh.Trimesh(corners, triangles)
        assert solid.is_volume
        assert solid.is_convex
        assert solid.volume > 0
    length = float(np.linalg.norm(np.subtract(root, tip)))
    mean = length - 0.005 * 2 / 3  # of its three edges: the spine's two end earlier
    assert trimesh.Trimesh(*blade(tool)).volume == pytest.approx(0.005 * 0.0008 / 2 * mean)
    middle = np.array(root) + 0.035 * np.subtract(root, tip) / length
    assert_allclose(trimesh.Trimesh(*handle(tool)).center_mass, middle, atol=1e-9)
