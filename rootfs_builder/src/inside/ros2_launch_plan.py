"""What a launch file of ROS 2 starts, as the image's own launch finds it out.

The launch service itself runs: includes, conditions, arguments, substitutions, events of started processes are its own. It is
kept from starting processes alone: each is written down when it would be started.
"""

import json
import logging
import os
import re
import signal
import tempfile

import ros2_components as components

# Seconds that a launch file may take.
PATIENCE = 60
# Files of parameters that launch_ros writes for a process that it is about to start.
OURS = os.path.join(tempfile.gettempdir(), "launch_params_")


class Words(logging.Handler):
    """What launch says went wrong."""

    def __init__(self):
        super().__init__(logging.ERROR)
        self.said = []

    def emit(self, record):
        self.said.append(record.getMessage())


def resolve(path, ask, plan, refused, give_up):
    """Adds the nodes of a launch file to a plan. `refused`: an exception; `give_up`: tells an error, whatever goes on."""
    try:
        import launch
        import launch.actions
        import launch.event_handlers
        import launch.events.process
        import launch.launch_description_sources
        import launch.logging
        import launch_ros.actions
    except ImportError as error:
        raise refused("no_launch", module=(error.name or "launch").partition(".")[0]) from error

    def over_time(_signal, _frame):
        # Whoever keeps it busy might also catch an exception.
        give_up(refused("launch", file=path, words="it was not resolved within %d seconds" % PATIENCE))
        os._exit(0)

    words = Words()
    # Loggers of launch keep what they are told to themselves.
    launch.logging.get_logger("launch").addHandler(words)
    recorder = Recorder(launch, launch_ros, plan, ask["params"])
    recorder.take_over()
    signal.signal(signal.SIGALRM, over_time)
    signal.alarm(PATIENCE)
    try:
        source = launch.launch_description_sources.AnyLaunchDescriptionSource(path)
        description = launch.launch_description_sources.get_launch_description_from_any_launch_file(path)
    except Exception as error:  # pylint: disable=broad-except
        raise refused("launch", file=path, words=str(error).strip() or type(error).__name__) from error
    declared = [argument.name for argument in description.get_launch_arguments()]
    unknown = [name for name in ask["args"] if name not in declared]
    if unknown:
        # Functions in it may ask for arguments that it does not declare.
        words_of = "the launch file declares no argument %s; available: %s"
        plan["warnings"].append(words_of % (", ".join(unknown), ", ".join(declared) or "none"))
    service = launch.LaunchService(noninteractive=True)
    include = launch.actions.IncludeLaunchDescription(source, launch_arguments=list(ask["args"].items()))
    service.include_launch_description(launch.LaunchDescription([include]))
    status = service.run()
    signal.alarm(0)
    if status != 0:
        said = [text.partition("(see debug for traceback): ")[2] or text for text in words.said]
        raise refused("launch", file=path, words="; ".join(said) or "launch ended with status %d" % status)
    nowhere = recorder.contain()
    if nowhere:
        raise refused("launch", file=path, words=nowhere)
    recorder.tell_what_is_left(service)
    if not plan["nodes"]:
        raise refused("launch", file=path, words="the launch file starts no node")


