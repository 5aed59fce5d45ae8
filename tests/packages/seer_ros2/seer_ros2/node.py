"""Finds what is bright in pictures, as a detector of people does: each picture is answered with the corners of what was found, under the
picture's own header."""

import numpy
import rclpy
from geometry_msgs.msg import Point32, PolygonStamped
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Image

BRIGHT = 128


class Seer(Node):
    def __init__(self):
        super().__init__("people_detect")
        self.found = self.create_publisher(PolygonStamped, "~/found", 10)
        self.create_subscription(Image, "image", self.look, qos_profile_sensor_data)

    def look(self, image):
        pixels = numpy.frombuffer(image.data, dtype=numpy.uint8).reshape(image.height, image.width, -1)
        rows, columns = numpy.nonzero(pixels.max(axis=2) > BRIGHT)
        found = PolygonStamped(header=image.header)
        if len(rows):
            for x, y in ((columns.min(), rows.min()), (columns.max(), rows.max())):
                found.polygon.points.append(Point32(x=float(x), y=float(y)))
        self.found.publish(found)


def main():
    rclpy.init()
    node = Seer()
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    node.destroy_node()
    rclpy.try_shutdown()
