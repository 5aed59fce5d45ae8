"""Publishes pictures whose colours, and scans whose places a test knows. Says on ~/said where ~/say pointed last, and ~/switch whether it is on."""

import math
from array import array

import rclpy
from geometry_msgs.msg import Point
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from sensor_msgs.msg import Image, LaserScan
from std_msgs.msg import String
from std_srvs.srv import SetBool

WIDTH, HEIGHT = 640, 480
RED, BLUE = bytes((255, 0, 0)), bytes((0, 0, 255))


class Sights(Node):
    def __init__(self):
        super().__init__("sights")
        row = RED * (WIDTH // 2) + BLUE * (WIDTH // 2)
        self.picture = Image(width=WIDTH, height=HEIGHT, encoding="rgb8", step=3 * WIDTH, data=array("B", row * HEIGHT))
        # A wall 2 m ahead, a third of a circle wide; nothing elsewhere.
        self.scan = LaserScan(
            angle_min=-math.pi, angle_max=math.pi, angle_increment=math.pi / 180, range_min=0.1, range_max=10.0
        )
        self.scan.header.frame_id = "laser"
        self.scan.ranges = [2.0 if abs(degree) <= 60 else math.inf for degree in range(-180, 181)]
        self.point = Point()
        self.pictures = self.create_publisher(Image, "~/image", 10)
        self.scans = self.create_publisher(LaserScan, "~/scan", 10)
        self.said = self.create_publisher(String, "~/said", 10)
        self.create_subscription(Point, "~/say", self.hear, 10)
        self.create_service(SetBool, "~/switch", self.switch)
        self.create_timer(0.1, self.show)

    def show(self):
        self.pictures.publish(self.picture)
        self.scan.header.stamp = self.get_clock().now().to_msg()
        self.scans.publish(self.scan)
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
