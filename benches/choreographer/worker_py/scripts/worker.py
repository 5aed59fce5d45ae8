#!/usr/bin/env python3
"""Uses so many milliseconds of a core for each call of /work; all the time if it is greedy."""
import time

import rospy
from std_srvs.srv import Empty, EmptyResponse


def work(seconds):
    until = time.thread_time() + seconds
    while time.thread_time() < until:
        pass


rospy.init_node("worker")
seconds = float(rospy.get_param("~milliseconds", 50)) / 1000


def answer(_request):
    work(seconds)
    return EmptyResponse()


rospy.Service("/work", Empty, answer)
if rospy.get_param("~greedy", False):
    while not rospy.is_shutdown():
        work(0.1)
rospy.spin()
