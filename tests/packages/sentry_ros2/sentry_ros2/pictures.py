"""Two nodes: the eye takes a picture of 6 MB when it is told its number, the reader says which pictures reached it whole."""

import array
import random
import time
import zlib

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from sensor_msgs.msg import Image
from std_msgs.msg import String, UInt32

WIDTH, HEIGHT = 1920, 1080


def wait_for_subscriber(publisher):
    """Nodes that know each other's names have not found all of each other's topics yet, on a busy machine least of all."""
    deadline = time.monotonic() + 60
    while publisher.get_subscription_count() == 0 and time.monotonic() < deadline:
        time.sleep(0.01)


class Eye(Node):
    def __init__(self):
        super().__init__("eye")
        self.pictures = self.create_publisher(Image, "picture", 5)
        self.create_subscription(UInt32, "look", self.look, 10)

    def look(self, told):
        pixels = random.Random(told.data).randbytes(WIDTH * HEIGHT * 3)
        picture = Image(width=WIDTH, height=HEIGHT, encoding="rgb8", step=WIDTH * 3)
        picture.header.stamp.sec = told.data
        picture.header.frame_id = str(zlib.crc32(pixels))
        picture.data = array.array("B", pixels)
        wait_for_subscriber(self.pictures)
        self.pictures.publish(picture)


class Reader(Node):
    def __init__(self):
        super().__init__("reader")
        self.seen = self.create_publisher(String, "seen", 10)
        self.create_subscription(Image, "picture", self.see, 5)

    def see(self, picture):
        whole = picture.header.frame_id == str(zlib.crc32(picture.data))
        seen = "%d: %d bytes, %s" % (picture.header.stamp.sec, len(picture.data), "whole" if whole else "torn")
        wait_for_subscriber(self.seen)
        self.seen.publish(String(data=seen))


def run(kind):
    rclpy.init()
    node = kind()
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    node.destroy_node()
    rclpy.try_shutdown()


def eye():
    run(Eye)


def reader():
    run(Reader)
