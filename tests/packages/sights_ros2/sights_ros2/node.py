"""Publishes pictures whose colours a test knows. Says on ~/said where ~/say pointed last, and ~/switch whether it is on."""

from array import array

import rclpy
from geometry_msgs.msg import Point
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from sensor_msgs.msg import Image
from std_msgs.msg import String
from std_srvs.srv import SetBool

WIDTH, HEIGHT = 640, 480
RED, BLUE = bytes((255, 0, 0)), bytes((0, 0, 255))


class Sights(Node):
    def __init__(self):
        super().__init__("sights")
        row = RED * (WIDTH // 2) + BLUE * (WIDTH // 2)
        self.picture = Image(width=WIDTH, height=HEIGHT, encoding="rgb8", step=3 * WIDTH, data=array("B", row * HEIGHT))
        self.point = Point()
        self.pictures = self.create_publisher(Image, "~/image", 10)
        self.said = self.create_publisher(String, "~/said", 10)
        self.create_subscription(Point, "~/say", self.hear, 10)
        self.create_service(SetBool, "~/switch", self.switch)
        self.create_timer(0.1, self.show)

    def show(self):
        self.pictures.publish(self.picture)
        self.said.publish(String(data=f"at {self.point.x} {self.point.y}"))

    def hear(self, point):
        self.point = point

    def switch(self, request, response):
        response.success = True
        response.message = "it is on" if request.data else "it is off"
        return response


def main():
    rclpy.init()
    node = Sights()
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    node.destroy_node()
    rclpy.try_shutdown()
