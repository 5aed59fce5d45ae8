"""A node of rclpy with one end of the actions /fib and /echo: `fibonacci.py server` or `fibonacci.py client`. It answers by lines
of JSON.

The server refuses negative orders, aborts order 7, does not have order 13 cancelled, and is killed while it carries out order 99;
/echo gives back what it is given, as feedback and as its result.
The client is told by lines on its standard input: `goal ORDER`, `cancel`, which is for the last goal, and `echo NUMBER`.
"""

import json
import os
import signal
import sys
import threading
import time

import rclpy
from rclpy.action import ActionClient, ActionServer, CancelResponse, GoalResponse
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node
from test_msgs.action import Fibonacci, NestedMessage


def say(*what):
    # In one piece: several threads may have something to say.
    sys.stdout.write(json.dumps(what) + '\n')
    sys.stdout.flush()


class Server(Node):
    def __init__(self):
        super().__init__('fibonacci', namespace='/lab')
        self.action = ActionServer(
            self, Fibonacci, '/fib', self.execute,
            goal_callback=self.judge, cancel_callback=self.may_cancel)
        self.echoing = ActionServer(self, NestedMessage, '/echo', self.echo)

    def echo(self, goal):
        same = {field: getattr(goal.request, field) for field in goal.request.get_fields_and_field_types()}
        goal.publish_feedback(NestedMessage.Feedback(**same))
        goal.succeed()
        return NestedMessage.Result(**same)

    def judge(self, goal):
        return GoalResponse.REJECT if goal.order < 0 else GoalResponse.ACCEPT

    def may_cancel(self, goal):
        return CancelResponse.REJECT if goal.request.order == 13 else CancelResponse.ACCEPT

    def execute(self, goal):
        order = goal.request.order
        sequence = [0, 1]
        for i in range(1, order):
            if goal.is_cancel_requested:
                goal.canceled()
                return Fibonacci.Result(sequence=sequence)
            if order == 99 and i == 3:
                os.kill(os.getpid(), signal.SIGKILL)
            sequence.append((sequence[i] + sequence[i - 1]) % 1000)
            goal.publish_feedback(Fibonacci.Feedback(sequence=sequence))
            time.sleep(0.02)
        if order == 7:
            goal.abort()
        else:
            goal.succeed()
        return Fibonacci.Result(sequence=sequence)


class Client(Node):
    def __init__(self):
        super().__init__('fibonacci', namespace='/lab')
        self.action = ActionClient(self, Fibonacci, '/fib')
        self.echoing = ActionClient(self, NestedMessage, '/echo')
        self.last = None
        threading.Thread(target=self.obey, daemon=True).start()

    def obey(self):
        for line in sys.stdin:
            what, *words = line.split()
            getattr(self, what)(*words)

    def there(self):
        say('there', self.action.wait_for_server(20))

    def goal(self, order):
        goal = Fibonacci.Goal(order=int(order))
        sent = self.action.send_goal_async(goal, feedback_callback=self.feedback)
        sent.add_done_callback(self.answered)

    def echo(self, number):
        self.echoing.wait_for_server(20)
        goal = NestedMessage.Goal()
        goal.nested_field.int64_value = int(number)
        goal.nested_field.bool_value = True
        goal.nested_different_pkg.sec = 7
        self.echoing.send_goal_async(goal, feedback_callback=self.echoed).add_done_callback(
            lambda done: done.result().get_result_async().add_done_callback(
                lambda ended: say('echo', *self.nested(ended.result().result))))

    def echoed(self, message):
        say('echoed', *self.nested(message.feedback))

    def nested(self, message):
        field = message.nested_field
        return [field.int64_value, field.bool_value, message.nested_different_pkg.sec]

    def cancel(self):
        self.last.cancel_goal_async().add_done_callback(self.cancelled)

    def feedback(self, message):
        say('feedback', list(message.feedback.sequence))

    def answered(self, done):
        # Another thread may hear of another goal meanwhile.
        goal = self.last = done.result()
        say('goal', goal.accepted, bytes(goal.goal_id.uuid).hex())
        if goal.accepted:
            goal.get_result_async().add_done_callback(self.ended)

    def ended(self, done):
        say('ended', done.result().status, list(done.result().result.sequence))

    def cancelled(self, done):
        say('cancel', len(done.result().goals_canceling), done.result().return_code)


rclpy.init()
node = {'server': Server, 'client': Client}[sys.argv[1]]()
executor = MultiThreadedExecutor(4)
executor.add_node(node)
say('ready')
try:
    executor.spin()
except (KeyboardInterrupt, ExternalShutdownException):
    pass
