"""Works for as long as it is asked to, one call after the other, and counts, ten a second. Counts to no number below zero, and does not stop
counting for who is stubborn."""

import socket
import time

import rclpy
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node
from sharer_msgs.action import Count
from sharer_msgs.srv import Work


class Sharer(Node):
    def __init__(self):
        super().__init__("sharer")
        self.declare_parameter("speed", 10.0)
        self.create_service(Work, "work", self.work)
        self.counting = ActionServer(
            self,
            Count,
            "count",
            self.count,
            goal_callback=lambda goal: GoalResponse.REJECT if goal.to < 0 else GoalResponse.ACCEPT,
            cancel_callback=lambda goal: CancelResponse.REJECT if goal.request.who == "stubborn" else CancelResponse.ACCEPT,
            callback_group=ReentrantCallbackGroup(),
        )

    def work(self, request, response):
        time.sleep(request.seconds)
        response.who = request.who
        response.where = socket.gethostname()
        return response

    def count(self, goal):
        result = Count.Result(who=goal.request.who)
        for number in range(1, goal.request.to + 1):
            if goal.is_cancel_requested:
                goal.canceled()
                return result
            result.all.append(number)
            goal.publish_feedback(Count.Feedback(who=goal.request.who, at=number))
            time.sleep(1.0 / self.get_parameter("speed").value)
        goal.succeed()
        return result


def main():
    rclpy.init()
    node = Sharer()
    executor = MultiThreadedExecutor(num_threads=4)
    executor.add_node(node)
    try:
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    node.destroy_node()
    rclpy.try_shutdown()
