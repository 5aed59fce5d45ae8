"""Finds where a robot is. The map is transient-local on /map: without it no scan can be answered. A scan has the distances to the walls in
four directions (+x, +y, -x, -y); the one free cell where they fit is the answer, transient-local, too."""

import rclpy
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import OccupancyGrid
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import LaserScan

STEPS = ((1, 0), (0, 1), (-1, 0), (0, -1))


class Localiser(Node):
    def __init__(self):
        super().__init__("localiser")
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.grid = None
        self.poses = self.create_publisher(PoseStamped, "~/pose", latched)
        self.create_subscription(OccupancyGrid, "/map", self.learn, latched)
        self.create_subscription(LaserScan, "/scan", self.find, 1)

    def learn(self, grid):
        self.grid = grid

    def distance(self, x, y, step):
        """From a cell to the next wall, metres."""
        info, count = self.grid.info, 0
        while self.grid.data[y * info.width + x] == 0:
            x, y, count = x + step[0], y + step[1], count + 1
        return count * info.resolution

    def find(self, scan):
        if self.grid is None:
            return
        info = self.grid.info
        for at, cell in enumerate(self.grid.data):
            y, x = divmod(at, info.width)
            if cell == 0 and all(
                abs(self.distance(x, y, step) - far) < info.resolution / 2 for step, far in zip(STEPS, scan.ranges)
            ):
                pose = PoseStamped()
                pose.header.stamp = scan.header.stamp
                pose.header.frame_id = self.grid.header.frame_id
                pose.pose.position.x = info.origin.position.x + (x + 0.5) * info.resolution
                pose.pose.position.y = info.origin.position.y + (y + 0.5) * info.resolution
                pose.pose.orientation.w = 1.0
                self.poses.publish(pose)
                return


def main():
    rclpy.init()
    node = Localiser()
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    node.destroy_node()
    rclpy.try_shutdown()