class Recorder:
    """Writes down what launch would start."""

    def __init__(self, launch, launch_ros, plan, params):
        self.launch, self.launch_ros, self.plan, self.params = launch, launch_ros, plan, params
        self.before = dict(os.environ)
        # Names of containers, each with what is loaded into it, in the order of loading.
        self.loads = []

    def take_over(self):
        """Puts this in the place of what starts processes, waits, or talks to nodes."""
        from launch.actions.execute_local import ExecuteLocal

        launch_ros, recorder = self.launch_ros, self

        def execute(action, context):
            action.prepare(context)
            recorder.record(action, context)

        def load(action, context):
            recorder.load(action, context)

        def at_once(action, _context):
            recorder.plan["warnings"].append("delayed actions of the launch file are executed at once")
            return list(getattr(action, "_TimerAction__actions"))

        ExecuteLocal.execute = execute
        self.launch.actions.TimerAction.execute = at_once
        for name, instead in (
            ("LifecycleNode", launch_ros.actions.Node.execute),
            ("LoadComposableNodes", load),
            ("RosTimer", at_once),
        ):
            kind = getattr(launch_ros.actions, name, None)
            if kind is not None:
                kind.execute = instead

    def load(self, action, context):
        """Writes down what a container would be asked for: launch itself makes the requests."""
        from launch_ros.actions.load_composable_nodes import get_composable_node_load_request as request

        target = getattr(action, "_LoadComposableNodes__target_container")
        is_action = isinstance(target, self.launch_ros.actions.Node)
        name = target.node_name if is_action else self.text(target, context)
        descriptions = getattr(action, "_LoadComposableNodes__composable_node_descriptions")
        made = [request(one, context) for one in descriptions]
        # Of one whose condition is not met there is none.
        self.loads.append((name, [components.request_of(one) for one in made if one is not None]))

    def contain(self):
        """Puts what is loaded into the containers that are started; what is wrong with that, in words."""
        names = [node["name"] for node in self.plan["nodes"] if node["named"]]
        for target, requests in self.loads:
            name = "/" + target.strip("/")
            if name in names:
                self.plan["components"].setdefault(name, []).extend(requests)
            elif requests:
                words = "it loads %s into %s, but starts no container of that name (it starts %s)"
                plugins = ", ".join(one["plugin_name"] for one in requests)
                return words % (plugins, name, ", ".join(names) or "none")
        return None

    def record(self, action, context):
        process = action.process_description
        command = [str(word) for word in process.final_cmd]
        if isinstance(action, self.launch_ros.actions.Node):
            self.plan["nodes"].append(self.node(action, context, command))
        else:
            words = "the launch file also runs %r, which is not a ROS node, so it is omitted"
            self.plan["warnings"].append(words % " ".join(command)[:200])
        # Those that wait for it to be started go on.
        started = self.launch.events.process.ProcessStarted(
            action=action,
            name=process.final_name,
            cmd=command,
            cwd=process.final_cwd,
            env=process.final_env,
            pid=os.getpid(),
        )
        context.emit_event_sync(started)

    def node(self, action, context, command):
        package, executable = self.text(action.node_package, context), self.text(action.node_executable, context)
        namespace, _, last = action.node_name.rpartition("/")
        named = not last.startswith("<")
        namespace = "" if namespace.startswith("<") else namespace
        program = command[0]
        stem = last if named else re.sub(r"\W", "_", os.path.splitext(os.path.basename(executable))[0])
        name = namespace.rstrip("/") + "/" + stem
        environment = process_environment(action.process_description.final_env, self.before)
        on_exit = getattr(action, "_ExecuteLocal__on_exit", None)
        on_exit = on_exit if isinstance(on_exit, (list, tuple)) else [on_exit]
        return {
            "name": name,
            # An executable may be a path: PREFIX/lib/PACKAGE/PROGRAM.
            "package": package or os.path.basename(os.path.dirname(program)),
            "executable": os.path.basename(executable) or os.path.basename(program),
            "argv": self.arguments(command, name if named else None),
            "remaps": dict(action.expanded_remapping_rules or []),
            "environment": environment,
            "directory": action.process_description.final_cwd,
            "respawn": bool(getattr(action, "_ExecuteLocal__respawn", False)),
            "respawn_delay": float(getattr(action, "_ExecuteLocal__respawn_delay", None) or 0.0),
            "required": any(isinstance(one, self.launch.actions.Shutdown) for one in on_exit),
            "named": named,
        }

    def text(self, substitutions, context):
        from launch.utilities import normalize_to_list_of_substitutions, perform_substitutions

        if substitutions is None:
            return ""
        return perform_substitutions(context, normalize_to_list_of_substitutions(substitutions))

    def arguments(self, command, name):
        """A command line without files that are gone when it is run.

        What a file has for a node by its name counts more than any `-p`, so launch writes a file to change that. Here both become `-p`, of
        which the last one counts.
        """
        words, changed_later = [], given_for(name, self.params)
        rest = list(command)
        while rest:
            word = rest.pop()
            if rest[-1:] != ["--params-file"]:
                words.insert(0, word)
                continue
            option = rest.pop()
            ours = word.startswith(OURS)
            found = parameters_in(word, name) if ours else texts_in(word, name)
            if ours or not changed_later.isdisjoint(found):
                words[:0] = [part for key, text in found.items() for part in ("-p", "%s:=%s" % (key, text))]
                changed_later.update(found)
            else:
                words[:0] = [option, word]
        return words

    def tell_what_is_left(self, service):
        handlers = getattr(service.context, "_event_handlers", [])
        if any(isinstance(one, self.launch.event_handlers.OnProcessExit) for one in handlers):
            words = "actions of the launch file on the exit of a process are ignored, except respawn and shutdown"
            self.plan["warnings"].append(words)
        self.plan["warnings"] = list(dict.fromkeys(self.plan["warnings"]))


