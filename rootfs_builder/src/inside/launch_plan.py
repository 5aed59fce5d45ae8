"""Asks the image's own roslaunch what a launch file (or an executable) means.

Runs in a container of the finished image. In: /cloudroid/ask.json. Out: /cloudroid/out/plan.json, which holds
either a plan or one `error`. Nothing is started and no Master is asked.
"""

import base64
import json
import math
import os
import re
import shlex
import subprocess
import sys
import traceback


class Refused(Exception):
    """What is asked for cannot be; `kind` tells the builder which error to show."""

    def __init__(self, kind, **about):
        super().__init__(kind)
        self.about = dict(about, kind=kind)


def source_setup(prefix):
    """The environment that the install space's own setup.sh makes, as far as it differs."""
    if not prefix:
        return {}
    before = dict(os.environ)
    if os.path.exists(os.path.join(prefix, "setup.sh")):
        script = '. "$0/setup.sh" >&2 && exec env -0'
        result = subprocess.run(["/bin/sh", "-c", script, prefix], stdout=subprocess.PIPE, check=False)
        if result.returncode != 0:
            raise Refused("setup", file=os.path.join(prefix, "setup.sh"), status=result.returncode)
        for item in result.stdout.decode("utf-8", "replace").split("\0"):
            name, equals, value = item.partition("=")
            if equals and name not in ("PWD", "OLDPWD", "SHLVL", "_"):
                os.environ[name] = value
    # What a hook of roslib adds where it is installed beside the others, and what a space without setup.sh needs.
    for name, directory in (
        ("CMAKE_PREFIX_PATH", ""),
        ("ROS_PACKAGE_PATH", "share"),
        ("PYTHONPATH", "lib/python3/dist-packages"),
        ("LD_LIBRARY_PATH", "lib"),
        ("PATH", "bin"),
    ):
        path = os.path.join(prefix, directory).rstrip("/")
        known = [p for p in os.environ.get(name, "").split(":") if p]
        if os.path.isdir(path) and path not in known:
            os.environ[name] = ":".join([path] + known)
    return {name: value for name, value in os.environ.items() if before.get(name) != value}


def is_executable(path):
    return os.path.isfile(path) and os.access(path, os.X_OK)


def prefixes():
    return [p for p in os.environ.get("CMAKE_PREFIX_PATH", "").split(":") if p]


def package_directory(rospack, package):
    import rospkg

    try:
        return rospack.get_path(package)
    except rospkg.ResourceNotFound:
        return None


def below(directory):
    for parent, directories, files in os.walk(directory):
        directories[:] = sorted(d for d in directories if not d.startswith(".") and d not in ("cmake", "__pycache__"))
        for name in sorted(files):
            yield os.path.join(parent, name)


def is_program(path):
    """Whether an executable is meant to be run: dynamic_reconfigure's .cfg files are for builds, and of files that are not
    installed as programs many are executable for no reason."""
    with open(path, "rb") as file:
        start = file.read(4)
    name = os.path.basename(path)
    return not name.endswith(".cfg") and name != "setup.py" and (start.startswith(b"#!") or start == b"\x7fELF")


def executables_of(rospack, package):
    """Names of what rosrun would find and is meant to be run, those of lib/PACKAGE first."""
    names = []
    for prefix in prefixes():
        directory = os.path.join(prefix, "lib", package)
        if os.path.isdir(directory):
            found = [n for n in sorted(os.listdir(directory)) if is_executable(os.path.join(directory, n))]
            names += [n for n in found if not n.endswith(".cfg")]
    if not names:
        share = package_directory(rospack, package)
        names = [os.path.basename(p) for p in below(share) if is_executable(p) and is_program(p)] if share else []
    return list(dict.fromkeys(names))


def launch_files_of(rospack, package):
    share = package_directory(rospack, package)
    return [os.path.relpath(p, share) for p in below(share) if p.endswith(".launch")] if share else []


def plain(value, where, warnings):
    """A parameter as JSON can say it."""
    if value is None or isinstance(value, (bool, int, str)):
        return value
    if isinstance(value, float):
        if math.isfinite(value):
            return value
        warnings.append("parameter %s is %r, which is not a finite number, so it is omitted" % (where, value))
        return None
    if isinstance(value, dict):
        return {str(k): plain(v, "%s/%s" % (where, k), warnings) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(v, where, warnings) for v in value]
    data = getattr(value, "data", value)
    if isinstance(data, (bytes, bytearray)):
        warnings.append("parameter %s is binary and is stored as base64 text" % where)
        return base64.b64encode(bytes(data)).decode("ascii")
    return str(value)


