"""ROS messages to and from what OpenCV works with."""

import array

import cv2
import numpy
from geometry_msgs.msg import Point, Pose, Quaternion
from sensor_msgs.msg import Image

from board_pose.finder import Camera, quaternion

CHANNELS = {"bgr8": 3, "rgb8": 3, "mono8": 1}
# Models whose coefficients OpenCV takes in the same order, with how many there are.
DISTORTIONS = {"plumb_bob": (0, 4, 5), "rational_polynomial": (8,)}


class Unusable(ValueError):
    """A message that nothing can be computed from."""


def picture(message):
    """The picture of a sensor_msgs/Image, as it is encoded: height x width, or height x width x 3."""
    channels = CHANNELS.get(message.encoding)
    if channels is None:
        known = ", ".join(CHANNELS)
        raise Unusable(f"encoding {message.encoding!r} is none of {known}")
    row = message.width * channels
    size = message.step * message.height
    if not row or not size or message.step < row or len(message.data) < size:
        raise Unusable(
            f"{len(message.data)} bytes, {message.step} a row, are no picture "
            f"of {message.width}x{message.height} in {message.encoding}"
        )
    rows = numpy.frombuffer(message.data, numpy.uint8, size).reshape(message.height, message.step)
    pixels = rows[:, :row]
    return pixels if channels == 1 else pixels.reshape(message.height, message.width, channels)


def gray(pixels, encoding):
    """The picture in grey."""
    if encoding == "mono8":
        return numpy.ascontiguousarray(pixels)
    return cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY if encoding == "rgb8" else cv2.COLOR_BGR2GRAY)


def colour(pixels, encoding):
    """A copy of the picture as bgr8, to draw into."""
    if encoding == "mono8":
        return cv2.cvtColor(pixels, cv2.COLOR_GRAY2BGR)
    return cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR) if encoding == "rgb8" else pixels.copy()


def camera(message):
    """The camera of a sensor_msgs/CameraInfo."""
    matrix = numpy.array(message.k).reshape(3, 3)
    # By the definition of CameraInfo, a camera that is not calibrated says so by this zero.
    if matrix[0, 0] == 0.0:
        raise Unusable("the camera is not calibrated: k[0] is 0")
    coefficients = numpy.array(message.d)
    if len(coefficients) and len(coefficients) not in DISTORTIONS.get(message.distortion_model, ()):
        known = ", ".join(DISTORTIONS)
        raise Unusable(
            f"distortion model {message.distortion_model!r} with {len(coefficients)} coefficients is none of {known}"
        )
    return Camera(matrix, coefficients, message.width, message.height)


def pose(found):
    """The geometry_msgs/Pose of a board that was found."""
    x, y, z = (float(part) for part in found.translation)
    turned = dict(zip("xyzw", quaternion(found.rotation)))
    return Pose(position=Point(x=x, y=y, z=z), orientation=Quaternion(**turned))


def image(pixels, header):
    """The sensor_msgs/Image of a bgr8 picture."""
    height, width = pixels.shape[:2]
    return Image(
        header=header,
        height=height,
        width=width,
        encoding="bgr8",
        step=width * 3,
        # Assigned as an array of bytes: of anything else each byte is looked at.
        data=array.array("B", pixels.tobytes()),
    )
