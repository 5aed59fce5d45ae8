"""Reads an MCAP file with the format's own Python package, or makes one that no servant takes.

usage: recording.py read FILE       prints its profile, its topics and the texts of each topic of strings, as JSON
       recording.py foreign FILE    writes one message of ROS 2
"""

import json
import sys

from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_ros1.decoder import DecoderFactory


def read(file):
    reader = make_reader(file, decoder_factories=[DecoderFactory()])
    topics, texts = {}, {}
    for schema, channel, message, decoded in reader.iter_decoded_messages():
        assert channel.message_encoding == "ros1" and schema.encoding == "ros1msg", channel
        topics[channel.topic] = schema.name
        if schema.name == "std_msgs/String":
            texts.setdefault(channel.topic, []).append(decoded.data)
        elif channel.topic == "/sights/map":
            assert decoded.info.width == 100 and len(decoded.data) == 6000
    counted = sum(reader.get_summary().statistics.channel_message_counts.values())
    print(json.dumps({"profile": reader.get_header().profile, "topics": topics, "texts": texts, "messages": counted}))


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
