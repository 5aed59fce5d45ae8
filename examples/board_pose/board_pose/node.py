"""The node: a picture comes, the board's pose goes."""

import cv2
import rclpy
from geometry_msgs.msg import PoseArray
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import CameraInfo, Image

from board_pose import messages
from board_pose.finder import Board, draw, find

# A reason to leave pictures out is logged at most so often.
COMPLAIN_EVERY = 5.0  # seconds


class BoardPose(Node):
    """Answers each picture by the poses of the boards in it: one, or none."""

    def __init__(self):
        super().__init__("board_pose")
        corners = IntegerRange(from_value=2, to_value=100, step=1)
        self.declare("columns", 8, "How many inner corners a row of the board has.", corners)
        self.declare("rows", 6, "How many inner corners a column of the board has.", corners)
        sides = FloatingPointRange(from_value=0.001, to_value=10.0)
        self.declare("square", 0.025, "Side of a square, in metres.", sides)
        threads = IntegerRange(from_value=1, to_value=64, step=1)
        self.declare("threads", 1, "Threads of OpenCV.", threads, read_only=True)
        cv2.setNumThreads(self.get_parameter("threads").value)

        self.camera = None
        # A picture that came before the camera was known.
        self.waiting = None
        self.poses = self.create_publisher(PoseArray, "~/poses", 10)
        self.drawn = self.create_publisher(Image, "~/image", 1)
        self.create_subscription(CameraInfo, "camera_info", self.on_camera_info, 10)
        newest = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        # A network that loses parts of big pictures needs another quality of service, and the camera's driver one that fits.
        overridden = QoSOverridingOptions.with_default_policies()
        self.create_subscription(Image, "image", self.on_image, newest, qos_overriding_options=overridden)

    def declare(self, name, default, description, within, read_only=False):
        """Declares a parameter that is a number within a range."""
        descriptor = ParameterDescriptor(description=description, read_only=read_only)
        ranges = descriptor.integer_range if isinstance(within, IntegerRange) else descriptor.floating_point_range
        ranges.append(within)
        self.declare_parameter(name, default, descriptor)

    def on_camera_info(self, message):
        try:
            self.camera = messages.camera(message)
        except messages.Unusable as reason:
            self.complain(f"camera_info is left out: {reason}")
            return
        if self.waiting is not None:
            image, self.waiting = self.waiting, None
            self.on_image(image)

    def on_image(self, message):
        if self.camera is None:
            self.waiting = message
            return
        try:
            pixels = messages.picture(message)
        except messages.Unusable as reason:
            self.complain(f"image is left out: {reason}")
            return
        camera = self.camera
        if (camera.width, camera.height) != (message.width, message.height):
            self.complain(
                f"image of {message.width}x{message.height} is left out: camera_info is of {camera.width}x{camera.height}"
            )
            return
        board = Board(*(self.get_parameter(name).value for name in ("columns", "rows", "square")))
        found = find(messages.gray(pixels, message.encoding), board, camera)
        answer = PoseArray(header=message.header)
        if found is not None:
            answer.poses = [messages.pose(found)]
        self.poses.publish(answer)
        if self.drawn.get_subscription_count():
            picture = messages.colour(pixels, message.encoding)
            if found is not None:
                draw(picture, found, board, camera)
            self.drawn.publish(messages.image(picture, message.header))

    def complain(self, text):
        self.get_logger().warning(text, throttle_duration_sec=COMPLAIN_EVERY)


def main():
    rclpy.init()
    try:
        rclpy.spin(BoardPose())
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()
