"""Greets whoever is named on a topic or by a call, and counts to what it is told."""

import numpy
import rclpy
from geometry_msgs.msg import Point
from herald_msgs.action import Count
from herald_msgs.msg import Greeting
from herald_msgs.srv import Greet
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.action import ActionServer
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from std_msgs.msg import String


class Herald(Node):
    def __init__(self):
        super().__init__("herald")
        self.declare_parameter("salutation", "Hello", ParameterDescriptor(description="What comes before the name."))
        self.declare_parameter("volumes", [1, 2, 3])
        self.known = set()
        self.greetings = self.create_publisher(Greeting, "greeting", 10)
        self.create_subscription(String, "name", lambda said: self.greetings.publish(self.greeting(said.data)), 10)
        self.create_service(Greet, "greet", self.greet)
        self.counting = ActionServer(self, Count, "count", self.count)

    def greeting(self, name):
        greeting = Greeting(manner=Greeting.LOUD)
        greeting.stamp = self.get_clock().now().to_msg()
        greeting.text = "%s, %s" % (self.get_parameter("salutation").value, name)
        greeting.wide = greeting.text.upper()
        greeting.at = [Point(x=float(x)) for x in numpy.arange(2)]
        return greeting

    def greet(self, request, response):
        response.greeting = self.greeting(request.name)
        response.known = request.name in self.known
        self.known.add(request.name)
        return response

    def count(self, goal):
        counted = []
        for number in range(1, goal.request.to + 1):
            counted.append(number)
            goal.publish_feedback(Count.Feedback(at=number))
        goal.succeed()
        return Count.Result(counted=counted)


def main():
    rclpy.init()
    node = Herald()
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    node.destroy_node()
    rclpy.try_shutdown()
