"""An application of ROS 2 that shares a node with other robots and does not know it: rclpy as it is. Sends goals to count, and prints what came of
them as one line of JSON; `waiting`: while the node counts for another robot; `free`: when it does not."""

import json
import os
import sys
import time

import rclpy
from action_msgs.msg import GoalStatus, GoalStatusArray
from rclpy.action import ActionClient
from rclpy.node import Node
from rclpy.parameter_client import AsyncParameterClient
from rclpy.qos import DurabilityPolicy, QoSProfile
from sharer_msgs.action import Count
from sharer_msgs.srv import Work

# Seconds, longer on a busy machine.
LONGEST = float(os.environ.get("STORY_PATIENCE", "100"))
NAMES = ["UNKNOWN", "ACCEPTED", "EXECUTING", "CANCELING", "SUCCEEDED", "CANCELED", "ABORTED"]
STATUSES = {getattr(GoalStatus, "STATUS_" + name): name for name in NAMES}

rclpy.init()
node = Node("application")
client = ActionClient(node, Count, "/count")
work = node.create_client(Work, "/work")
statuses = {}


def until(what, done):
    deadline = time.monotonic() + LONGEST
    while not done():
        if time.monotonic() > deadline:
            sys.exit("%s did not come about; statuses: %s" % (what, statuses))
        rclpy.spin_once(node, timeout_sec=0.05)


def result(what, future):
    until(what, future.done)
    return future.result()


def hear(told):
    for one in told.status_list:
        statuses.setdefault(bytes(one.goal_info.goal_id.uuid), []).append(STATUSES[one.status])


class Goal:
    def __init__(self, who, to):
        self.at = []
        heard = lambda told: self.at.append(told.feedback.at)
        self.handle = result("an answer", client.send_goal_async(Count.Goal(who=who, to=to), feedback_callback=heard))
        self.ended = self.handle.get_result_async() if self.handle.accepted else None

    def status(self):
        return statuses.get(bytes(self.handle.goal_id.uuid), [""])[-1]

    def cancel(self):
        answer = result("an answer to a cancel", self.handle.cancel_goal_async())
        return {"canceling": len(answer.goals_canceling), "code": answer.return_code}

    def end(self):
        return STATUSES[result("the end of a goal", self.ended).status]


node.create_subscription(
    GoalStatusArray, "/count/_action/status", hear, QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
)
until("the action", client.server_is_ready)
until("the service", work.service_is_ready)
told = {"work": result("an answer", work.call_async(Work.Request(who="rclpy"))).who}
if sys.argv[1] == "waiting":
    goal = Goal("rclpy", 3)
    until("a status", goal.status)
    told["status"] = goal.status()
    told["accepted"] = goal.handle.accepted
    told["canceled"] = goal.cancel()
    told["end"] = goal.end()
else:
    goal = Goal("rclpy", 3)
    end = goal.end()
    # Its result may be read before the last of what was told on the way.
    until("all feedback", lambda: len(goal.at) >= 3)
    told["counted"] = {"end": end, "all": list(goal.ended.result().result.all), "at": goal.at}
    told["refused"] = not Goal("rclpy", -1).handle.accepted
    goal = Goal("stubborn", 10)
    until("feedback", lambda: goal.at)
    told["stubborn"] = {**goal.cancel(), "end": goal.end()}
    goal = Goal("rclpy", 100000)
    until("feedback", lambda: goal.at)
    told["canceled"] = {**goal.cancel(), "end": goal.end()}
    told["parameters"] = AsyncParameterClient(node, "sharer").services_are_ready()
print(json.dumps(told))
client.destroy()
node.destroy_node()
rclpy.shutdown()
