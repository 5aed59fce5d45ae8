#!/usr/bin/env python3
"""Minds what many nodes mind: how old its input is, which transforms it was told, what time it is."""
import functools
import threading
import time

import actionlib
import rospy
from actionlib.msg import TestAction, TestFeedback, TestGoal, TestResult
from geometry_msgs.msg import PointStamped
from sensor_msgs.msg import Image
from std_msgs.msg import String
from std_srvs.srv import Trigger, TriggerResponse
from tf2_msgs.msg import TFMessage

rospy.init_node("crossing")
seen = rospy.Publisher("~seen", PointStamped, queue_size=10)
worked = rospy.Publisher("~worked", PointStamped, queue_size=100)
refused = rospy.Publisher("~refused", String, queue_size=10)
frames = rospy.Publisher("~frames", String, queue_size=10, latch=True)
mirrored = rospy.Publisher("~mirrored", Image, queue_size=2)
known = {"fixed": set(), "moving": set()}


def look(point):
    age = (rospy.Time.now() - point.header.stamp).to_sec()
    if abs(age) < 10.0:
        seen.publish(point)
    else:
        refused.publish("%.1f s old" % age)


def work(point):
    time.sleep(0.05)
    worked.publish(point)


def learn(kind):
    def told(message):
        known[kind].update(transform.child_frame_id for transform in message.transforms)
        frames.publish(" ".join(kind + ":" + frame for kind in sorted(known) for frame in sorted(known[kind])))

    return told


def act(goal):
    for step in range(goal.goal):
        if server.is_preempt_requested():
            return server.set_preempted(TestResult(-step))
        server.publish_feedback(TestFeedback(step))
        rospy.sleep(0.01)
    server.set_succeeded(TestResult(goal.goal))


@functools.lru_cache()
def find_arm():
    arm = actionlib.SimpleActionClient("/robot/act", TestAction)
    arm.wait_for_server()
    return arm


def send(_):
    arm = find_arm()
    arm.send_goal_and_wait(TestGoal(3))
    return TriggerResponse(arm.get_state() == actionlib.GoalStatus.SUCCEEDED, str(arm.get_result().result))


def stop(_):
    arm, moves = find_arm(), threading.Event()
    arm.send_goal(TestGoal(1000000), feedback_cb=lambda _: moves.set())
    moves.wait()
    arm.cancel_goal()
    arm.wait_for_result()
    return TriggerResponse(arm.get_state() == actionlib.GoalStatus.PREEMPTED, str(arm.get_result().result))


def ask(_):
    answer = rospy.ServiceProxy("/robot/secret", Trigger)()
    return TriggerResponse(answer.success, "the robot says " + answer.message)


def wait(_):
    rospy.wait_for_service("/robot/late")
    return TriggerResponse(True, "it is there")


rospy.Subscriber("~point", PointStamped, look)
rospy.Subscriber("~work", PointStamped, work)
rospy.Subscriber("~picture", Image, mirrored.publish, queue_size=1, buff_size=1 << 22)
rospy.Subscriber("/tf", TFMessage, learn("moving"))
rospy.Subscriber("/tf_static", TFMessage, learn("fixed"))
rospy.Service("~now", Trigger, lambda _: TriggerResponse(True, str(rospy.Time.now().to_nsec())))
rospy.Service("~label", Trigger, lambda _: TriggerResponse(True, str(rospy.get_param("~label", "none"))))
rospy.Service("~ask", Trigger, ask)
rospy.Service("~wait", Trigger, wait)
rospy.Service("~send", Trigger, send)
rospy.Service("~stop", Trigger, stop)
server = actionlib.SimpleActionServer("~act", TestAction, act, auto_start=False)
server.start()
rospy.spin()
