"""The robot of the demo: roslibpy, unmodified, looking for people in recorded pictures.

It knows nothing of Cloudroid: it publishes /image and subscribes to what people_detect answers, as it would
with a rosbridge beside the node.
"""

import argparse
import queue
import sys
import time

import cv2
import roslibpy

from asking import ANSWER_WITHIN, answer_to, await_subscriber, image_message, picture_of, stamp_seconds


def frames(video, stills, count):
    """Yields (name, bgr8 picture): every tenth frame of the video, then the stills."""
    capture = cv2.VideoCapture(video)
    if not capture.isOpened():
        sys.exit(f"{video}: cannot be opened; is Debian's opencv-doc installed?")
    index = taken = 0
    while taken < count:
        ok, picture = capture.read()
        if not ok:
            break
        if index % 10 == 0:
            yield f"vtest.avi #{index}", picture
            taken += 1
        index += 1
    for path in stills:
        picture = cv2.imread(path)
        if picture is None:
            sys.exit(f"{path}: cannot be read; is Debian's opencv-doc installed?")
        yield path.rsplit("/", 1)[-1], picture


def header(sequence):
    """std_msgs/Header of ROS 1."""
    return {"seq": sequence, "stamp": {"secs": stamp_seconds(sequence), "nsecs": 0}, "frame_id": "camera"}


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("url")
    parser.add_argument("--video", default="/usr/share/doc/opencv-doc/examples/data/vtest.avi")
    parser.add_argument("--still", action="append", default=[])
    parser.add_argument("--frames", type=int, default=12)
    parser.add_argument("--picture", help="where the annotated picture goes")
    arguments = parser.parse_args()

    began = time.monotonic()
    client = roslibpy.Ros(arguments.url)
    client.run(timeout=60)
    print(f"connected to {arguments.url} in {time.monotonic() - began:.2f} s", flush=True)

    answers, annotated = queue.Queue(), queue.Queue()
    found = roslibpy.Topic(client, "/people_detect/found", "opencv_apps/RectArrayStamped")
    found.subscribe(answers.put)
    drawn = roslibpy.Topic(client, "/people_detect/image", "sensor_msgs/Image")
    drawn.subscribe(annotated.put)
    images = roslibpy.Topic(client, "/image", "sensor_msgs/Image")
    images.advertise()
    # The detector subscribes only while somebody wants its answers.
    await_subscriber(client, "/image", "rosapi/Subscribers")

    people = asked = answered = best = 0
    best_picture = None
    print(f"{'frame':>24}  {'people':>6}  {'RRT':>8}", flush=True)
    for sequence, (name, picture) in enumerate(frames(arguments.video, arguments.still, arguments.frames)):
        asked += 1
        sent = time.monotonic()
        images.publish(image_message(picture, header(sequence)))
        answer = answer_to(sequence, answers, sent + ANSWER_WITHIN, "secs")
        if answer is None:
            print(f"{name:>24}  no answer within {ANSWER_WITHIN:.0f} s", flush=True)
            continue
        answered += 1
        rects = answer["rects"]
        people += len(rects)
        print(f"{name:>24}  {len(rects):>6}  {(time.monotonic() - sent) * 1000:>5.0f} ms", flush=True)
        picture_back = answer_to(sequence, annotated, time.monotonic() + ANSWER_WITHIN, "secs")
        if picture_back is not None and len(rects) > best:
            best, best_picture = len(rects), picture_back
    client.terminate()

    if arguments.picture and best_picture is not None:
        cv2.imwrite(arguments.picture, picture_of(best_picture))
        print(f"wrote {arguments.picture}: the servant's picture with {best} people marked", flush=True)
    print(f"{answered} of {asked} frames answered, {people} people found", flush=True)
    sys.exit(0 if people > 0 and answered == asked else 1)


if __name__ == "__main__":
    main()
