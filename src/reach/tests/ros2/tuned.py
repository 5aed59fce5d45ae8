"""Nodes of rclpy: /lab/tuned with parameters of all kinds, and /lab/staged with a lifecycle.

The first refuses a speed above 10, and says why. The second does not activate while its parameter `broken` is true, nor, if `shy` is,
while nobody subscribes to its output.
"""

import json

import rclpy
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_msgs.msg import String


class Tuned(Node):
    def __init__(self):
        super().__init__('tuned', namespace='/lab')
        self.declare_parameter('on', True)
        self.declare_parameter('count', 2**53 + 1)
        self.declare_parameter('name', 'gütig')
        self.declare_parameter('blob', [b'\x01', b'\xff'])
        self.declare_parameter('bools', [True, False])
        self.declare_parameter('ints', [1, -2])
        self.declare_parameter('doubles', [0.5, 2.0])
        self.declare_parameter('texts', ['a', ''])
        self.declare_parameter('arm.joint.gain', 3)
        self.declare_parameter('arm.length', 0.25)
        self.declare_parameter('unset', Parameter.Type.DOUBLE)
        self.declare_parameter('speed', 1.5, ParameterDescriptor(
            description='how fast', additional_constraints='not on stairs',
            floating_point_range=[FloatingPointRange(from_value=0.0, to_value=100.0, step=0.5)]))
        self.declare_parameter('level', 1, ParameterDescriptor(
            integer_range=[IntegerRange(from_value=-1, to_value=9, step=2)]))
        self.declare_parameter('serial', 'x1', ParameterDescriptor(read_only=True))
        self.declare_parameter('any', 1, ParameterDescriptor(dynamic_typing=True))
        self.add_on_set_parameters_callback(self.judge)

    def judge(self, parameters):
        for parameter in parameters:
            if parameter.name == 'speed' and parameter.value > 10:
                return SetParametersResult(successful=False, reason='too fast')
        return SetParametersResult(successful=True)


class Staged(LifecycleNode):
    def __init__(self):
        super().__init__('staged', namespace='/lab')
        self.declare_parameter('broken', False)
        self.declare_parameter('shy', False)
        self.seen = None

    def on_configure(self, state):
        if self.get_parameter('shy').value:
            self.seen = self.create_lifecycle_publisher(String, '/seen', 10)
        return super().on_configure(state)

    def on_activate(self, state):
        if self.get_parameter('broken').value:
            return TransitionCallbackReturn.FAILURE
        if self.seen is not None and self.seen.get_subscription_count() == 0:
            return TransitionCallbackReturn.FAILURE
        return super().on_activate(state)


rclpy.init()
executor = SingleThreadedExecutor()
for node in (Tuned(), Staged()):
    executor.add_node(node)
print(json.dumps(['ready']), flush=True)
try:
    executor.spin()
except (KeyboardInterrupt, ExternalShutdownException):
    pass
