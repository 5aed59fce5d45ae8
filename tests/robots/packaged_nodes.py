"""Pushes five packaged nodes and asks each of them something that only a working one answers rightly.

usage: packaged_nodes.py ADDRESS CLOUDROIDCTL   (CLOUDROID_HOME names the daemon)
"""

import base64
import os
import queue
import subprocess
import sys
import time

import cv2
import numpy
import roslibpy

DATA = "/usr/share/doc/opencv-doc/examples/data/"
# Seconds, longer on a busy machine.
PATIENCE = float(os.environ.get("STORY_PATIENCE", "60"))


def image(picture, encoding, sequence, frame="camera"):
    """sensor_msgs/Image of a picture of 8-bit channels."""
    height, width = picture.shape[:2]
    return {
        "header": {"seq": sequence, "stamp": {"secs": 1000 + sequence, "nsecs": 0}, "frame_id": frame},
        "height": height,
        "width": width,
        "encoding": encoding,
        "is_bigendian": 0,
        "step": picture[0].nbytes,
        "data": base64.b64encode(numpy.ascontiguousarray(picture)).decode(),
    }


def camera_info(width, height, sequence, baseline=0.0):
    """An ideal camera of 400 px focal length; `baseline` metres to its left stands the other one."""
    f, cx, cy = 400.0, width / 2.0, height / 2.0
    return {
        "header": {"seq": sequence, "stamp": {"secs": 1000 + sequence, "nsecs": 0}, "frame_id": "camera"},
        "height": height,
        "width": width,
        "distortion_model": "plumb_bob",
        "D": [0.0] * 5,
        "K": [f, 0, cx, 0, f, cy, 0, 0, 1],
        "R": [1, 0, 0, 0, 1, 0, 0, 0, 1],
        "P": [f, 0, cx, -f * baseline, 0, f, cy, 0, 0, 0, 1, 0],
    }


def pixels(message, dtype=numpy.uint8):
    """The picture of a sensor_msgs/Image, padding removed."""
    data = numpy.frombuffer(base64.b64decode(message["data"]), dtype=dtype)
    rows = data.reshape(message["height"], -1)
    channels = 3 if "8" in message["encoding"] and message["encoding"][:4] != "mono" else 1
    return rows[:, : message["width"] * channels].reshape(message["height"], message["width"], channels).squeeze()


def ask(address, service, inputs, output, output_type, messages, wanted=lambda answer: True):
    """Publishes `messages(sequence)` on `inputs` until something wanted comes on `output`."""
    client = roslibpy.Ros(f"ws://{address}/{service}?robot=tester")
    client.run(timeout=PATIENCE)
    answers = queue.Queue()
    roslibpy.Topic(client, output, output_type).subscribe(answers.put)
    topics = [roslibpy.Topic(client, name, kind) for name, kind in inputs]
    for topic in topics:
        topic.advertise()
    subscribers = roslibpy.Service(client, "/rosapi/subscribers", "rosapi/Subscribers")
    deadline = time.monotonic() + PATIENCE
    for name, _ in inputs:
        while not subscribers.call(roslibpy.ServiceRequest({"topic": name}), timeout=PATIENCE)["subscribers"]:
            if time.monotonic() > deadline:
                sys.exit(f"{service}: nobody subscribed to {name}")
    sequence = 0
    try:
        while time.monotonic() < deadline:
            for topic, message in zip(topics, messages(sequence)):
                topic.publish(message)
            sequence += 1
            try:
                answer = answers.get(timeout=5)
            except queue.Empty:
                continue
            if wanted(answer):
                return answer
        sys.exit(f"{service}: no answer on {output} within {PATIENCE:.0f} s")
    finally:
        client.close()  # not terminate: the other services share the reactor


def check(name, condition, seen):
    if not condition:
        sys.exit(f"{name}: the answer is wrong: {str(seen)[:500]}")
    print(f"{name}: answered", flush=True)


