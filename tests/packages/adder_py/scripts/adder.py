#!/usr/bin/env python3
"""Adds two integers and says so on /sums."""
import rospy
import yaml
from adder_py.srv import AddTwo, AddTwoResponse
from std_msgs.msg import String

rospy.init_node("adder")
offset = yaml.safe_load(str(rospy.get_param("~offset", 0)))
# No limit: rospy's thread that sends may fall far behind those that add.
sums = rospy.Publisher("/sums", String, queue_size=0)


def add(request):
    total = request.a + request.b + offset
    if total < 0:
        rospy.logwarn("the sum is negative: %d", total)
    sums.publish(String("%d" % total))
    return AddTwoResponse(total)


rospy.Service("/add_two", AddTwo, add)
rospy.spin()
