"""Two nodes of one process, /alto and /low/tenor, which know each other's names as everybody does. They are asked by lines on the standard input, and
answer by lines of JSON; the first one says that they are ready.
"""

import json
import sys
import threading

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import String
from std_srvs.srv import SetBool


def say(what):
    print(json.dumps(what), flush=True)


class Voice(Node):
    def __init__(self, name, namespace):
        super().__init__(name, namespace=namespace)
        self.declare_parameter('pitch', name)
        full = self.get_fully_qualified_name()
        self.alone = self.create_publisher(String, '~/song', 10)
        self.both = self.create_publisher(String, '/songs', 10)
        self.create_subscription(String, '~/note', lambda note: self.sing(full, note.data), 10)

    def sing(self, name, note):
        for song in self.alone, self.both:
            song.publish(String(data='%s: %s' % (name, note)))


def graph(voice, name, namespace):
    """What the graph of rmw has of a node."""
    publishes = voice.get_publisher_names_and_types_by_node(name, namespace)
    subscribes = voice.get_subscriber_names_and_types_by_node(name, namespace)
    serves = voice.get_service_names_and_types_by_node(name, namespace)
    return [[topic for topic, _ in ends] for ends in (publishes, subscribes, serves)]


def obey(voice):
    for line in sys.stdin:
        what, *words = line.split()
        if what == 'graph':
            while (words[0], words[1]) not in voice.get_node_names_and_namespaces():
                pass
            say([what, *graph(voice, *words)])
        elif what == 'publishers':
            say([what, *[end.node_name for end in voice.get_publishers_info_by_topic(*words)]])


rclpy.init(args=sys.argv)
executor = SingleThreadedExecutor()
voices = Voice('alto', '/'), Voice('tenor', '/low')
for voice in voices:
    executor.add_node(voice)
lost = voices[1].create_client(SetBool, '/lost')
threading.Thread(target=obey, args=(voices[0],), daemon=True).start()
say(['ready'])
try:
    executor.spin()
except (KeyboardInterrupt, ExternalShutdownException):
    pass