def process_environment(environment, before):
    return {name: value for name, value in (environment or {}).items() if before.get(name) != value}


# Parameters


def given_for(node, params):
    """Names of the parameters that the deployer gives this node."""
    if node is None:
        return set()
    below = node.rstrip("/") + "/"
    names = [key[len(below) :] if key.startswith(below) else key.lstrip("~_/") for key in params]
    return {name.replace("/", ".") for name in names}


def texts_in(path, node):
    """What a file of the image has for a node whose name is known: the texts as they stand there, so that they are of the same types on a
    command line."""
    import yaml

    if node is None:
        return {}
    try:
        with open(path, encoding="utf-8") as file:
            root = yaml.compose(file, yaml.SafeLoader)
    except (OSError, ValueError, yaml.YAMLError):
        return {}
    found = {}
    for pattern, values in sections(plain(root), ""):
        if applies(pattern, node):
            found.update(flattened(values, ""))
    return found


def plain(node):
    """A tree of YAML with every value as the text that it is."""
    if node is None:
        return {}
    if node.id == "mapping":
        return {key.value: plain(value) for key, value in node.value}
    if node.id == "sequence":
        return "[%s]" % ", ".join(str(plain(one)) for one in node.value)
    # What has these is a string, and would be something else between brackets.
    if node.style or re.search(r"[][{}:#,]", node.value):
        return json.dumps(node.value)
    return node.value or "null"


def parameters_in(path, node):
    """Names and values, as `-p` has them, that a file of launch has for a node; of one whose name nobody knows, those for all nodes."""
    import yaml

    class Loader(yaml.SafeLoader):  # pylint: disable=too-many-ancestors
        pass

    # launch writes tuples as such; whoever reads the file for a node takes no notice of it.
    Loader.add_multi_constructor("tag:yaml.org,2002:python/", untagged)
    with open(path, encoding="utf-8") as file:
        tree = yaml.load(file, Loader) or {}
    found = {}
    for pattern, values in sections(tree, ""):
        if applies(pattern, node):
            found.update(flattened(values, ""))
    return {name: written(value) for name, value in found.items()}


def untagged(loader, _tag, node):
    if node.id == "sequence":
        return loader.construct_sequence(node, deep=True)
    return loader.construct_mapping(node, deep=True) if node.id == "mapping" else loader.construct_scalar(node)


def sections(tree, above):
    for key, value in tree.items():
        if key == "ros__parameters":
            yield above or "/", value or {}
        elif isinstance(value, dict):
            yield from sections(value, above.rstrip("/") + "/" + str(key).strip("/"))


def applies(pattern, node):
    if node is None:
        return pattern.strip("/") in ("*", "**")
    parts = [".*" if part == "**" else "[^/]*" if part == "*" else re.escape(part) for part in pattern.strip("/").split("/")]
    return re.fullmatch("/".join(parts), node.strip("/")) is not None


def flattened(values, above):
    found = {}
    for key, value in values.items():
        name = "%s.%s" % (above, key) if above else str(key)
        if isinstance(value, dict):
            found.update(flattened(value, name))
        else:
            found[name] = value
    return found


def written(value):
    """As the parser of `-p` reads it: YAML, on one line, of the value's own type."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        if value != value or value in (float("inf"), float("-inf")):
            return ".nan" if value != value else ".inf" if value > 0 else "-.inf"
        text = repr(value)
        return text if "." in text or "e" not in text else text.replace("e", ".0e")
    if isinstance(value, (list, tuple)):
        return "[%s]" % ", ".join(written(one) for one in value)
    if isinstance(value, int):
        return str(value)
    return json.dumps(str(value))
