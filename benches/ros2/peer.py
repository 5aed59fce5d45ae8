"""Nodes of rclpy that bench-ros2 is measured beside.

peer.py ROLE …: says {} when it is ready, then lines of JSON; a line on its standard input asks for one. The roles are
those of bus.rs, so that each side can be either's.
"""

import array
import json
import os
import resource
import sys
import threading
import time

import rclpy
from rclpy.action import ActionClient, ActionServer
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image
from std_msgs.msg import String
from std_srvs.srv import SetBool
from test_msgs.action import Fibonacci

RATE = 30
WARM = 10
TEXT = "a message of a usual size"


def say(**line):
    print(json.dumps(line), flush=True)


def processor():
    """Milliseconds so far."""
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return (usage.ru_utime + usage.ru_stime) * 1e3


def overflows():
    """Datagrams that found a receive buffer full, in this network."""
    with open("/proc/net/snmp") as file:
        names, values = [line.split() for line in file if line.startswith("Udp:")]
    return int(values[names.index("RcvbufErrors")])


def quality(reliable):
    policy = ReliabilityPolicy.RELIABLE if reliable == "1" else ReliabilityPolicy.BEST_EFFORT
    return QoSProfile(depth=5, reliability=policy)


def quantile(values, share):
    return sorted(values)[round((len(values) - 1) * share)] if values else None


def exchange(count, once):
    """Makes as many exchanges after those that warm up, one at a time."""
    say()
    times = []
    for number in range(int(count) + WARM):
        begun = time.perf_counter()
        once(number)
        times.append(time.perf_counter() - begun)
    micros(times[WARM:])


def micros(times):
    say(p50=quantile(times, 0.5) * 1e6, p99=quantile(times, 0.99) * 1e6)


def until(what, patience=15):
    limit = time.monotonic() + patience
    while not what():
        assert time.monotonic() < limit, "nobody is at the other end"
        time.sleep(0.002)


class Relay:
    """Brings pings back, answers calls, ends goals after one feedback, and publishes beats, so many each second."""

    def __init__(self, node, beats="0"):
        pong = node.create_publisher(String, "/pong", 10)
        node.create_subscription(String, "/ping", pong.publish, 10)
        node.create_service(SetBool, "/setbool", self.answer)
        self.server = ActionServer(node, Fibonacci, "/fibonacci", self.carry_out)
        beat = node.create_publisher(String, "/beat", 10)
        if float(beats) > 0:
            node.create_timer(1 / float(beats), lambda: beat.publish(String(data="beat")))
        say()

    @staticmethod
    def answer(request, response):
        response.success = request.data
        return response

    @staticmethod
    def carry_out(goal):
        goal.publish_feedback(Fibonacci.Feedback(sequence=[0, 1]))
        goal.succeed()
        return Fibonacci.Result(sequence=[0, 1])

    def tell(self):
        say()


class Takes:
    """Takes pictures, and tells of them when it is asked."""

    def __init__(self, node, reliable):
        self.came, self.reordered, self.last, self.ages = 0, 0, -1, []
        node.create_subscription(Image, "/pictures", self.take, quality(reliable))
        self.before, self.overflows = processor(), overflows()
        say()

    def take(self, picture):
        number = int(picture.header.frame_id)
        self.ages.append((time.time() - picture.header.stamp.sec) * 1e3 - picture.header.stamp.nanosec * 1e-6)
        self.came += 1
        self.reordered += number <= self.last
        self.last = max(self.last, number)

    def tell(self):
        say(
            came=self.came,
            reordered=self.reordered,
            processor=processor() - self.before,
            p50=quantile(self.ages, 0.5),
            p99=quantile(self.ages, 0.99),
            overflows=overflows() - self.overflows,
        )


class Works:
    """A role that works in a thread of its own, beside the executor."""

    def __init__(self, node, *words):
        self.node, self.words = node, words
        self.prepare(*words)
        threading.Thread(target=self.play, daemon=True).start()

    def play(self):
        try:
            self.work(*self.words)
        except BaseException as why:
            print(f"{type(self).__name__}: {why!r}", file=sys.stderr)
            os._exit(1)

    def tell(self):
        say()


