"""A discovery server: Fast DDS makes a participant one by the profile that its environment names. A line of JSON says that it is there."""

import json
import sys

import rclpy

rclpy.init()
node = rclpy.create_node('server')
print(json.dumps(['ready']), flush=True)
sys.stdin.read()
