"""Raises an alarm for each noise while it is on duty: a node with a lifecycle. It has no topics before it is configured, takes its time to
become active (`drowsy`, seconds), and does not while its post is closed."""

import os
import socket
import time

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from std_msgs.msg import String

from sentry_ros2.pictures import wait_for_subscriber

CLOSED = "/post/closed"


class Sentry(LifecycleNode):
    def __init__(self):
        super().__init__("sentry")
        self.declare_parameter("drowsy", 0.0)

    def on_configure(self, state):
        self.alarms = self.create_lifecycle_publisher(String, "alarm", 10)
        self.noises = self.create_subscription(String, "noise", self.hear, 10)
        return TransitionCallbackReturn.SUCCESS

    def on_activate(self, state):
        time.sleep(self.get_parameter("drowsy").value)
        if os.path.exists(CLOSED):
            self.get_logger().error("the post is closed")
            return TransitionCallbackReturn.FAILURE
        return super().on_activate(state)

    def on_cleanup(self, state):
        self.destroy_publisher(self.alarms)
        self.destroy_subscription(self.noises)
        return TransitionCallbackReturn.SUCCESS

    def hear(self, noise):
        # Goes nowhere while the node is not active.
        if self.alarms.is_activated:
            wait_for_subscriber(self.alarms)
        self.alarms.publish(String(data="%s heard by %s" % (noise.data, socket.gethostname())))


def main():
    rclpy.init()
    node = Sentry()
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    node.destroy_node()
    rclpy.try_shutdown()