def find_launch_file(rospack, packages, asked):
    if os.path.isabs(asked) and os.path.isfile(asked):
        return asked
    known = []
    for package in packages:
        share = package_directory(rospack, package)
        if share is None:
            continue
        wanted = asked[len(package) + 1 :] if asked.startswith(package + "/") else asked
        for place in (wanted, os.path.join("launch", wanted)):
            if os.path.isfile(os.path.join(share, place)):
                return os.path.join(share, place)
        files = launch_files_of(rospack, package)
        known += files
        same = [f for f in files if os.path.basename(f) == wanted]
        if same:
            return os.path.join(share, same[0])
    raise Refused("not_found", what="launch file", name=asked, known=known)


def from_launch_file(ask, rospack, plan):
    import roslaunch
    import roslaunch.config
    import roslaunch.node_args
    import roslaunch.xmlloader

    path = find_launch_file(rospack, ask["packages"], ask["launch"])
    argv = ["%s:=%s" % (name, value) for name, value in ask["args"].items()]
    try:
        # roslaunch takes no notice of an argument that the file does not have; whoever misspelt one would like to know.
        arguments = roslaunch.xmlloader.XmlLoader(resolve_anon=False, args_only=True)
        arguments.ignore_unset_args = True
        arguments.load(path, roslaunch.config.ROSLaunchConfig(), argv=argv, verbose=False)
        declared = arguments.root_context.resolve_dict.get("arg_doc", {})
        unknown = [name for name in ask["args"] if name not in declared]
        if unknown:
            words = "it has no argument %s; available: %s" % (", ".join(unknown), ", ".join(declared) or "none")
            raise Refused("launch", file=path, words=words)
        loader = roslaunch.xmlloader.XmlLoader(resolve_anon=True)
        # Read by the loader but set only by roslaunch's own callers of it.
        loader.ignore_unset_args = False
        config = roslaunch.config.ROSLaunchConfig()
        loader.load(path, config, argv=argv, verbose=False)
        config.assign_machines()
        for error in config.config_errors:
            plan["warnings"].append("roslaunch: %s" % error)
        for node in config.nodes:
            plan["nodes"].append(describe(node, rospack))
    except (roslaunch.RLException, roslaunch.xmlloader.XmlParseException, roslaunch.node_args.NodeParamsException) as e:
        raise Refused("launch", file=path, words=str(e))
    for name, param in config.params.items():
        value = plain(param.value, name, plan["warnings"])
        if value is not None:
            plan["parameters"][name] = value
    if not plan["nodes"]:
        raise Refused("launch", file=path, words="the launch file starts no node")


def describe(node, rospack):
    import rosgraph.names
    import roslaunch.node_args
    from roslaunch.core import is_machine_local

    if node.machine is not None and not is_machine_local(node.machine):
        words = "node %s is assigned to machine %s, but a servant is one machine" % (node.name, node.machine.address)
        raise Refused("launch", file=node.filename, words=words)
    argv = roslaunch.node_args.create_local_process_args(node, node.machine)
    program = argv[len(shlex.split(node.launch_prefix)) if node.launch_prefix else 0]
    environment = {name: value for name, value in node.env_args}
    if node.namespace and node.namespace != "/":
        environment["ROS_NAMESPACE"] = node.namespace.rstrip("/")
    return {
        "name": rosgraph.names.ns_join(node.namespace or "/", node.name),
        "package": node.package,
        "executable": node.type,
        "argv": argv,
        "remaps": {source: target for source, target in node.remap_args},
        "environment": environment,
        "directory": os.path.dirname(program) if node.cwd == "node" else None,
        "respawn": bool(node.respawn),
        "respawn_delay": float(node.respawn_delay or 0.0),
        "required": bool(node.required),
    }


