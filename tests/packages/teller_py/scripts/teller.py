#!/usr/bin/env python3
"""Tells on ~told how it was started: arguments, name, namespace, directory, parameters, and the how manieth life this is.

A life ends with the exit code in ~code when its number comes on ~end. What comes on ~say is said on ~said.
"""
import os
import sys

import rospy
from std_msgs.msg import Int32, String

rospy.init_node("teller")
life = rospy.get_param("~lives", 0) + 1
rospy.set_param("~lives", life)


def directory():
    if os.getcwd() == os.environ.get("ROS_HOME", os.path.expanduser("~/.ros")):
        return "ROS's"
    if os.getcwd() == os.path.dirname(os.path.realpath(sys.argv[0])):
        return "the program's"
    return os.getcwd()


def end(message):
    if message.data == life:
        sys.stdout.flush()
        os._exit(rospy.get_param("~code", 0))


key = rospy.get_param("~key", None)
key = ", key %s" % key if key else ""
told = rospy.Publisher("~told", String, latch=True, queue_size=1)
told.publish(
    "life %d of %s in %s, directory %s, arguments %s, word %s, number %s, file %s"
    % (
        life,
        rospy.get_name(),
        os.environ.get("ROS_NAMESPACE"),
        directory(),
        rospy.myargv()[1:],
        rospy.get_param("~word", "none"),
        rospy.get_param("~number", "none"),
        ("there" if os.path.exists(rospy.get_param("~file", "")) else "missing") + key,
    )
)
said = rospy.Publisher("~said", String, queue_size=10)
rospy.Subscriber("~say", String, said.publish)
rospy.Subscriber("~end", Int32, end)
rospy.on_shutdown(lambda: print("told to end", flush=True))
rospy.spin()
