"""Talks to sights_py with roslibpy, twenty words a second, until its standard input ends. Prints what it heard, as JSON.

usage: talks_with_roslibpy.py URL
"""

import json
import os
import sys
import threading
import time

import roslibpy

# Seconds, longer on a busy machine.
PATIENCE = float(os.environ.get("STORY_PATIENCE", "60"))


def main(url):
    ros = roslibpy.Ros(url)
    ros.run(timeout=PATIENCE)
    heard, begun = [], threading.Event()

    def hears(message):
        heard.append(message["data"])
        begun.set()

    roslibpy.Topic(ros, "/sights/said", "std_msgs/String").subscribe(hears)
    say = roslibpy.Topic(ros, "/sights/say", "std_msgs/String")
    say.advertise()
    over = threading.Event()
    threading.Thread(target=lambda: (sys.stdin.read(), over.set()), daemon=True).start()
    threading.Thread(target=lambda: (begun.wait(), print("heard", flush=True)), daemon=True).start()
    number = 0
    while not over.wait(0.05):
        number += 1
        say.publish(roslibpy.Message({"data": f"word {number}"}))
    deadline = time.monotonic() + PATIENCE
    while heard[-1:] != [f"word {number}"] and time.monotonic() < deadline:
        time.sleep(0.02)
    print(json.dumps(heard))
    ros.terminate()


main(sys.argv[1])
