"""What letters_rclpy.py is, by an independent DDS: a participant of Cyclone DDS that speaks as rmw_cyclonedds does. It has no node itself, and
knows those of others by what they say on ros_discovery_info."""

import json
import os
import queue
import sys
import time
from dataclasses import dataclass

from cyclonedds.core import Listener, Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import array, int64, sequence, uint8, uint64
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

# Seconds, longer on a busy machine.
LONGEST = float(os.environ.get("STORY_PATIENCE", "100"))
LARGE = "".join(chr(97 + at % 26) for at in range(1 << 20))
CLIENT = 0x0123456789ABCDEF


@dataclass
class String(IdlStruct, typename="std_msgs.msg.dds_.String_"):
    data: str


@dataclass
class Request(IdlStruct, typename="std_srvs.srv.dds_.SetBool_Request_"):
    client: uint64
    number: int64
    data: bool


@dataclass
class Response(IdlStruct, typename="std_srvs.srv.dds_.SetBool_Response_"):
    client: uint64
    number: int64
    success: bool
    message: str


@dataclass
class Gid(IdlStruct, typename="rmw_dds_common.msg.dds_.Gid_"):
    data: array[uint8, 16]


@dataclass
class NodeEntitiesInfo(IdlStruct, typename="rmw_dds_common.msg.dds_.NodeEntitiesInfo_"):
    node_namespace: str
    node_name: str
    reader_gid_seq: sequence[Gid]
    writer_gid_seq: sequence[Gid]


@dataclass
class ParticipantEntitiesInfo(IdlStruct, typename="rmw_dds_common.msg.dds_.ParticipantEntitiesInfo_"):
    gid: Gid
    node_entities_info_seq: sequence[NodeEntitiesInfo]


def qos(durability, depth):
    return Qos(
        Policy.Reliability.Reliable(duration(seconds=1)),
        durability,
        Policy.History.KeepLast(depth),
        Policy.DataRepresentation(use_cdrv0_representation=True),
    )


VOLATILE = qos(Policy.Durability.Volatile, 10)
LATCHED = qos(Policy.Durability.TransientLocal, 1)


def say(*what):
    print(json.dumps(what), flush=True)


def until(done):
    deadline = time.monotonic() + LONGEST
    while not done() and time.monotonic() < deadline:
        time.sleep(0.02)


class Hears(Listener):
    def __init__(self, take):
        super().__init__()
        self.take = take

    def on_data_available(self, reader):
        # None while it is being made.
        if reader is None:
            return
        for sample in reader.take(10):
            # Whoever leaves is told, too, by a sample without data.
            if sample.sample_info.valid_data:
                self.take(sample)


class Application:
    def __init__(self):
        self.participant = DomainParticipant(int(os.environ["ROS_DOMAIN_ID"]))
        self.heard, self.homes, self.answers = queue.Queue(), queue.Queue(), queue.Queue()
        self.of_nodes = {}
        self.route = self.writer("rt/route", String, LATCHED)
        self.route.write(String("by sea"))
        self.letters = self.writer("rt/letters", String)
        self.delivered = self.reader("rt/front/delivered", String, lambda said: self.heard.put(said.data))
        self.home_of = self.reader("rt/front/home", String, lambda said: self.homes.put(said.data), LATCHED)
        self.permits = self.writer("rr/permitReply", Response)
        self.asked = self.reader("rq/permitRequest", Request, self.permit)
        self.opens = self.writer("rq/front/openRequest", Request)
        self.opened = self.reader("rr/front/openReply", Response, self.answered)
        self.graph = self.reader("ros_discovery_info", ParticipantEntitiesInfo, self.tell, LATCHED)

    def writer(self, name, of, qos=VOLATILE):
        return DataWriter(self.participant, Topic(self.participant, name, of), qos=qos)

    def reader(self, name, of, take, qos=VOLATILE):
        hears = Hears(take)
        made = DataReader(self.participant, Topic(self.participant, name, of), qos=qos, listener=hears)
        # What came meanwhile.
        hears.on_data_available(made)
        return made

    def permit(self, request):
        message = "as it likes" if request.data else "never"
        self.permits.write(Response(request.client, request.number, request.data, message))

    def answered(self, response):
        if response.client == CLIENT:
            self.answers.put([response.success, response.message])

    def tell(self, of):
        nodes = [info.node_namespace.rstrip("/") + "/" + info.node_name for info in of.node_entities_info_seq]
        self.of_nodes[tuple(of.gid.data)] = nodes

    def carry(self, text):
        until(lambda: self.letters.get_matched_subscriptions() and self.delivered.get_matched_publications())
        self.letters.write(String(text))
        # What was delivered for others of this robot is heard, too.
        while not (told := self.heard.get(timeout=LONGEST)).endswith(text):
            pass
        return told

    def send(self, *words):
        return self.carry(" ".join(words))

    def send_large(self):
        return self.carry(LARGE) == "by sea: " + LARGE

    def home(self):
        return self.homes.get(timeout=LONGEST)

    def open(self, data):
        # Both ends of the server.
        until(lambda: self.opens.get_matched_subscriptions() and self.opened.get_matched_publications())
        self.opens.write(Request(CLIENT, 1, data == "true"))
        return self.answers.get(timeout=LONGEST)

    def nodes(self):
        return sorted(node for nodes in list(self.of_nodes.values()) for node in nodes)


application = Application()
say("ready")
for line in sys.stdin:
    what, *words = line.split()
    say(what, getattr(application, what)(*words))
