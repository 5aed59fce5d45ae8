#!/usr/bin/env python3
"""Repeats on /loud, in capitals, what is published on /quiet."""
import rospy
from std_msgs.msg import String

rospy.init_node("shout")
loud = rospy.Publisher("/loud", String, queue_size=10)
rospy.Subscriber("/quiet", String, lambda quiet: loud.publish(quiet.data.upper()))
rospy.spin()