def find_executable(rospack, packages, asked):
    """Package, name and path of `EXE`, in one of these packages, or of `PACKAGE/EXE`, in any that the image has."""
    import roslib.packages

    package, slash, executable = asked.partition("/")
    places = [(p, asked[len(p) + 1 :] if asked.startswith(p + "/") else asked) for p in packages]
    for package, wanted in places + ([(package, executable)] if slash else []):
        if package_directory(rospack, package) is None:
            continue
        matches = roslib.packages.find_node(package, wanted, rospack=rospack)
        if matches:
            return package, wanted, matches[0]
    return None


def from_executables(ask, rospack, plan, names):
    taken, started = set(), set()
    for words in names:
        asked, *arguments = shlex.split(words) or [words]
        found = find_executable(rospack, ask["packages"], asked)
        if found is None:
            raise Refused("not_found", what="executable", name=asked, known=plan["executables"])
        package, wanted, path = found
        given = [argument[len("__name:=") :] for argument in arguments if argument.startswith("__name:=")]
        stem = re.sub(r"\W", "_", os.path.splitext(os.path.basename(wanted))[0])
        stem = stem if stem[:1].isalpha() else "node_" + stem
        stem = given[-1] if given else stem
        name, number = stem, 1
        while name in taken:
            number += 1
            name = "%s_%d" % (stem, number)
        taken.add(name)
        # As under rosrun the program names itself; the second node of a program would throw out the first.
        named = bool(given) or path in started
        started.add(path)
        plan["nodes"].append(
            {
                "name": "/" + name,
                "package": package,
                "executable": wanted,
                "argv": [path] + arguments + (["__name:=" + name] if named else []),
                "remaps": {},
                "environment": {},
                "directory": None,
                "respawn": False,
                "respawn_delay": 0.0,
                "required": False,
                "named": named,
            }
        )


def make_plan(ask):
    plan = {"nodes": [], "parameters": {}, "environment": {}, "warnings": [], "executables": [], "launch_files": []}
    plan["environment"] = source_setup(ask["prefix"])
    for path in reversed(os.environ.get("PYTHONPATH", "").split(":")):
        if path and path not in sys.path:
            sys.path.insert(1, path)
    import rospkg

    rospack = rospkg.RosPack()
    for package in ask["packages"]:
        plan["executables"] += executables_of(rospack, package)
        plan["launch_files"] += launch_files_of(rospack, package)
    if ask["launch"]:
        from_launch_file(ask, rospack, plan)
    if ask["nodes"]:
        from_executables(ask, rospack, plan, ask["nodes"])
    if not ask["launch"] and not ask["nodes"]:
        executables, launch_files = plan["executables"], plan["launch_files"]
        if len(executables) == 1:
            from_executables(ask, rospack, plan, executables)
            if launch_files:
                words = "%s is run directly, as the only executable; for remappings and parameters of a launch file push with --launch: %s"
                plan["warnings"].append(words % (executables[0], ", ".join(launch_files)))
        elif len(launch_files) == 1:
            from_launch_file(dict(ask, launch=launch_files[0]), rospack, plan)
            if executables:
                words = "%s is run, as the only launch file; for a single executable push with --node: %s"
                plan["warnings"].append(words % (launch_files[0], ", ".join(executables)))
        else:
            raise Refused("nothing", executables=plan["executables"], launch_files=plan["launch_files"])
    for node in plan["nodes"]:
        for source, target in ask["remaps"].items():
            # Last: where a name is remapped twice, the last one counts.
            node["argv"].append("%s:=%s" % (source, target))
            node["remaps"][source] = target
    for name, value in ask["params"].items():
        if name.startswith("/"):
            plan["parameters"][name] = value
            continue
        for node in plan["nodes"]:
            plan["parameters"]["%s/%s" % (node["name"], name.lstrip("~_"))] = value
    return plan


def main():
    with open("/cloudroid/ask.json", encoding="utf-8") as file:
        ask = json.load(file)
    try:
        result = make_plan(ask)
    except Refused as refused:
        result = {"error": refused.about}
    except Exception:  # pylint: disable=broad-except
        # roslaunch lets some errors of a launch file through as they come, such as those of YAML.
        words = traceback.format_exc().strip().splitlines()[-1]
        traceback.print_exc()
        result = {"error": {"kind": "launch", "file": ask["launch"] or "", "words": words}}
    with open("/cloudroid/out/plan.json", "w", encoding="utf-8") as file:
        json.dump(result, file)


main()
