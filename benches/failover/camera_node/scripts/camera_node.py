#!/usr/bin/env python3
"""Takes 64 ms for a picture and then the newest one: most pictures of a 30 Hz camera are left out.

An answer is published twice: on `found` with the picture's stamp, on `count` without one. What comes on `command` is
echoed on `echo` at once. `work` is an action whose goal is a number of seconds. With `~lines` it prints that many lines
a second, with `~topics` it registers that many topics, one after another.
"""
import threading
import time

import actionlib
import rospy
from actionlib.msg import TestAction, TestFeedback, TestResult
from sensor_msgs.msg import CompressedImage, TimeReference
from std_msgs.msg import UInt32

PICTURE = 0.064


def answer(picture):
    time.sleep(PICTURE)
    reference = TimeReference(header=picture.header, source="camera_node")
    found.publish(reference)
    count.publish(picture.header.stamp.secs)


def work(goal):
    for second in range(goal.goal):
        if server.is_preempt_requested():
            return server.set_preempted(TestResult(second))
        server.publish_feedback(TestFeedback(second))
        time.sleep(1.0)
    server.set_succeeded(TestResult(goal.goal))


def print_lines(rate):
    line = 0
    begun = time.monotonic()
    while not rospy.is_shutdown():
        due = int((time.monotonic() - begun) * rate)
        print("\n".join(f"line {number} of many that a node prints when it is told to be verbose" for number in range(line, due)))
        line = due
        time.sleep(0.05)


def register_topics(number):
    for topic in range(number):
        rospy.Publisher(f"~topic_{topic}", UInt32, queue_size=1)
        time.sleep(0.02)


rospy.init_node("camera_node")
found = rospy.Publisher("found", TimeReference, queue_size=1)
count = rospy.Publisher("count", UInt32, queue_size=1)
echo = rospy.Publisher("echo", UInt32, queue_size=100)
server = actionlib.SimpleActionServer("work", TestAction, work, auto_start=False)
server.start()
rospy.Subscriber("image", CompressedImage, answer, queue_size=1, buff_size=1 << 20)
rospy.Subscriber("command", UInt32, echo.publish, queue_size=100)
for act, parameter in ((print_lines, "~lines"), (register_topics, "~topics")):
    given = rospy.get_param(parameter, 0)
    if given:
        threading.Thread(target=act, args=(given,), daemon=True).start()
rospy.spin()
