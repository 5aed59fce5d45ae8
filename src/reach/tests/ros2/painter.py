"""A node of rclpy that publishes pictures of 6 MB on /picture at 30 Hz, with the buffers that it has by default, until it is killed."""

import json

import rclpy
from rclpy.node import Node
from rclpy.qos import QoSProfile
from std_msgs.msg import String

rclpy.init()
node = Node('painter')
picture = String(data='p' * 6_000_000)
publisher = node.create_publisher(String, '/picture', QoSProfile(depth=5))
node.create_timer(1 / 30, lambda: publisher.publish(picture))
print(json.dumps(['ready']), flush=True)
rclpy.spin(node)
