"""Has adder_py add with roslibpy, twenty times a second, until its standard input ends. Prints `added` after the first sum.

usage: adds_with_roslibpy.py URL
"""

import os
import sys
import threading

import roslibpy

# Seconds, longer on a busy machine.
PATIENCE = float(os.environ.get("STORY_PATIENCE", "60"))


def main(url):
    ros = roslibpy.Ros(url)
    ros.run(timeout=PATIENCE)
    adder = roslibpy.Service(ros, "/add_two", "adder_py/AddTwo")
    over = threading.Event()
    threading.Thread(target=lambda: (sys.stdin.read(), over.set()), daemon=True).start()
    number = 0
    while not over.wait(0.05):
        # Of negative sums the node warns.
        a = -40 - number % 5
        answer = adder.call(roslibpy.ServiceRequest({"a": a, "b": 0}), timeout=PATIENCE)
        if answer["sum"] != a:
            sys.exit(f"{a} and 0 are not {answer}")
        if number == 0:
            print("added", flush=True)
        number += 1
    ros.terminate()


main(sys.argv[1])
