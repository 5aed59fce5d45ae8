#!/usr/bin/env python3
"""Shows its action only after a transform, a service and a scan have come, one after the other, as move_base does."""
import threading

import actionlib
import rospy
from actionlib.msg import TestAction, TestActionGoal, TestFeedback, TestResult
from sensor_msgs.msg import LaserScan
from std_msgs.msg import String
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage

# Not the executable's name.
rospy.init_node("move_base")
base = rospy.get_param("~base_frame", "chassis")
located = threading.Event()


def learn(message):
    if any(transform.child_frame_id == base for transform in message.transforms):
        located.set()


arrived = threading.Event()
arrivals = rospy.Subscriber("/arrived", String, lambda _: arrived.set())
transforms = rospy.Subscriber("/tf", TFMessage, learn)
while not located.wait(0.2):
    rospy.logwarn_throttle(1.0, "waiting for the transform from %s to map" % base)
rospy.wait_for_service("/static_map")
rospy.ServiceProxy("/static_map", Trigger)()
# By a subscription that ends with the first one, unless it is to stay.
scanned = threading.Event()
if rospy.get_param("~keeps_scanning", False):
    scans = rospy.Subscriber("/scan", LaserScan, lambda _: scanned.set())
    scanned.wait()
else:
    rospy.wait_for_message("/scan", LaserScan)
# Goals of its own, beside the server's input of the same name.
own = rospy.Publisher("~goal", TestActionGoal, queue_size=1)


def drive(goal):
    # 1000 is far away: the robot says when it is there.
    if goal.goal == 1000:
        arrived.clear()
        while not arrived.wait(0.1):
            if server.is_preempt_requested():
                server.set_preempted()
                return
            server.publish_feedback(TestFeedback(1))
    server.set_succeeded(TestResult(goal.goal))


server = actionlib.SimpleActionServer(rospy.get_name(), TestAction, drive, auto_start=False)
server.start()
rospy.spin()
