"""A PSM of a dVRK simulator and the master's driver, as their published sources have them.

Rebuilt from `dvrk_simulator_base` (its contract of CRTK, `ros_interface.py`, `ros_messages.py`) and
`dvrk_pybullet` (`node.py`); no package index has them. Kept to, in what the other side can see:

- every publisher is reliable, keep last 10; those of `operating_state` and `state` are latched too,
  with stamps that only grow;
- all states of a moment have one stamp, that of their publishing, and the frame of the camera,
  `ECM_view`, where there is one; `local/measured_cp` has that of the arm's base;
- `jaw/measured_js` has the one joint `jaw`, a velocity of zero, and no effort;
- 120 states a second from the simulator, as many poses (`dvrk_pybullet`: 100 unless it is set);
- no topic takes a force. The master's driver does, reliable and keep last 10 (`cisst_ros_crtk`).
"""

import threading
import time
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import JointState

from cutting_trainer.haptic_bridge.scene_schema import Transform
from cutting_trainer.node_common.operating_state import crtk_types
from cutting_trainer.node_common.orientation import quaternion

RATE = 120.0
SPEED = 0.02
"""[m/s] of the instrument."""
KEPT = QoSProfile(depth=10)
LATCHED = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class PsmWithMaster:
    """The PSM of a simulator, and the master that takes the force.

    Args:
        domain: of ROS.
        psm, master: namespaces.
        frame: where the tissue is in the frame of the poses.
        place: of the instrument's tip, tissue frame; its tool is upright.
    """

    def __init__(
        self, domain: int, psm: str, master: str, frame: Transform, place: tuple[float, ...]
    ) -> None:
        self.frame = frame
        self.place = self.goal = np.array(place)
        self.jaw = 1.0
        self.forces: list[tuple[int, np.ndarray]] = []
        self._context = rclpy.Context()
        rclpy.init(context=self._context, domain_id=domain)
        self.node = rclpy.create_node('simulator', context=self._context)
        make, types = self.node.create_publisher, crtk_types()
        self._pose = make(PoseStamped, f'{psm}/measured_cp', KEPT)
        self._local = make(PoseStamped, f'{psm}/local/measured_cp', KEPT)
        self._jaw = make(JointState, f'{psm}/jaw/measured_js', KEPT)
        self._state = make(types.operating_state, f'{psm}/operating_state', LATCHED)
        self.node.create_subscription(WrenchStamped, f'{master}/body/servo_cf', self._feel, KEPT)
        self._types = types
        self._announce('ENABLED')
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._stop = threading.Event()
        self._threads = [
            threading.Thread(target=self._executor.spin),
            threading.Thread(target=self._run),
        ]
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        self._stop.set()
        self._executor.shutdown()
        for thread in self._threads:
            thread.join()
        self.node.destroy_node()
        rclpy.shutdown(context=self._context)

    def felt(self) -> np.ndarray:
        """The newest force on the hand, in the tissue's axes."""
        return self.frame.rotation() @ self.forces[-1][1] if self.forces else np.zeros(3)

    def _feel(self, message: Any) -> None:
        force = message.wrench.force
        self.forces.append((time.time_ns(), np.array([force.x, force.y, force.z])))

    def _announce(self, state: str) -> None:
        message = self._types.operating_state(state=state, is_homed=True)
        message.header.stamp = self.node.get_clock().now().to_msg()
        message.header.frame_id = 'ECM_view'
        self._state.publish(message)

    def _run(self) -> None:
        due = time.monotonic()
        while not self._stop.is_set():
            way = self.goal - self.place
            step = SPEED / RATE
            self.place = self.place + way * min(step / max(np.linalg.norm(way), 1e-12), 1.0)
            self._publish()
            due = max(due + 1 / RATE, time.monotonic() - 1 / RATE)
            time.sleep(max(due - time.monotonic(), 0.0))

    def _publish(self) -> None:
        stamp = self.node.get_clock().now().to_msg()
        for publisher, frame_id in ((self._pose, 'ECM_view'), (self._local, 'PSM1_base')):
            message = PoseStamped()
            message.header.stamp, message.header.frame_id = stamp, frame_id
            at, turn = message.pose.position, message.pose.orientation
            at.x, at.y, at.z = map(float, self.frame.to_device(self.place))
            turn.x, turn.y, turn.z, turn.w = map(float, quaternion(self.frame.rotation().T))
            publisher.publish(message)
        jaw = JointState(name=['jaw'], position=[self.jaw], velocity=[0.0])
        jaw.header.stamp, jaw.header.frame_id = stamp, 'ECM_view'
        self._jaw.publish(jaw)
