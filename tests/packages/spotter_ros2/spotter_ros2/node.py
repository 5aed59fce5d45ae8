"""Finds things in what a camera sees: a node in a namespace that its program gives it; another program is two of them."""

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import String


class Detector(Node):
    def __init__(self, namespace):
        super().__init__("detector", namespace=namespace)
        self.declare_parameter("what", "a thing")
        self.found = self.create_publisher(String, "found", 10)
        self.create_subscription(String, "image", self.look, 10)

    def look(self, image):
        what = self.get_parameter("what").value
        found = "%s in %s by %s" % (what, image.data, self.get_fully_qualified_name())
        self.found.publish(String(data=found))


def run(*namespaces):
    rclpy.init()
    executor = SingleThreadedExecutor()
    for namespace in namespaces:
        executor.add_node(Detector(namespace))
    try:
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    rclpy.try_shutdown()


def one():
    run("/camera")


def two():
    run("/left", "/right")


def high():
    run("/tower")
