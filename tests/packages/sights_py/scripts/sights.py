#!/usr/bin/env python3
"""Publishes what people look at, in colours and places that a test knows: pictures, a map, a scan, point clouds, transforms.

What comes on ~say is said on ~said. ~ping answers. ~count is an action.
"""
import math
import struct
import zlib

import actionlib
import rospy
from actionlib.msg import TestAction, TestFeedback, TestResult
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import OccupancyGrid
from sensor_msgs.msg import CompressedImage, Image, LaserScan, PointCloud2, PointField
from std_msgs.msg import String
from std_srvs.srv import Trigger, TriggerResponse
from tf2_msgs.msg import TFMessage

WIDTH, HEIGHT = 640, 480
HALVES = ((255, 0, 0), (0, 0, 255))


def image(encoding, pixel, left, right, width=WIDTH, height=HEIGHT):
    """The left half of one colour, the right half of the other; each row padded by three bytes."""
    row = left * (width // 2) + right * (width // 2) + b"\0\0\0"
    return Image(height=height, width=width, encoding=encoding, step=width * pixel + 3, data=row * height)


def png(width, height):
    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    row = b"\0" + bytes(HALVES[0]) * (width // 2) + bytes(HALVES[1]) * (width // 2)
    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    body = zlib.compress(row * height)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", body) + chunk(b"IEND", b"")


def transform(parent, child, x, yaw=0.0):
    told = TransformStamped()
    told.header.stamp = rospy.Time.now()
    told.header.frame_id, told.child_frame_id = parent, child
    told.transform.translation.x = x
    told.transform.rotation.z, told.transform.rotation.w = math.sin(yaw / 2), math.cos(yaw / 2)
    return told


def grid():
    """100 x 60 cells of 5 cm: the left half free, the right half occupied, the lowest ten rows unknown."""
    told = OccupancyGrid()
    told.header.frame_id = "map"
    told.info.resolution, told.info.width, told.info.height = 0.05, 100, 60
    told.info.origin.position.x, told.info.origin.position.y = -2.5, -1.0
    told.info.origin.orientation.w = 1.0
    told.data = [-1] * 1000 + ([0] * 50 + [100] * 50) * 50
    return told


def scan():
    """A wall 2 m ahead, a third of a circle wide; nothing elsewhere."""
    told = LaserScan(angle_min=-math.pi, angle_max=math.pi, angle_increment=math.pi / 180, range_min=0.1, range_max=10.0)
    told.header.frame_id = "laser"
    told.ranges = [2.0 if abs(degree) <= 60 else math.inf for degree in range(-180, 181)]
    return told


def cloud(big_endian=False):
    """A square of 100 x 100 points in the plane, 4 m wide: green where y > 0, magenta elsewhere."""
    order = ">" if big_endian else "<"
    points = bytearray()
    for row in range(100):
        for column in range(100):
            x, y = (column - 49.5) / 25, (row - 49.5) / 25
            colour = 0x00FF00 if y > 0 else 0xFF00FF
            points += struct.pack(order + "fff4xI", x, y, 0.5 * x, colour)
    fields = [PointField(name, offset, PointField.FLOAT32, 1) for name, offset in (("x", 0), ("y", 4), ("z", 8), ("rgb", 16))]
    told = PointCloud2(height=1, width=10000, fields=fields, is_bigendian=big_endian, point_step=20, row_step=200000)
    told.header.frame_id = "map"
    told.data = bytes(points)
    return told


def count(goal):
    for step in range(goal.goal):
        if server.is_preempt_requested():
            return server.set_preempted(TestResult(step))
        server.publish_feedback(TestFeedback(step))
        rospy.sleep(0.1)
    server.set_succeeded(TestResult(goal.goal))


rospy.init_node("sights")
red, blue = (bytes(colour) for colour in HALVES)
still = {
    "rgb8": image("rgb8", 3, red, blue),
    "bgr8": image("bgr8", 3, red[::-1], blue[::-1]),
    "rgba8": image("rgba8", 4, red + b"\xff", blue + b"\xff"),
    "mono8": image("mono8", 1, b"\0", b"\xff"),
    "mono16": image("mono16", 2, b"\0\0", b"\xff\xff"),
    "depth_16UC1": image("16UC1", 2, struct.pack("<H", 500), struct.pack("<H", 2500)),
    "depth_32FC1": image("32FC1", 4, struct.pack("<f", 0.5), struct.pack("<f", math.nan)),
    "odd": image("yuv422", 2, b"\0\0", b"\xff\xff"),
}
pictures = {name: rospy.Publisher("~image/" + name, Image, queue_size=1) for name in still}
compressed = rospy.Publisher("~compressed", CompressedImage, queue_size=1)
scans = rospy.Publisher("~scan", LaserScan, queue_size=1)
clouds = [rospy.Publisher("~cloud" + end, PointCloud2, queue_size=1) for end in ("", "_big_endian")]
moving = rospy.Publisher("/tf", TFMessage, queue_size=10)
fixed = rospy.Publisher("/tf_static", TFMessage, queue_size=10, latch=True)
maps = rospy.Publisher("~map", OccupancyGrid, queue_size=1, latch=True)
said = rospy.Publisher("~said", String, queue_size=1000)
rospy.Subscriber("~say", String, said.publish)
rospy.Service("~ping", Trigger, lambda _: TriggerResponse(True, "pong"))
rospy.set_param("~gain", 2)
rospy.set_param("~scale", 2.0)
rospy.set_param("~names", ["left", "right"])
rospy.set_param("~limits/speed", 0.5)
server = actionlib.SimpleActionServer("~count", TestAction, count, auto_start=False)
server.start()
maps.publish(grid())
fixed.publish(TFMessage([transform("base_link", "laser", 0.25)]))
plain = [cloud(), cloud(True)]
tick = 0


def publish(_):
    global tick
    tick += 1
    for name, publisher in pictures.items():
        if publisher.get_num_connections():
            publisher.publish(still[name])
    if tick % 3:
        return
    if compressed.get_num_connections():
        compressed.publish(CompressedImage(format="png", data=png(64, 48)))
    stamped = scan()
    stamped.header.stamp = rospy.Time.now()
    scans.publish(stamped)
    for publisher, told in zip(clouds, plain):
        if publisher.get_num_connections():
            publisher.publish(told)
    # Two frames are each other's parent, and one has two parents by turns: a tree they are not.
    parent = "map" if tick % 2 else "odom"
    moving.publish(TFMessage([transform("map", "odom", 1.0), transform("odom", "base_link", 0.5, math.pi / 2)]))
    moving.publish(TFMessage([transform("chicken", "egg", 0.0), transform("egg", "chicken", 0.0), transform(parent, "torn", 0.0)]))


rospy.Timer(rospy.Duration(1 / 30), publish)
rospy.spin()
