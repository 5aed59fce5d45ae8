"""Greets whoever is named, and says how many were."""

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String
from std_srvs.srv import Trigger

from twins_ros2.spun import spin


class Greeter(Node):
    def __init__(self):
        super().__init__("greeter")
        self.declare_parameter("word", "hi")
        self.greeted = 0
        latched = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.greetings = self.create_publisher(String, "~/greeting", latched)
        self.create_subscription(String, "~/name", self.greet, 10)
        self.create_service(Trigger, "~/count", self.count)

    def greet(self, name):
        self.greeted += 1
        self.greetings.publish(String(data="%s %s" % (self.get_parameter("word").value, name.data)))

    def count(self, _, response):
        response.success = True
        response.message = str(self.greeted)
        return response


def main():
    spin(Greeter)
