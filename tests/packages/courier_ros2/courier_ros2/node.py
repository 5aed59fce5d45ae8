"""Carries letters by the route that is transient-local on /route: until it is known, letters wait. Says once where it lives, transient-local, too.
Opens parcels where its robot permits it, which it asks by a call while it is called itself."""

import rclpy
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String
from std_srvs.srv import SetBool

# Seconds that only a story which fails waits.
LONGEST = 600.0


class Courier(Node):
    def __init__(self):
        super().__init__("courier")
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.route = None
        self.waiting = []
        self.delivered = self.create_publisher(String, "delivered", 10)
        self.home = self.create_publisher(String, "home", latched)
        self.home.publish(String(data="in the clouds"))
        self.create_subscription(String, "/route", self.learn, latched)
        self.create_subscription(String, "letter", self.carry, 10)
        # Of a group of its own, since it is answered while a call is being answered.
        self.permit = self.create_client(SetBool, "/permit", callback_group=MutuallyExclusiveCallbackGroup())
        self.create_service(SetBool, "open", self.open)

    def learn(self, route):
        self.route = route.data
        letters, self.waiting = self.waiting, []
        for letter in letters:
            self.carry(letter)

    def carry(self, letter):
        if self.route is None:
            self.waiting.append(letter)
            return
        self.delivered.publish(String(data="%s: %s" % (self.route, letter.data)))

    async def open(self, request, response):
        if not self.permit.wait_for_service(LONGEST):
            response.message = "nobody serves /permit"
            return response
        permitted = await self.permit.call_async(request)
        response.success = permitted.success
        response.message = "the robot says: %s" % permitted.message
        return response


def main():
    rclpy.init()
    node = Courier()
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    node.destroy_node()
    rclpy.try_shutdown()