class Sends(Works):
    """Sends pictures once somebody takes them."""

    def prepare(self, width, height, frames, reliable):
        self.camera = self.node.create_publisher(Image, "/pictures", quality(reliable))
        say()

    def work(self, width, height, frames, reliable):
        width, height, frames = int(width), int(height), int(frames)
        pixels = array.array("B", bytes(width * height * 3))
        until(self.camera.get_subscription_count)
        time.sleep(0.5)
        before, due, late = processor(), time.monotonic(), 0
        for number in range(frames):
            picture = Image(width=width, height=height, encoding="rgb8", step=width * 3, data=pixels)
            picture.header.frame_id = str(number)
            now = time.time()
            picture.header.stamp.sec, picture.header.stamp.nanosec = int(now), int(now % 1 * 1e9)
            self.camera.publish(picture)
            due += 1 / RATE
            late += time.monotonic() > due
            time.sleep(max(0, due - time.monotonic()))
        time.sleep(2)
        say(processor=processor() - before, late=late)


class Trips(Works):
    """Strings there and back, one at a time."""

    def prepare(self, count):
        self.came = threading.Event()
        self.ping = self.node.create_publisher(String, "/ping", 10)
        self.node.create_subscription(String, "/pong", lambda pong: self.came.set(), 10)

    def work(self, count):
        until(self.ping.get_subscription_count)
        until(lambda: self.ping.publish(String(data="first")) or self.came.wait(0.02))
        # The first may come more than once.
        time.sleep(0.2)
        exchange(count, self.bring_back)

    def bring_back(self, number):
        self.came.clear()
        self.ping.publish(String(data=f"{TEXT}, {number}"))
        assert self.came.wait(2), "no pong"


class Calls(Works):
    """Calls, one at a time."""

    def prepare(self, count):
        self.client = self.node.create_client(SetBool, "/setbool")

    def work(self, count):
        assert self.client.wait_for_service(15), "no server"
        exchange(count, lambda number: self.client.call(SetBool.Request(data=True)))


class Goals:
    """Goals from their sending to their result, one at a time. All in the executor's thread: a response that is quicker
    than the thread that sends a goal is taken for another client's."""

    def __init__(self, node, count):
        group = ReentrantCallbackGroup()
        self.client, self.count = ActionClient(node, Fibonacci, "/fibonacci", callback_group=group), int(count)
        self.start = node.create_timer(0.01, self.work, callback_group=group)

    async def work(self):
        self.start.cancel()
        assert self.client.wait_for_server(15), "no server"
        # It may not hear of our ends as early.
        time.sleep(0.5)
        say()
        times = []
        for _ in range(self.count + WARM):
            begun = time.perf_counter()
            goal = await self.client.send_goal_async(Fibonacci.Goal(order=2))
            assert goal.accepted
            await goal.get_result_async()
            times.append(time.perf_counter() - begun)
        micros(times[WARM:])

    def tell(self):
        say()


class Joins(Works):
    """Comes to a node that runs: a context of its own is a participant of its own."""

    def prepare(self):
        say()

    def work(self):
        begun, came = time.perf_counter(), {}
        context = rclpy.Context()
        rclpy.init(context=context)
        node = rclpy.create_node("newcomer", context=context)
        for name in ["beat", "pong"]:
            take = lambda message, name=name: came.setdefault(name, (time.perf_counter() - begun) * 1e3)
            node.create_subscription(String, f"/{name}", take, 10)
        ping = node.create_publisher(String, "/ping", 10)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        while len(came) < 2:
            assert time.perf_counter() - begun < 10, f"only {came}"
            ping.publish(String(data="ping"))
            executor.spin_once(timeout_sec=0.002)
        say(**came)


ROLES = {"relay": Relay, "takes": Takes, "sends": Sends, "trips": Trips, "calls": Calls, "goals": Goals, "joins": Joins}


def main(role, *words):
    rclpy.init()
    node = rclpy.create_node("peer")
    part = ROLES[role](node, *words)

    def answers():
        for _ in sys.stdin:
            part.tell()
        os._exit(0)

    threading.Thread(target=answers, daemon=True).start()
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    executor.spin()


if __name__ == "__main__":
    main(*sys.argv[1:])
