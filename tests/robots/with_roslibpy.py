"""All that a robot does, with roslibpy against rosbridge_fixture. Prints `end my servant` and expects to be connected to a
new one; ends with `done`.

usage: with_roslibpy.py URL
"""

import os
import queue
import sys

import roslibpy
import roslibpy.ros1.actionlib as actionlib

# Seconds, longer on a busy machine.
PATIENCE = float(os.environ.get("STORY_PATIENCE", "60"))


def check(what, truth):
    if not truth:
        sys.exit(f"{what}: not so")
    print(what, flush=True)


def main(url):
    ros = roslibpy.Ros(url)
    ros.run(timeout=PATIENCE)

    said = queue.Queue()
    talk = roslibpy.Topic(ros, "/talk", "std_msgs/String")
    talk.subscribe(said.put)
    talk.publish(roslibpy.Message({"data": "to myself"}))
    check("a topic both ways", said.get(timeout=PATIENCE)["data"] == "to myself")
    greetings = queue.Queue()
    roslibpy.Topic(ros, "/listener", "std_msgs/String").subscribe(greetings.put)
    check("a node's topic", greetings.get(timeout=PATIENCE)["data"] == "Hello, World")

    adder = roslibpy.Service(ros, "/add_two_ints", "rospy_tutorials/AddTwoInts")
    answer = adder.call(roslibpy.ServiceRequest({"a": 40, "b": 2}), timeout=PATIENCE)
    check("a node's service", answer["sum"] == 42)

    def light(request, response):
        response["success"], response["message"] = request["data"], "lit"
        return True

    lamp = roslibpy.Service(ros, "/lamp", "std_srvs/SetBool")
    lamp.advertise(light)
    serves = roslibpy.Service(ros, "/rosapi/services", "rosapi/Services")
    while "/lamp" not in serves.call(roslibpy.ServiceRequest(), timeout=PATIENCE)["services"]:
        pass
    answer = roslibpy.Service(ros, "/lamp", "std_srvs/SetBool").call(
        roslibpy.ServiceRequest({"data": True}), timeout=PATIENCE
    )
    check("a service of its own", answer == {"success": True, "message": "lit"})

    client = actionlib.ActionClient(ros, "/fibonacci", "actionlib_tutorials/FibonacciAction")
    goal = actionlib.Goal(client, roslibpy.Message({"order": 5}))
    heard = queue.Queue()
    goal.on("feedback", heard.put)
    goal.send()
    check("an action's result", goal.wait(PATIENCE)["sequence"] == [0, 1, 1, 2, 3, 5, 8])
    check("an action's feedback", heard.get(timeout=PATIENCE)["sequence"][:3] == [0, 1, 1])

    parameter = roslibpy.Param(ros, "/with_roslibpy/word")
    parameter.set({"of": ["many", 1, 2.5]})
    check("a parameter", parameter.get() == {"of": ["many", 1, 2.5]})
    parameter.delete()
    check("a parameter deleted", parameter.get() is None)
    check("time", ros.get_time()["secs"] > 1_500_000_000)

    # It connects again by itself and subscribes again to what it had.
    again = queue.Queue()
    ros.on("close", lambda _: again.put("lost"))
    print("end my servant", flush=True)
    check("lost", again.get(timeout=PATIENCE) == "lost")
    while not greetings.empty():
        greetings.get()
    check("heard again", greetings.get(timeout=PATIENCE)["data"] == "Hello, World")
    print("done", flush=True)
    ros.terminate()


main(sys.argv[1])
