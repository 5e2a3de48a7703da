"""A driver that speaks omni_msgs, for test_omni.py: in millimetres, force_feedback latched.

Its arm is a spring of 400 N/m at its tip. What it saw goes to standard output as JSON.
"""

import json
import threading
import time

import rclpy
from geometry_msgs.msg import PoseStamped, WrenchStamped
from omni_msgs.msg import OmniButtonEvent, OmniFeedback, OmniState
from sensor_msgs.msg import Joy

STIFFNESS = 400.0


def main():
    rclpy.init()
    node = rclpy.create_node('omni_driver')
    force, poses, buttons = [0.0], [], []
    node.create_subscription(
        OmniFeedback, 'phantom/force_feedback', lambda m: force.append(m.force.z), 10
    )
    node.create_subscription(PoseStamped, 'arm/measured_cp', poses.append, 10)
    node.create_subscription(Joy, 'arm/button', lambda m: buttons.append(list(m.buttons)), 10)
    state = node.create_publisher(OmniState, 'phantom/state', 10)
    event = node.create_publisher(OmniButtonEvent, 'phantom/button', 10)
    servo = node.create_publisher(WrenchStamped, 'arm/servo_cf', 10)
    spinner = threading.Thread(target=rclpy.spin, args=(node,), daemon=True)
    spinner.start()
    ends = (state, event, servo)
    deadline = time.monotonic() + 30
    while not all(end.get_subscription_count() for end in ends):
        assert time.monotonic() < deadline
        time.sleep(0.05)

    def drive(seconds, command):
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            stamp = node.get_clock().now().to_msg()
            message = OmniState()
            message.header.stamp = stamp
            message.pose.position.z = 1e3 * (0.05 + force[-1] / STIFFNESS)
            message.pose.orientation.w = 1.0
            state.publish(message)
            if command is not None:
                wrench = WrenchStamped()
                wrench.header.stamp = stamp
                wrench.wrench.force.y = command
                servo.publish(wrench)
            time.sleep(0.002)
        return force[-1]

    event.publish(OmniButtonEvent(grey_button=1))
    report = {'pushed': drive(0.6, 0.8), 'position': poses[-1].pose.position.z}
    report['silent'] = drive(0.4, None)
    report['buttons'] = buttons
    print(json.dumps(report), flush=True)
    rclpy.shutdown()
    spinner.join()


if __name__ == '__main__':
    main()
