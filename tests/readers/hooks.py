"""What Schemathesis is told of the daemon: how an archive is written, and what it must leave alone to come to an end."""

import schemathesis
from hypothesis import strategies as st

# The principal that asks: without it everything after would be refused.
OWN = "chief"

schemathesis.openapi.media_type("application/x-tar", st.binary(max_size=2048))


@schemathesis.serializer("application/x-tar")
def archive(context, value):
    return value if isinstance(value, bytes) else str(value).encode()


@schemathesis.hook
def before_call(context, case, kwargs):
    # What goes on without an end answers no reader that waits for it.
    if case.query and "follow" in case.query:
        case.query["follow"] = "false"
    if case.path_parameters and case.path_parameters.get("name") == OWN:
        case.path_parameters["name"] = "nobody"
