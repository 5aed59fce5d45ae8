"""All that a robot does of ROS 2, with roslibpy against the herald. Ends with `done`.

usage: ros2_with_roslibpy.py URL
"""

import os
import queue
import sys
import time

import roslibpy

# Seconds, longer on a busy machine.
PATIENCE = float(os.environ.get("STORY_PATIENCE", "60"))


def check(what, truth):
    if not truth:
        sys.exit(f"{what}: not so")
    print(what, flush=True)


def counts(ros, action, to):
    """What comes of a goal: its end, and the feedback before it."""
    heard = queue.Queue()
    client = roslibpy.ActionClient(ros, action, "herald_msgs/action/Count")
    told = lambda kind: lambda what: heard.put((kind, what))
    goal = client.send_goal(roslibpy.Goal({"to": to}), told("result"), told("feedback"), told("error"))
    client.wait_goal(goal, PATIENCE)
    feedback = []
    while True:
        kind, what = heard.get(timeout=PATIENCE)
        if kind != "feedback":
            return kind, what, feedback
        feedback.append(what["at"])


def greets(name, greetings):
    """A greeting of the crowd, which is named until there is one: what the node says before it hears of the subscription is lost."""
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline:
        name.publish(roslibpy.Message({"data": "crowd"}))
        try:
            return greetings.get(timeout=0.2)
        except queue.Empty:
            pass
    sys.exit("nobody greets")


def main(url):
    ros = roslibpy.Ros(url)
    ros.run(timeout=PATIENCE)

    said = queue.Queue()
    talk = roslibpy.Topic(ros, "/talk", "std_msgs/String")
    talk.subscribe(said.put)
    talk.publish(roslibpy.Message({"data": "to myself"}))
    check("a topic both ways", said.get(timeout=PATIENCE)["data"] == "to myself")
    greetings = queue.Queue()
    roslibpy.Topic(ros, "/greeting", "herald_msgs/msg/Greeting").subscribe(greetings.put)
    greeting = greets(roslibpy.Topic(ros, "/name", "std_msgs/msg/String"), greetings)
    check("a node's topic", greeting["text"] == "Hello, crowd" and greeting["stamp"]["sec"] > 1_500_000_000)
    check("its points", greeting["at"] == [{"x": 0.0, "y": 0.0, "z": 0.0}, {"x": 1.0, "y": 0.0, "z": 0.0}])

    greet = roslibpy.Service(ros, "/greet", "herald_msgs/srv/Greet")
    answer = greet.call(roslibpy.ServiceRequest({"name": "Jürgen"}), timeout=PATIENCE)
    check("a node's service", answer["greeting"]["wide"] == "HELLO, JÜRGEN" and answer["known"] is False)

    def light(request, response):
        response["success"], response["message"] = request["data"], "lit"
        return True

    roslibpy.Service(ros, "/lamp", "std_srvs/srv/SetBool").advertise(light)
    while "/lamp" not in ros.get_services():
        pass
    check("its type", ros.get_service_type("/lamp") == "std_srvs/srv/SetBool")
    answer = roslibpy.Service(ros, "/lamp", "std_srvs/SetBool").call(roslibpy.ServiceRequest({"data": True}), timeout=PATIENCE)
    check("a service of its own", answer == {"success": True, "message": "lit"})

    kind, end, feedback = counts(ros, "/count", 4)
    # The values of a result are what the action's result has, its status is beside them.
    check("an action's result", (kind, end["status"].name) == ("result", "SUCCEEDED") and end["values"] == {"counted": [1, 2, 3, 4]})
    check("an action's feedback", feedback == [1, 2, 3, 4])

    parameter = roslibpy.Param(ros, "/herald:salutation")
    check("a parameter", parameter.get() == "Hello")
    parameter.set("Hail")
    check("a parameter set", parameter.get() == "Hail")
    check("its name", "/herald:salutation" in ros.get_params())
    answer = greet.call(roslibpy.ServiceRequest({"name": "Jürgen"}), timeout=PATIENCE)
    check("set in the node", answer["greeting"]["text"] == "Hail, Jürgen" and answer["known"] is True)
    check("time", ros.get_time()["secs"] > 1_500_000_000)
    print("done", flush=True)
    ros.terminate()


main(sys.argv[1])
