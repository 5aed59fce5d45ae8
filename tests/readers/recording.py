"""Reads an MCAP file with the format's own Python packages, or makes one that no servant of ROS 1 takes.

usage: recording.py read FILE       prints its profile, its topics and the texts of each topic of strings, as JSON
       recording.py foreign FILE    writes one message of ROS 2
"""

import json
import sys

from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_ros1.decoder import DecoderFactory as Ros1
from mcap_ros2.decoder import DecoderFactory as Ros2


# How messages and their definitions are written, and what reads them.
FORMATS = {"ros1": ("ros1", "ros1msg", Ros1()), "ros2": ("cdr", "ros2msg", Ros2())}


def read(file):
    reader = make_reader(file)
    profile = reader.get_header().profile
    encoding, schema_encoding, decoders = FORMATS[profile]
    topics, texts = {}, {}
    for schema, channel, message in reader.iter_messages():
        assert channel.message_encoding == encoding and schema.encoding == schema_encoding, channel
        topics[channel.topic] = schema.name
        # The package for ROS 2 has no wide strings.
        if b"wstring" in schema.data:
            continue
        decoded = decoders.decoder_for(encoding, schema)(message.data)
        if schema.name in ("std_msgs/String", "std_msgs/msg/String"):
            texts.setdefault(channel.topic, []).append(decoded.data)
        elif channel.topic == "/sights/map":
            assert decoded.info.width == 100 and len(decoded.data) == 6000
        elif channel.topic == "/square":
            assert decoded.header.frame_id == "floor" and decoded.polygon.points[2].y == 1.5
    counted = sum(reader.get_summary().statistics.channel_message_counts.values())
    print(json.dumps({"profile": profile, "topics": topics, "texts": texts, "messages": counted}))


def foreign(file):
    writer = Writer(file)
    writer.start(profile="ros2")
    schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
    channel = writer.register_channel("/chatter", "cdr", schema)
    writer.add_message(channel, log_time=1, publish_time=1, data=b"\0\1\0\0\2\0\0\0a\0")
    writer.finish()


verb, path = sys.argv[1:]
with open(path, "rb" if verb == "read" else "wb") as opened:
    {"read": read, "foreign": foreign}[verb](opened)
