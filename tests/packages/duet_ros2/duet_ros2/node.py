"""Two nodes in one program: each says its name once a second."""

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import String


class Voice(Node):
    def __init__(self, name):
        super().__init__(name)
        song = self.create_publisher(String, "~/song", 10)
        self.create_timer(1.0, lambda: song.publish(String(data=self.get_name())))


def main():
    rclpy.init()
    executor = SingleThreadedExecutor()
    for name in ("alto", "tenor"):
        executor.add_node(Voice(name))
    try:
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    rclpy.try_shutdown()
