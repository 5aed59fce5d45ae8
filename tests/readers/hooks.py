"""What Schemathesis is told of the daemon: how an archive is written, the names of what there is, and what it must leave alone to come to
an end. Half of its requests are about what there is; what was answered stands in a file, a line each."""

import collections
import json
import os

import schemathesis
from hypothesis import strategies as st

# What the story has made: names by collection, the files.
GIVEN = json.loads(os.environ["DESCRIBED"])
NAMES = GIVEN["names"]
# The principal that asks: without it everything after would be refused.
OWN = "chief"
# Names of what may be removed, by the operation that does; those that the requests make come to them.
SPARE = {
    "stopServant": GIVEN["spare"]["servants"],
    "removeRecording": GIVEN["spare"]["recordings"],
    "revokeToken": [],
    "removeAccount": [],
    "removeRule": [],
    "removeFromDictionary": [],
    # All else is of it: it goes last.
    "removeService": NAMES["services"] if GIVEN["last"] else [],
}
PASSWORD = GIVEN["password"]
TIMES = collections.Counter()


def rows():
    return {"rows": [{"measure": "rrt", "value": 0.1, "limits": {"cpus": 0.5}}]}


def made(kind):
    """A name that nothing has."""
    TIMES[kind] += 1
    return f"{kind}-{TIMES[kind]}"


# Bodies that make sense. Some hold what is good once.
BODIES = {
    "addRule": lambda: {"who": "role:robot", "services": "nothing", "allow": ["subscribe:/x"]},
    "changeAccount": lambda: {"disabled": False},
    "createAccount": lambda: {"name": made("account"), "password": PASSWORD, "role": "operator"},
    "createToken": lambda: {"name": made("token"), "role": "operator"},
    "orderRollout": lambda: {"order": "start", "revision": 1},
    "rollback": lambda: {"revision": 1},
    "setLimits": lambda: {"cpu_weight": 100},
    "signIn": lambda: {"name": GIVEN["person"], "password": PASSWORD},
    "writeDictionary": rows,
}
# The same of what stands behind the `?`.
QUERIES = {
    "calibrate": {"options": json.dumps({"source": "bag"})},
    "differences": {"from": 1, "to": 1},
    "logs": {"tail": 5},
    "push": {"options": "{}"},
    "pushOutput": {"follow": "false"},
    "recordings": {"robot": "rover"},
    "servantsHistory": {"robot": "rover"},
    "stopServants": {"service": NAMES["services"][0] if GIVEN["last"] else "nobody"},
    "trial": {"kind": "bag"},
}
# About what there is these wait for robots, or for whoever listens to leave.
WAITING = ["shadow", "topics"]
# What others need: Schemathesis itself asks again about names that it was told. By the operations that would spoil it, or never end.
SERVANTS = {*NAMES["servants"], *GIVEN["spare"]["servants"]}
KEPT = {
    "stopServant": set(NAMES["servants"]),
    "removeRecording": set(NAMES["recordings"]),
    "removeAccount": {GIVEN["person"]},
    "changeAccount": {GIVEN["person"]},
    "setLimits": SERVANTS,
    "topics": SERVANTS,
    "shadow": set(NAMES["services"]),
}

schemathesis.openapi.media_type("application/x-tar", st.binary(max_size=2048))


@schemathesis.serializer("application/x-tar")
def archive(context, value):
    return value if isinstance(value, bytes) else str(value).encode()


def id_of(case):
    return case.operation.definition.raw["operationId"]


def name_of(case, operation, parameter):
    """Of something that there is, in the place of a parameter; none where it would be missed."""
    if case.method.upper() == "DELETE" and operation in SPARE:
        spare = SPARE[operation]
        # Others are asked about the last one.
        return spare.pop(0) if len(spare) > 1 else (spare or [None])[0]
    if operation == "removeFromDictionary":
        return None
    before = case.operation.path.split("/")
    collection = before[before.index("{%s}" % parameter) - 1]
    return (NAMES.get(collection) or [None])[0]


def names(case, operation):
    """Puts what there is in the place of a random name."""
    for parameter in case.path_parameters or {}:
        is_row = operation == "removeFromDictionary" and parameter == "name"
        name = NAMES["services"][0] if is_row else name_of(case, operation, parameter)
        if name is not None:
            case.path_parameters[parameter] = name


@schemathesis.hook
def before_call(context, case, kwargs):
    operation = id_of(case)
    turn = TIMES[operation]
    TIMES[operation] += 1
    # By turns: all makes sense, nothing does, the name alone does, nothing does.
    makes_sense = turn % 4 == 0 and operation not in WAITING
    if case.method.upper() == case.operation.method.upper():
        if turn % 2 == 0:
            names(case, operation)
        if makes_sense:
            case.query = dict(QUERIES.get(operation, {}))
            if operation in BODIES:
                case.body = BODIES[operation]()
                case.media_type = "application/json"
    kept = {OWN} if makes_sense and operation in BODIES else {OWN, *KEPT.get(operation, ())}
    for parameter, name in (case.path_parameters or {}).items():
        if name in kept:
            case.path_parameters[parameter] = "nobody"
    # What goes on without an end answers no reader that waits for it.
    if case.query and "follow" in case.query:
        case.query["follow"] = "false"
    # Without a name it is about all.
    if operation == "stopServants" and not GIVEN["last"]:
        case.query = {**(case.query or {}), "service": "nobody"}


def learn(operation, answer):
    """Keeps the name of what was made, for those that change or remove it."""
    match operation:
        case "createToken":
            name = answer["token"]["name"]
            NAMES["tokens"] = [name]
            SPARE["revokeToken"].append(name)
        case "createAccount":
            others = [one["name"] for one in answer if one["name"] != GIVEN["person"]]
            SPARE["removeAccount"] = others
            NAMES["accounts"] = others[-1:]
        case "addRule":
            SPARE["removeRule"] = [str(rule["id"]) for rule in answer]
        case "writeDictionary":
            SPARE["removeFromDictionary"] = [str(row["id"]) for row in answer]
        case "takeRecording":
            SPARE["removeRecording"].append(str(answer["number"]))


@schemathesis.hook
def after_call(context, case, response):
    if case.method.upper() != case.operation.method.upper():
        return
    operation = id_of(case)
    with open(GIVEN["answers"], "a") as answers:
        answers.write(json.dumps({"operation": operation, "status": response.status_code}) + "\n")
    if response.status_code == 200 and "application/json" in response.headers.get("content-type", []):
        learn(operation, json.loads(response.content))