def main():
    address, cloudroidctl = sys.argv[1:3]

    def push(*arguments):
        done = subprocess.run([cloudroidctl, "push", *arguments], capture_output=True, text=True)
        if done.returncode != 0:
            sys.exit(f"push {arguments}: {done.stdout}{done.stderr}")

    capture = cv2.VideoCapture(DATA + "vtest.avi")
    street = capture.read()[1]
    next_street = capture.read()[1]
    footballer = cv2.imread(DATA + "messi5.jpg")
    left = cv2.cvtColor(cv2.imread(DATA + "aloeL.jpg"), cv2.COLOR_BGR2GRAY)[::2, ::2]
    right = cv2.cvtColor(cv2.imread(DATA + "aloeR.jpg"), cv2.COLOR_BGR2GRAY)[::2, ::2]

    push("--apt", "opencv_apps", "--name", "people", "--node", "people_detect", "--param", "debug_view=false")
    answer = ask(address, "people", [("/image", "sensor_msgs/Image")], "/people_detect/found",
                 "opencv_apps/RectArrayStamped", lambda n: [image(street, "bgr8", n)])
    check("people_detect", len(answer["rects"]) > 0, answer)

    cascades = "/usr/share/opencv4/haarcascades/haarcascade_"
    push("--apt", "opencv_apps", "--name", "faces", "--with", "opencv-data", "--node", "face_detection",
         "--param", "debug_view=false", "--param", f"face_cascade_name={cascades}frontalface_alt.xml",
         "--param", f"eyes_cascade_name={cascades}eye_tree_eyeglasses.xml")
    answer = ask(address, "faces", [("/image", "sensor_msgs/Image")], "/face_detection/faces",
                 "opencv_apps/FaceArrayStamped", lambda n: [image(footballer, "bgr8", n)])
    # His face is 41 pixels wide around (244, 112).
    faces = [face["face"] for face in answer["faces"]]
    check("face_detection", any(abs(f["x"] - 244) < 30 and abs(f["y"] - 112) < 30 for f in faces), answer)

    push("--apt", "opencv_apps", "--name", "flow", "--node", "fback_flow", "--param", "debug_view=false")
    answer = ask(address, "flow", [("/image", "sensor_msgs/Image")], "/fback_flow/flows",
                 "opencv_apps/FlowArrayStamped",
                 lambda n: [image(street if n % 2 == 0 else next_street, "bgr8", n)],
                 # The first picture has none before it to flow from.
                 wanted=lambda answer: answer["flow"])
    check("fback_flow", len(answer["flow"]) > 0, answer)

    push("--apt", "image_proc", "--node", "image_proc")
    height, width = left.shape
    answer = ask(address, "image_proc",
                 [("/image_raw", "sensor_msgs/Image"), ("/camera_info", "sensor_msgs/CameraInfo")],
                 "/image_rect", "sensor_msgs/Image",
                 lambda n: [image(left, "mono8", n), camera_info(width, height, n)])
    difference = numpy.abs(pixels(answer).astype(int) - left.astype(int)).mean()
    check("image_proc", difference < 1.0, difference)

    push("--apt", "stereo_image_proc", "--node", "stereo_image_proc")
    answer = ask(address, "stereo_image_proc",
                 [("/left/image_raw", "sensor_msgs/Image"), ("/left/camera_info", "sensor_msgs/CameraInfo"),
                  ("/right/image_raw", "sensor_msgs/Image"), ("/right/camera_info", "sensor_msgs/CameraInfo")],
                 "/disparity", "stereo_msgs/DisparityImage",
                 lambda n: [image(left, "mono8", n), camera_info(width, height, n),
                            image(right, "mono8", n), camera_info(width, height, n, baseline=0.1)])
    disparity = pixels(answer["image"], numpy.float32)
    check("stereo_image_proc", (disparity > 10).mean() > 0.1, (disparity > 10).mean())


if __name__ == "__main__":
    main()
