"""A robot's application of ROS 2 that knows nothing of us: rclpy as it is, over Fast DDS. It sends letters by the node /front/courier, and permits
what it is asked for. Orders come as lines on its standard input; it answers by lines of JSON, of which the first says that it is ready."""

import json
import os
import queue
import sys
import threading
import time

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String
from std_srvs.srv import SetBool

# Seconds, longer on a busy machine.
LONGEST = float(os.environ.get("STORY_PATIENCE", "100"))
LARGE = "".join(chr(97 + at % 26) for at in range(1 << 20))


def say(*what):
    print(json.dumps(what), flush=True)


def until(done):
    deadline = time.monotonic() + LONGEST
    while not done() and time.monotonic() < deadline:
        time.sleep(0.02)


class Application(Node):
    def __init__(self):
        super().__init__("application")
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.heard, self.homes = queue.Queue(), queue.Queue()
        self.route = self.create_publisher(String, "/route", latched)
        self.route.publish(String(data="by sea"))
        self.letters = self.create_publisher(String, "/letters", 10)
        self.delivered = self.create_subscription(String, "/front/delivered", lambda said: self.heard.put(said.data), 10)
        self.create_subscription(String, "/front/home", lambda said: self.homes.put(said.data), latched)
        self.create_service(SetBool, "/permit", self.permit)
        self.opens = self.create_client(SetBool, "/front/open")

    def permit(self, request, response):
        response.success = request.data
        response.message = "as it likes" if request.data else "never"
        return response

    def carry(self, text):
        until(lambda: self.letters.get_subscription_count() and self.delivered.get_publisher_count())
        self.letters.publish(String(data=text))
        # What was delivered for others of this robot is heard, too.
        while not (told := self.heard.get(timeout=LONGEST)).endswith(text):
            pass
        return told

    def send(self, *words):
        return self.carry(" ".join(words))

    def send_large(self):
        return self.carry(LARGE) == "by sea: " + LARGE

    def home(self):
        return self.homes.get(timeout=LONGEST)

    def open(self, data):
        if not self.opens.wait_for_service(LONGEST):
            return "nobody serves it"
        future = self.opens.call_async(SetBool.Request(data=data == "true"))
        until(future.done)
        return [future.result().success, future.result().message] if future.done() else "nobody answers"

    def nodes(self):
        return sorted(space.rstrip("/") + "/" + name for name, space in self.get_node_names_and_namespaces())

    def ends(self):
        found = {
            "publishes": self.get_publisher_names_and_types_by_node("courier", "/front"),
            "subscribes": self.get_subscriber_names_and_types_by_node("courier", "/front"),
            "serves": self.get_service_names_and_types_by_node("courier", "/front"),
        }
        return {what: dict(ends) for what, ends in found.items()}


def spin(node):
    try:
        rclpy.spin(node)
    except ExternalShutdownException:
        pass


rclpy.init()
application = Application()
threading.Thread(target=spin, args=(application,), daemon=True).start()
say("ready")
for line in sys.stdin:
    what, *words = line.split()
    say(what, getattr(application, what)(*words))
