"""A node of rclpy, /lab/peer, of which the tests ask things by lines on its standard input. It answers by lines of JSON; the first
one says that it is ready.
"""

import json
import sys
import threading
import time

import rclpy
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node, NodeNameNonExistentError
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import String
from std_srvs.srv import SetBool


def say(what):
    print(json.dumps(what), flush=True)


class Peer(Node):
    def __init__(self):
        super().__init__('peer', namespace='/lab')
        reliable = QoSProfile(depth=10)
        self.pong = self.create_publisher(String, '/pong', reliable)
        self.create_subscription(String, '/ping', self.pong.publish, reliable)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.map = self.create_publisher(String, '/map', latched)
        self.map.publish(String(data='kept'))
        history = QoSProfile(depth=3, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.plan = self.create_publisher(String, '/plan', history)
        for step in range(5):
            self.plan.publish(String(data=str(step)))
        self.create_subscription(String, '/late', lambda message: say(['late', message.data]), latched)
        best_effort = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        self.scan = self.create_publisher(String, '/scan', best_effort)
        self.create_timer(0.05, lambda: self.scan.publish(String(data='seen')))
        self.create_subscription(String, '/strict', lambda message: None, reliable)
        self.create_service(SetBool, '/set', self.set)
        self.create_service(SetBool, '/hang', self.hang)
        # Tools show no name with a part that begins so.
        self.create_service(SetBool, '/lab/_box/set', self.set)
        self.ask = self.create_client(SetBool, '/ask')

    def set(self, request, response):
        response.success = request.data
        response.message = 'set'
        return response

    def hang(self, request, response):
        say(['asked'])
        time.sleep(1000)
        return response

    def publishers_of(self, topic):
        return [[self.full(info), info.topic_type, str(info.topic_type_hash)] for info in self.get_publishers_info_by_topic(topic)]

    def servers_of(self, service):
        return [sorted(f'{space.rstrip("/")}/{name}' for name, space in self.get_node_names_and_namespaces() if service in self.services_of(name, space))]

    def services_of(self, name, space):
        try:
            return dict(self.get_service_names_and_types_by_node(name, space))
        except NodeNameNonExistentError:
            return {}

    def full(self, info):
        return info.node_namespace.rstrip('/') + '/' + info.node_name

    def served(self):
        return [self.ask.service_is_ready()]

    def call(self, data):
        if not self.ask.wait_for_service(20):
            return ['nobody serves it']
        answered = threading.Event()
        future = self.ask.call_async(SetBool.Request(data=data == 'true'))
        future.add_done_callback(lambda _: answered.set())
        if not answered.wait(20):
            return ['nobody answers']
        return [future.result().success, future.result().message]


def obey(peer):
    for line in sys.stdin:
        what, *words = line.split()
        say([what, *getattr(peer, what)(*words)])


rclpy.init()
peer = Peer()
executor = MultiThreadedExecutor(4)
executor.add_node(peer)
threading.Thread(target=obey, args=(peer,), daemon=True).start()
say(['ready'])
try:
    executor.spin()
except (KeyboardInterrupt, ExternalShutdownException):
    pass
