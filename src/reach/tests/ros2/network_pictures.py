"""A node of rclpy with one thread and the buffers that it has by default: it counts what it hears on /picture, reliably or not, and
says it when it is told how many there were and all have come, or nothing has for so long that nothing will: two seconds where messages may
be lost, a minute where they may not, on a machine that may be busy.
"""

import json
import sys
import threading
import time

import rclpy
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import String

rclpy.init()
node = Node('viewer')
numbers = []
asked = threading.Event()


def take(message):
    numbers.append(int(message.data.split(' ', 1)[0]))


def listen():
    global expected
    expected = int(sys.stdin.readline().split()[1])
    asked.set()


expected = None
reliable = sys.argv[1] == 'reliable'
policy = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
patience = 60 if reliable else 2
node.create_subscription(String, '/picture', take, QoSProfile(depth=60, reliability=policy))
threading.Thread(target=listen, daemon=True).start()
print(json.dumps(['ready']), flush=True)
quiet_since = time.monotonic()
while not asked.is_set() or len(numbers) < expected and time.monotonic() - quiet_since < patience:
    before = len(numbers)
    rclpy.spin_once(node, timeout_sec=0.2)
    if len(numbers) != before:
        quiet_since = time.monotonic()
print(json.dumps(['count', len(numbers), numbers == sorted(set(numbers))]), flush=True)
sys.stdin.read()
