"""The robot of the demo of ROS 2: roslibpy, unmodified, asking where a chessboard is in recorded pictures.

It knows nothing of Cloudroid: it publishes /camera_info and /image and subscribes to what board_pose answers, as it
would with a rosbridge beside the node. What it is answered it compares with the poses that were recorded with the
pictures, and it ends with status 1 unless all of them are right.
"""

import argparse
import queue
import sys
import time

import cv2
import numpy
import roslibpy

from asking import ANSWER_WITHIN, answer_to, await_subscriber, image_message, picture_of, stamp_seconds
from recorded import Recording, loaded

# How far an answer may be from what was recorded. The recorded poses were computed with all pictures, by another
# version of OpenCV; in the worst of the pictures, which is blurred, that makes 1 mm and 0.6 degrees.
METRES = 0.003
DEGREES = 1.5


def header(sequence):
    """std_msgs/Header of ROS 2."""
    return {"stamp": {"sec": stamp_seconds(sequence), "nanosec": 0}, "frame_id": "camera"}


def camera_info(recording, sequence):
    """sensor_msgs/CameraInfo of the recording's camera."""
    matrix = recording.matrix
    projection = numpy.hstack([matrix, numpy.zeros((3, 1))])
    return {
        "header": header(sequence),
        "height": recording.height,
        "width": recording.width,
        "distortion_model": "plumb_bob",
        "d": recording.distortion.tolist(),
        "k": matrix.ravel().tolist(),
        "r": numpy.eye(3).ravel().tolist(),
        "p": projection.ravel().tolist(),
    }


def apart(pose, rotation, translation):
    """How far a geometry_msgs/Pose is from a recorded one: metres, degrees."""
    place = numpy.array([pose["position"][axis] for axis in "xyz"])
    turned = numpy.array([pose["orientation"][part] for part in "xyzw"])
    angle = numpy.linalg.norm(rotation)
    recorded = numpy.append(rotation / angle * numpy.sin(angle / 2), numpy.cos(angle / 2))
    # A quaternion and its negative are the same rotation. Of unit quaternions the chord between them is 2 sin(angle / 4);
    # what is none is far from all that are.
    chord = numpy.minimum(numpy.linalg.norm(turned - recorded), numpy.linalg.norm(turned + recorded))
    degrees = numpy.degrees(4 * numpy.arcsin(numpy.clip(chord / 2, 0, 1)))
    return numpy.linalg.norm(place - translation), degrees


def judged(poses, truth):
    """Whether this is what was recorded, and what to say of it; `truth` is None where there is no board."""
    if truth is None:
        return not poses, "no board, which is right" if not poses else "a board where there is none"
    if len(poses) != 1:
        return False, f"{len(poses)} boards where there is one"
    metres, degrees = apart(poses[0], *truth)
    right = bool(metres <= METRES and degrees <= DEGREES)
    distance = poses[0]["position"]["z"]
    return right, f"board at {distance:.3f} m, {metres * 1000:.1f} mm and {degrees:.2f}° from the recorded pose"


def check_board(client, recording):
    """Ends where the node looks for another board than the recording's."""
    for name in ("columns", "rows", "square"):
        has = roslibpy.Param(client, f"/board_pose:{name}").get(timeout=10)
        wanted = getattr(recording, name)
        if abs(has - wanted) > 1e-6:
            sys.exit(f"the node's parameter {name} is {has:g}, and of the recorded board it is {wanted:g}; push with --param {name}={wanted:g}")


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("url")
    parser.add_argument("--recording", default="/usr/share/doc/opencv-doc/examples/data", help="OpenCV's sample data")
    parser.add_argument("--without", action="append", default=[], help="a picture of the same size without a board")
    parser.add_argument("--picture", help="where the last annotated picture goes")
    arguments = parser.parse_args()
    recording = Recording.read(arguments.recording)

    began = time.monotonic()
    client = roslibpy.Ros(arguments.url)
    client.run(timeout=60)
    print(f"connected to {arguments.url} in {time.monotonic() - began:.2f} s", flush=True)

    answers, annotated = queue.Queue(), queue.Queue()
    roslibpy.Topic(client, "/board_pose/poses", "geometry_msgs/msg/PoseArray").subscribe(answers.put)
    roslibpy.Topic(client, "/board_pose/image", "sensor_msgs/msg/Image").subscribe(annotated.put)
    cameras = roslibpy.Topic(client, "/camera_info", "sensor_msgs/msg/CameraInfo")
    cameras.advertise()
    images = roslibpy.Topic(client, "/image", "sensor_msgs/msg/Image")
    images.advertise()
    for topic in ("/camera_info", "/image"):
        await_subscriber(client, topic, "rosapi_msgs/srv/Subscribers")
    check_board(client, recording)

    pictures = [(path, (rotation, translation)) for path, rotation, translation in recording.boards]
    pictures += [(path, None) for path in arguments.without]
    right = 0
    first, times, written = None, [], False
    print(f"{'picture':>16}  {'RRT':>8}  answer", flush=True)
    for sequence, (path, truth) in enumerate(pictures):
        name, picture = path.rsplit("/", 1)[-1], loaded(path)
        sent = time.monotonic()
        cameras.publish(camera_info(recording, sequence))
        images.publish(image_message(picture, header(sequence)))
        answer = answer_to(sequence, answers, sent + ANSWER_WITHIN)
        if answer is None:
            print(f"{name:>16}  no answer within {ANSWER_WITHIN:.0f} s", flush=True)
            continue
        times.append(time.monotonic() - sent)
        first = first or time.monotonic() - began
        is_right, said = judged(answer["poses"], truth)
        right += is_right
        print(f"{name:>16}  {times[-1] * 1000:>5.0f} ms  {said}{'' if is_right else ': WRONG'}", flush=True)
        drawn = answer_to(sequence, annotated, time.monotonic() + ANSWER_WITHIN)
        if arguments.picture and drawn is not None and truth is not None:
            written = cv2.imwrite(arguments.picture, picture_of(drawn))
    client.terminate()

    if written:
        print(f"wrote {arguments.picture}: the servant's picture, the board's corners and axes drawn in", flush=True)
    if times:
        median = sorted(times)[len(times) // 2]
        print(f"first answer {first:.2f} s after connecting began; RRT {median * 1000:.0f} ms (median)", flush=True)
    print(f"{right} of {len(pictures)} pictures answered as recorded", flush=True)
    sys.exit(0 if right == len(pictures) else 1)


if __name__ == "__main__":
    main()
