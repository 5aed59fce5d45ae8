"""A participant of Cyclone DDS that speaks as rmw_cyclonedds does, without nodes: it relays /ping to /pong, and serves /set.

It calls /ask when it is told to by a line on its standard input, or says whether somebody serves it, and answers by lines of JSON; the
first one says that it is ready.
"""

import json
import sys
import time
from dataclasses import dataclass

from cyclonedds.core import Listener, Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import int64, uint64
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration


@dataclass
class String(IdlStruct, typename='std_msgs.msg.dds_.String_'):
    data: str


@dataclass
class Request(IdlStruct, typename='std_srvs.srv.dds_.SetBool_Request_'):
    client: uint64
    number: int64
    data: bool


@dataclass
class Response(IdlStruct, typename='std_srvs.srv.dds_.SetBool_Response_'):
    client: uint64
    number: int64
    success: bool
    message: str


QOS = Qos(
    Policy.Reliability.Reliable(duration(seconds=1)),
    Policy.Durability.Volatile,
    Policy.History.KeepLast(10),
    Policy.DataRepresentation(use_cdrv0_representation=True),
)
CLIENT = 0x0123456789ABCDEF


def say(*what):
    print(json.dumps(what), flush=True)


class Hears(Listener):
    def __init__(self, take):
        super().__init__()
        self.take = take

    def on_data_available(self, reader):
        for sample in reader.take(10):
            # Otherwise it says that its writer is gone.
            if sample.sample_info.valid_data:
                self.take(sample)


participant = DomainParticipant(0)


def writer(name, of):
    return DataWriter(participant, Topic(participant, name, of), qos=QOS)


def reader(name, of, take):
    return DataReader(participant, Topic(participant, name, of), qos=QOS, listener=Hears(take))


def answer(request):
    response = Response(client=request.client, number=request.number, success=request.data, message='set')
    replies.write(response)


def answered(response):
    if response.client == CLIENT:
        say('call', response.number, response.success, response.message)


pong = writer('rt/pong', String)
ping = reader('rt/ping', String, pong.write)
replies = writer('rr/setReply', Response)
requests = reader('rq/setRequest', Request, answer)
asks = writer('rq/askRequest', Request)
answers = reader('rr/askReply', Response, answered)


def served():
    # Both ends of the server.
    return bool(asks.get_matched_subscriptions() and answers.get_matched_publications())


say('ready')
for number, line in enumerate(sys.stdin):
    if line.split() == ['served']:
        say('served', served())
        continue
    while not served():
        time.sleep(0.01)
    asks.write(Request(client=CLIENT, number=number, data=line.split() == ['call', 'true']))
