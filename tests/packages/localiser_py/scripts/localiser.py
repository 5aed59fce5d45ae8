#!/usr/bin/env python3
"""Finds where a robot is. The map is latched on /map: without it no scan can be answered. A scan has the distances to
the walls in four directions (+x, +y, -x, -y); the one free cell where they fit is the answer, latched, too."""
import rospy
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import OccupancyGrid
from sensor_msgs.msg import LaserScan

rospy.init_node("localiser")
poses = rospy.Publisher("~pose", PoseStamped, queue_size=10, latch=True)
grid = {}


def learn(message):
    grid["map"] = message


def distance(info, cells, x, y, step):
    """From a cell to the next wall, metres."""
    count = 0
    while cells[y * info.width + x] == 0:
        x, y, count = x + step[0], y + step[1], count + 1
    return count * info.resolution


def find(scan):
    if "map" not in grid:
        return
    info, cells = grid["map"].info, grid["map"].data
    steps = ((1, 0), (0, 1), (-1, 0), (0, -1))
    for at, cell in enumerate(cells):
        y, x = divmod(at, info.width)
        if cell == 0 and all(
            abs(distance(info, cells, x, y, step) - far) < info.resolution / 2
            for step, far in zip(steps, scan.ranges)
        ):
            pose = PoseStamped()
            pose.header.stamp = scan.header.stamp
            pose.header.frame_id = grid["map"].header.frame_id
            pose.pose.position.x = info.origin.position.x + (x + 0.5) * info.resolution
            pose.pose.position.y = info.origin.position.y + (y + 0.5) * info.resolution
            pose.pose.orientation.w = 1.0
            poses.publish(pose)
            return


rospy.Subscriber("/map", OccupancyGrid, learn, queue_size=1)
rospy.Subscriber("/scan", LaserScan, find, queue_size=1)
rospy.spin()
