"""Minds what many nodes mind: how old its input is, which transforms it was told, what time it is."""

import time

import rclpy
from geometry_msgs.msg import PointStamped
from rclpy.action import ActionServer, CancelResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.time import Time
from std_msgs.msg import String
from std_srvs.srv import Trigger
from test_msgs.action import Fibonacci
from tf2_msgs.msg import TFMessage


class Crossing(Node):
    def __init__(self):
        super().__init__("crossing")
        latched = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.known = {"fixed": set(), "moving": set()}
        self.seen = self.create_publisher(PointStamped, "~/seen", 10)
        self.worked = self.create_publisher(PointStamped, "~/worked", 100)
        self.refused = self.create_publisher(String, "~/refused", 10)
        self.frames = self.create_publisher(String, "~/frames", latched)
        self.create_subscription(PointStamped, "~/point", self.look, 10)
        self.create_subscription(PointStamped, "~/work", self.work, 100)
        self.create_subscription(TFMessage, "/tf", self.learn("moving"), 100)
        self.create_subscription(TFMessage, "/tf_static", self.learn("fixed"), latched)
        self.create_service(Trigger, "~/now", self.now)
        self.declare_parameter("label", "none")
        self.create_service(Trigger, "~/label", self.label)
        # A goal is cancelled while it is carried out.
        self.acting = ActionServer(
            self,
            Fibonacci,
            "~/act",
            self.act,
            cancel_callback=lambda _: CancelResponse.ACCEPT,
            callback_group=ReentrantCallbackGroup(),
        )

    def look(self, point):
        age = (self.get_clock().now() - Time.from_msg(point.header.stamp)).nanoseconds / 1e9
        if abs(age) < 10.0:
            self.seen.publish(point)
        else:
            self.refused.publish(String(data="%.1f s old" % age))

    def work(self, point):
        time.sleep(0.05)
        self.worked.publish(point)

    def learn(self, kind):
        def told(message):
            self.known[kind].update(transform.child_frame_id for transform in message.transforms)
            frames = (kind + ":" + frame for kind in sorted(self.known) for frame in sorted(self.known[kind]))
            self.frames.publish(String(data=" ".join(frames)))

        return told

    def now(self, _, response):
        response.success = True
        response.message = str(self.get_clock().now().nanoseconds)
        return response

    def label(self, _, response):
        response.success = True
        response.message = self.get_parameter("label").value
        return response

    def act(self, goal):
        for step in range(goal.request.order):
            if goal.is_cancel_requested:
                goal.canceled()
                return Fibonacci.Result(sequence=[-step])
            goal.publish_feedback(Fibonacci.Feedback(sequence=[step]))
            time.sleep(0.01)
        goal.succeed()
        return Fibonacci.Result(sequence=[goal.request.order])


def main():
    rclpy.init()
    node = Crossing()
    executor = MultiThreadedExecutor(4)
    executor.add_node(node)
    try:
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    node.destroy_node()
    rclpy.try_shutdown()
