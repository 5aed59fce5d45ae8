"""A node from its beginning to its end."""

import rclpy
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor


def spin(make, threads=1):
    rclpy.init()
    node = make()
    executor = MultiThreadedExecutor(threads)
    executor.add_node(node)
    try:
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    node.destroy_node()
    rclpy.try_shutdown()
