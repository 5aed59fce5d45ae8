"""Calls services of its robot while it is called itself. Nobody tells a client of ROS 2 that its call has failed: it waits for as long as the
parameter `patience` says."""

from threading import Event

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from std_srvs.srv import Trigger

from twins_ros2.spun import spin

# In seconds: for who serves what may be there, and what comes later; only a story that fails waits so long.
MOMENT = 0.5
LONG = 600.0


class Caller(Node):
    def __init__(self):
        super().__init__("crossing")
        self.declare_parameter("patience", LONG)
        # Whoever waits keeps no other from being answered.
        group = ReentrantCallbackGroup()
        self.secret = self.create_client(Trigger, "/robot/secret", callback_group=group)
        self.late = self.create_client(Trigger, "/robot/late", callback_group=group)
        for name, serve in (("ask", self.ask), ("wait", self.wait), ("now", self.now)):
            self.create_service(Trigger, "~/" + name, serve, callback_group=group)

    def ask(self, request, response):
        if not self.secret.wait_for_service(MOMENT):
            response.message = "/robot/secret is unavailable"
            return response
        answered = Event()
        asked = self.secret.call_async(request)
        asked.add_done_callback(lambda _: answered.set())
        if answered.wait(self.get_parameter("patience").value):
            response.success = asked.result().success
            response.message = "the robot says " + asked.result().message
        else:
            self.secret.remove_pending_request(asked)
            response.message = "no answer during the call"
        return response

    def wait(self, _, response):
        response.success = self.late.wait_for_service(LONG)
        response.message = "it is there"
        return response

    def now(self, _, response):
        response.success = True
        response.message = str(self.get_clock().now().nanoseconds)
        return response


def main():
    spin(Caller, threads=4)
