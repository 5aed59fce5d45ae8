"""Adds two integers and says so on /sums."""

from rclpy.node import Node
from std_msgs.msg import String
from test_msgs.srv import BasicTypes

from twins_ros2.spun import spin


class Adder(Node):
    def __init__(self):
        super().__init__("adder")
        self.sums = self.create_publisher(String, "/sums", 1000)
        self.create_service(BasicTypes, "/add_two", self.add)

    def add(self, request, response):
        response.int64_value = request.int64_value + request.int32_value
        self.sums.publish(String(data=str(response.int64_value)))
        return response


def main():
    spin(Adder)
