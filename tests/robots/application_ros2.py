"""A robot's application of ROS 2 that knows nothing of us: rclpy as it is, over Fast DDS. It shows pictures to /people_detect, hears what was
found, looks at the graph and at the node's parameters, and prints what came out as one line of JSON. One subscription asks for more than the
node offers; all stay until standard input ends."""

import json
import os
import sys
import time

import rclpy
from geometry_msgs.msg import PolygonStamped
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import Image

NODE = "people_detect"
# Seconds, longer on a busy machine.
LONGEST = float(os.environ.get("STORY_PATIENCE", "100"))

rclpy.init()
node = Node("application")
answers = {}


def until(what, done):
    deadline = time.monotonic() + LONGEST
    while not done():
        if time.monotonic() > deadline:
            sys.exit("%s did not come about; answers: %s" % (what, answers))
        rclpy.spin_once(node, timeout_sec=0.05)


def hear(found):
    answers[found.header.stamp.sec] = [[point.x, point.y] for point in found.polygon.points]


def result(future):
    until("the answer of a service", future.done)
    return future.result()


node.create_subscription(PolygonStamped, "/people_detect/found", hear, 10)
kept = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
node.create_subscription(PolygonStamped, "/people_detect/found", lambda found: sys.exit("it was not offered"), kept)
pictures = node.create_publisher(Image, "/image", qos_profile_sensor_data)
until("the node", lambda: pictures.get_subscription_count() == 1 and node.count_publishers("/people_detect/found") == 1)

# Pictures with a bright square of which the corners are known.
for number in range(1, 4):
    picture = Image(height=48, width=64, encoding="mono8", step=64)
    picture.header.stamp.sec = number
    data = bytearray(48 * 64)
    for row in range(10, 20):
        data[row * 64 + 5 * number:row * 64 + 5 * number + 8] = b"\xff" * 8
    picture.data = bytes(data)
    # Best effort: shown until it is answered.
    while number not in answers:
        pictures.publish(picture)
        until_at = time.monotonic() + 1.0
        while number not in answers and time.monotonic() < until_at:
            rclpy.spin_once(node, timeout_sec=0.05)

client = AsyncParameterClient(node, NODE)
until("the node's parameter services", client.services_are_ready)
before = result(client.get_parameters(["use_sim_time"])).values[0].bool_value
accepted = result(client.set_parameters([Parameter("use_sim_time", value=False)])).results[0].successful
names = [name for name, _ in node.get_node_names_and_namespaces()]
print(json.dumps({
    "answers": answers,
    "before": before,
    "accepted": accepted,
    "nodes": names,
    "publishes": dict(node.get_publisher_names_and_types_by_node(NODE, "/")),
    "subscribes": dict(node.get_subscriber_names_and_types_by_node(NODE, "/")),
    "reliable": [str(info.qos_profile.reliability.name) for info in node.get_subscriptions_info_by_topic("/image")],
}), flush=True)
sys.stdin.read()
node.destroy_node()
rclpy.shutdown()
