"""Minds what many nodes mind: how old its input is, which transforms it was told, what time it is."""

import time
from threading import Event

import rclpy
from geometry_msgs.msg import PointStamped
from rclpy.action import ActionClient, ActionServer, CancelResponse
from rclpy.action.client import GoalStatus
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.time import Time
from std_msgs.msg import String
from std_srvs.srv import Trigger
from test_msgs.action import Fibonacci
from tf2_msgs.msg import TFMessage


def wait_for(future):
    done = Event()
    future.add_done_callback(lambda _: done.set())
    done.wait()
    return future.result()


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
        # Whoever waits for the robot keeps no other from being answered.
        self.group = ReentrantCallbackGroup()
        self.create_service(Trigger, "~/send", self.send, callback_group=self.group)
        self.create_service(Trigger, "~/stop", self.stop, callback_group=self.group)
        self.arm = None
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

    def find_arm(self):
        if self.arm is None:
            self.arm = ActionClient(self, Fibonacci, "/robot/act", callback_group=self.group)
        self.arm.wait_for_server()
        return self.arm

    def send(self, _, response):
        goal = wait_for(self.find_arm().send_goal_async(Fibonacci.Goal(order=3)))
        return self.tell(goal, GoalStatus.STATUS_SUCCEEDED, response)

    def stop(self, _, response):
        moves = Event()
        sent = self.find_arm().send_goal_async(Fibonacci.Goal(order=1000000), lambda _: moves.set())
        goal = wait_for(sent)
        moves.wait()
        wait_for(goal.cancel_goal_async())
        return self.tell(goal, GoalStatus.STATUS_CANCELED, response)

    def tell(self, goal, expected, response):
        end = wait_for(goal.get_result_async())
        response.success = end.status == expected
        response.message = " ".join(str(number) for number in end.result.sequence)
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
