"""What robots of the demo share: they send a picture, and wait for the answer that carries its stamp."""

import base64
import queue
import sys
import time

import numpy
import roslibpy

ANSWER_WITHIN = 30.0  # seconds for one picture; a detector under load is slow, never this slow


def stamp_seconds(sequence):
    """The seconds of the stamp of the picture with this number."""
    return 1000 + sequence


def image_message(picture, header):
    """sensor_msgs/Image of a bgr8 picture, as JSON for rosbridge."""
    height, width = picture.shape[:2]
    return {
        "header": header,
        "height": height,
        "width": width,
        "encoding": "bgr8",
        "is_bigendian": 0,
        "step": width * 3,
        "data": base64.b64encode(numpy.ascontiguousarray(picture)).decode(),
    }


def picture_of(message):
    """The bgr8 picture of a sensor_msgs/Image that came as JSON."""
    data = numpy.frombuffer(base64.b64decode(message["data"]), dtype=numpy.uint8)
    data = data.reshape(message["height"], message["step"])
    picture = data[:, : message["width"] * 3].reshape(message["height"], message["width"], 3)
    return picture[:, :, ::-1] if message["encoding"] == "rgb8" else picture


def answer_to(sequence, answers, deadline, seconds="sec"):
    """The answer that carries this picture's stamp; answers to earlier ones are passed over. None after the deadline.

    `seconds` is the name of the field, which is `secs` in ROS 1.
    """
    while True:
        remaining = deadline - time.monotonic()
        if remaining <= 0:
            return None
        try:
            answer = answers.get(timeout=remaining)
        except queue.Empty:
            return None
        if answer["header"]["stamp"][seconds] == stamp_seconds(sequence):
            return answer


def await_subscriber(client, topic, service_type):
    """Waits until a node listens to the topic; `service_type` is rosapi's, as the robot's ROS names it."""
    service = roslibpy.Service(client, "/rosapi/subscribers", service_type)
    deadline = time.monotonic() + ANSWER_WITHIN
    while time.monotonic() < deadline:
        if service.call(roslibpy.ServiceRequest({"topic": topic}), timeout=10)["subscribers"]:
            return
        time.sleep(0.05)
    sys.exit(f"nobody subscribed to {topic} within {ANSWER_WITHIN:.0f} s")
