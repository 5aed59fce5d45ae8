#!/usr/bin/env python3
"""Takes as many megabytes as /take says, and does not give them back."""
import rospy
from std_msgs.msg import UInt32

rospy.init_node("hog")
taken = []
rospy.Subscriber("/take", UInt32, lambda megabytes: taken.append(bytearray(b"x" * (megabytes.data << 20))))
rospy.spin()
