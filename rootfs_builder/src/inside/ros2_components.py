"""Nodes that are loaded into component containers: what each container is asked for, as JSON of composition_interfaces/srv/LoadNode."""

import json
import os
import re

# What packages have registered, a line for each: CLASS;LIBRARY.
REGISTERED = "share/ament_index/resource_index/rclcpp_components"
# The package that has the container's program.
PACKAGE = "rclcpp_components"
PROGRAM = "component_container"
# By the numbers of rcl_interfaces/msg/ParameterType: the field of a value that counts.
FIELDS = {
    1: "bool_value",
    2: "integer_value",
    3: "double_value",
    4: "string_value",
    5: "byte_array_value",
    6: "bool_array_value",
    7: "integer_array_value",
    8: "double_array_value",
    9: "string_array_value",
}


def classes_of(spaces, package):
    """Classes of a package, as the first install space that lists any has them."""
    for space in spaces:
        path = os.path.join(space, REGISTERED, package)
        if os.path.isfile(path):
            with open(path, encoding="utf-8", errors="replace") as file:
                return [line.partition(";")[0].strip() for line in file if ";" in line]
    return []


def request(package, plugin, name="", namespace=""):
    return {
        "package_name": package,
        "plugin_name": plugin,
        "node_name": name,
        "node_namespace": namespace,
        "remap_rules": [],
        "parameters": [],
        "extra_arguments": [],
    }


def request_of(message):
    """A request that launch has made."""
    made = request(message.package_name, message.plugin_name, message.node_name, message.node_namespace)
    made["remap_rules"] = list(message.remap_rules)
    made["parameters"] = [parameter_of(one) for one in message.parameters]
    made["extra_arguments"] = [parameter_of(one) for one in message.extra_arguments]
    return made


def parameter_of(message):
    field = FIELDS.get(message.value.type)
    value = {"type": message.value.type}
    if field is not None:
        value[field] = plain(getattr(message.value, field))
    return {"name": message.name, "value": value}


def plain(value):
    """As JSON has it."""
    if isinstance(value, (bool, int, str)):
        return value
    if isinstance(value, bytes):
        return value[0] if value else 0
    if isinstance(value, float):
        if value != value or value in (float("inf"), float("-inf")):
            return "NaN" if value != value else "Infinity" if value > 0 else "-Infinity"
        return value
    return [plain(one) for one in value]


def kind_of(value):
    """The number of the type that a value has by itself; None where there is no such parameter."""
    if isinstance(value, list):
        kinds = {kind_of(one) for one in value}
        if kinds == {2, 3}:
            return 8
        return {1: 6, 2: 7, 3: 8, 4: 9}.get(kinds.pop()) if len(kinds) == 1 else None
    for kind, number in ((bool, 1), (int, 2), (float, 3), (str, 4)):
        if isinstance(value, kind):
            return number
    return None


def parameter(name, value, refused):
    kind = kind_of(value)
    if kind is None:
        words = "parameter %s of a component cannot be %s; allowed: true or false, a number, a text, or a list of one of these"
        raise refused("component", words=words % (name, json.dumps(value)))
    if kind in (3, 8):
        value = [float(one) for one in value] if kind == 8 else float(value)
    return {"name": name, "value": {"type": kind, FIELDS[kind]: plain(value)}}


def full_name(component):
    """The absolute name of its node; None where its program says it."""
    if not component["node_name"] or any(rule.startswith("__") for rule in component["remap_rules"]):
        return None
    return "/" + "/".join(part for part in (component["node_namespace"].strip("/"), component["node_name"]) if part)


def of_command_line(package, plugin, arguments, refused):
    """What is named by --node, with what a program would be given behind it."""
    component, words = request(package, plugin), list(arguments)
    while words:
        word = words.pop(0)
        if word in ("--ros-args", "--"):
            continue
        if word in ("-p", "--param") and words:
            name, equals, text = words.pop(0).partition(":=")
            if equals:
                put(component, [parameter(name, value_of(text), refused)])
                continue
        rule = words.pop(0) if word in ("-r", "--remap") and words else word
        source, equals, target = rule.partition(":=")
        if not equals or source.startswith("-"):
            said = "a component has no argument %r; remap names with FROM:=TO, and set parameters with -p NAME:=VALUE"
            raise refused("component", words=said % rule)
        if source in ("__node", "__name"):
            component["node_name"] = target
        elif source == "__ns":
            component["node_namespace"] = target
        else:
            component["remap_rules"].append(rule)
    return component


def value_of(text):
    """As rcl reads it: YAML."""
    try:
        import yaml
    except ImportError:
        yaml = None
    try:
        return json.loads(text) if yaml is None else yaml.safe_load(text)
    except Exception:  # pylint: disable=broad-except
        return text


def put(component, parameters):
    """Gives it parameters; of two of one name the later one counts."""
    names = {one["name"] for one in parameters}
    component["parameters"] = [one for one in component["parameters"] if one["name"] not in names] + parameters


def give(component, ask, refused):
    """Gives it what the push says for all nodes, for those without a namespace, and for it by its name."""
    component["remap_rules"] += ["%s:=%s" % rule for rule in ask["remaps"].items()]
    everybodys, its_own, own = {}, {}, full_name(component)
    for name, value in ask["params"].items():
        if not name.startswith("/"):
            its_own.update(flattened(dotted(name.lstrip("~_")), value))
        elif "/" not in name[1:]:
            everybodys.update(flattened(name[1:], value))
        elif own is not None and name.startswith(own + "/"):
            its_own.update(flattened(dotted(name[len(own) + 1 :]), value))
    everybodys.update(its_own)
    put(component, [parameter(name, value, refused) for name, value in everybodys.items()])


def dotted(name):
    return name.replace("/", ".")


def flattened(name, value):
    if not isinstance(value, dict):
        return {name: value}
    found = {}
    for below, inner in value.items():
        found.update(flattened("%s.%s" % (name, below), inner))
    return found


def container_name(plugin, taken):
    """For a container of its own."""
    stem = re.sub(r"\W", "_", plugin.rpartition("::")[2]) + "_container"
    name, number = stem, 1
    while "/" + name in taken:
        number += 1
        name = "%s_%d" % (stem, number)
    return name
