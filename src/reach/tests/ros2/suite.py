"""A node of rclpy, /lab/suite, for the cases of rosbridge_suite's tests of its WebSocket. It obeys lines on its
standard input and answers by lines of JSON; the first one says that it is ready.
"""

import json
import sys
import threading
import time

import rclpy
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import Float64MultiArray, String
from std_srvs.srv import SetBool

LOADS, LOAD_RATE, LOAD_NUMBERS, PROBE_RATE = 20, 100, 2048, 10


def say(*what):
    # In one piece: several threads may have something to say.
    sys.stdout.write(json.dumps(what) + '\n')
    sys.stdout.flush()


class Suite(Node):
    def __init__(self):
        super().__init__('suite', namespace='/lab')
        self.create_service(SetBool, '/hello', self.hello)
        self.create_service(SetBool, '/slow', self.slow)
        self.asking = self.create_client(SetBool, '/test_service')
        # What is created later is kept until the end.
        self.kept = []

    def hello(self, request, response):
        response.success, response.message = request.data, 'Hello, world!'
        return response

    def slow(self, request, response):
        time.sleep(0.2)
        return self.hello(request, response)

    def served(self):
        say('served', self.asking.wait_for_service(20))

    def ask(self, data):
        future = self.asking.call_async(SetBool.Request(data=data == 'true'))
        future.add_done_callback(lambda done: say('answer', done.result().success, done.result().message))

    def publishers(self, topic):
        say('publishers', self.count_publishers(topic))

    def hear(self, topic):
        self.kept.append(self.create_subscription(String, topic, lambda message: say('heard', message.data), 10))

    def tell(self, topic, text, times='1'):
        """So many messages, once somebody hears them."""
        publisher = self.create_publisher(String, topic, 10)
        self.kept.append(publisher)
        while not publisher.get_subscription_count():
            time.sleep(0.01)
        for _ in range(int(times)):
            publisher.publish(String(data=text))

    def keep(self, topic, text):
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        publisher = self.create_publisher(String, topic, latched)
        publisher.publish(String(data=text))
        self.kept.append(publisher)

    def repeat(self, topic, text):
        """Best effort, again and again."""
        best_effort = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        publisher = self.create_publisher(String, topic, best_effort)
        self.kept += [publisher, self.create_timer(0.05, lambda: publisher.publish(String(data=text)))]

    def load(self):
        """More than a client takes, and a heartbeat with its number."""
        loads = [self.create_publisher(Float64MultiArray, f'/load_{number}', 10) for number in range(LOADS)]
        message = Float64MultiArray(data=[0.0] * LOAD_NUMBERS)
        probe, number = self.create_publisher(String, '/probe', 10), 0

        def beat():
            nonlocal number
            probe.publish(String(data=str(number)))
            number += 1

        self.create_timer(1 / LOAD_RATE, lambda: [load.publish(message) for load in loads])
        self.create_timer(1 / PROBE_RATE, beat)


def obey(suite):
    for line in sys.stdin:
        what, *words = line.split()
        getattr(suite, what)(*words)


rclpy.init()
suite = Suite()
executor = MultiThreadedExecutor(4)
executor.add_node(suite)
threading.Thread(target=obey, args=(suite,), daemon=True).start()
say('ready')
try:
    executor.spin()
except (KeyboardInterrupt, ExternalShutdownException):
    pass
