"""A node of rclpy with one thread and the buffers that it has by default. `show WIDTH HEIGHT COUNT` has it publish so many pictures on
/picture at 30 Hz, each with its number as its stamp; `count COUNT` waits until so many came on /seen, or five seconds passed in which none did, and says
the numbers of those that were as they had been published.
"""

import json
import select
import sys
import time

import rclpy
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Image

PATIENCE = 5

rclpy.init()
node = Node('camera')
# None is replaced by a later one.
quality = QoSProfile(depth=30)
publisher = node.create_publisher(Image, '/picture', quality)
# Filling in a picture takes longer than sending it.
pictures = {}
seen = []


def picture(width, height):
    row = bytes(index % 251 for index in range(width * 3))
    return Image(height=height, width=width, encoding='rgb8', step=width * 3, data=row * height)


def take(image):
    whole = pictures[image.width, image.height].data == image.data and image.encoding == 'rgb8'
    seen.append(image.header.stamp.sec if whole else -1)


node.create_subscription(Image, '/seen', take, quality)
print(json.dumps(['ready']), flush=True)
while True:
    rclpy.spin_once(node, timeout_sec=0.01)
    if not select.select([sys.stdin], [], [], 0)[0]:
        continue
    order, *numbers = sys.stdin.readline().split() or ['end']
    if order == 'show':
        width, height, count = map(int, numbers)
        image = pictures.setdefault((width, height), picture(width, height))
        due = time.monotonic()
        for number in range(count):
            time.sleep(max(0, due - time.monotonic()))
            due += 1 / 30
            image.header.stamp.sec = number
            publisher.publish(image)
        print(json.dumps(['show']), flush=True)
    elif order == 'count':
        quiet_since = time.monotonic()
        while len(seen) < int(numbers[0]) and time.monotonic() - quiet_since < PATIENCE:
            before = len(seen)
            rclpy.spin_once(node, timeout_sec=0.2)
            if len(seen) != before:
                quiet_since = time.monotonic()
        print(json.dumps(['count', seen]), flush=True)
        seen = []
    else:
        break
