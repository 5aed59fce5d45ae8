"""Asks what a launch file of ROS 2 (or an executable) means, of the image's own launch where it has one.

Runs in a container of the finished image. In: /cloudroid/ask.json. Out: /cloudroid/out/plan.json, which holds
either a plan or one `error`. No node is started.
"""

import glob
import importlib.util
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import traceback

import ros2_components as components

ASK = "/cloudroid/ask.json"
PLAN = "/cloudroid/out/plan.json"
# How the environment that was made reaches this script when it is started again in it.
DIFFERENCE = "CLOUDROID_DIFFERENCE"
INDEX = "share/ament_index/resource_index/packages"
# Of the shell, and of setup scripts for themselves.
NOT_TOLD = ("PWD", "OLDPWD", "SHLVL", "_", "COLCON_CURRENT_PREFIX", "COLCON_PREFIX_PATH", "AMENT_CURRENT_PREFIX", "AMENT_SHELL")


class Refused(Exception):
    """What is asked for cannot be; `kind` tells the builder which error to show."""

    def __init__(self, kind, **about):
        super().__init__(kind)
        self.about = dict(about, kind=kind)


# The environment


def is_space(prefix):
    return os.path.isdir(os.path.join(prefix, INDEX))


def prefixes_in(prefix):
    """The prefix itself, or those of its packages where each has one."""
    if is_space(prefix) or not os.path.isdir(prefix):
        return [prefix]
    inner = [os.path.join(prefix, name) for name in sorted(os.listdir(prefix))]
    return [path for path in inner if is_space(path)] or [prefix]


def modules_of(prefix):
    """Where an install space has modules of Python."""
    found = []
    for below in ("lib", "local/lib"):
        for name in ("site-packages", "dist-packages"):
            found += sorted(glob.glob(os.path.join(prefix, below, "python3*", name)))
    return found


def check_python(prefix):
    here = "python%d.%d" % sys.version_info[:2]
    versions = set()
    for space in prefixes_in(prefix):
        versions |= {path.split("/")[-2] for path in modules_of(space)}
    # A directory without a minor version is good for all.
    made_for = sorted(version for version in versions if version != "python3")
    if made_for and here not in versions:
        raise Refused("python", made_for=", ".join(made_for), there=here)


def add_paths(environment, prefix):
    """What a space without setup scripts needs, and nothing that is there already."""
    for name, directories in (
        ("AMENT_PREFIX_PATH", [prefix]),
        ("CMAKE_PREFIX_PATH", [prefix]),
        ("PATH", [os.path.join(prefix, "bin")]),
        ("LD_LIBRARY_PATH", [os.path.join(prefix, "lib")]),
        ("PYTHONPATH", modules_of(prefix)),
    ):
        known = [p for p in environment.get(name, "").split(":") if p]
        new = [p for p in directories if os.path.isdir(p) and p not in known]
        if new:
            environment[name] = ":".join(new + known)


def source_setup(prefix):
    """The environment that the install space's own setup script makes."""
    environment = dict(os.environ)
    if not prefix:
        return environment
    check_python(prefix)
    setup = os.path.join(prefix, "local_setup.sh")
    if os.path.exists(setup):
        # Where they are, scripts believe what they are told.
        script = 'COLCON_CURRENT_PREFIX="$0"; AMENT_CURRENT_PREFIX="$0"; . "$0/local_setup.sh" >&2 && exec env -0'
        result = subprocess.run(["/bin/sh", "-c", script, prefix], stdout=subprocess.PIPE, check=False)
        if result.returncode != 0:
            raise Refused("setup", file=setup, status=result.returncode)
        items = (item.partition("=") for item in result.stdout.decode("utf-8", "replace").split("\0"))
        environment = {name: value for name, equals, value in items if equals and name not in NOT_TOLD}
    for space in prefixes_in(prefix):
        add_paths(environment, space)
    return environment


def start_again(prefix):
    """In the environment of the image's nodes, by its Python: modules and libraries are found when a program starts."""
    environment = source_setup(prefix)
    told = {k: v for k, v in environment.items() if os.environ.get(k) != v and k not in NOT_TOLD}
    environment[DIFFERENCE] = json.dumps(told)
    python = shutil.which("python3", path=environment.get("PATH")) or sys.executable
    os.execve(python, [python, os.path.abspath(__file__)], environment)


# Packages


def spaces():
    return [p for p in os.environ.get("AMENT_PREFIX_PATH", "").split(":") if p]


def prefix_of(package):
    """The first install space with a package, as ament's index has it."""
    for space in spaces():
        if os.path.exists(os.path.join(space, INDEX, package)):
            return space
    return None


def share_of(package):
    prefix = prefix_of(package)
    return os.path.join(prefix, "share", package) if prefix else None


def below(directory):
    for parent, directories, files in os.walk(directory):
        directories[:] = sorted(d for d in directories if not d.startswith(".") and d not in ("cmake", "__pycache__"))
        for name in sorted(files):
            yield os.path.join(parent, name)


def executables_of(package):
    """Programs that `ros2 run` would find, by their names there."""
    prefix = prefix_of(package)
    if prefix is None:
        return {}
    found = {}
    for path in below(os.path.join(prefix, "lib", package)):
        if os.access(path, os.X_OK):
            found.setdefault(os.path.basename(path), path)
    return found


def launch_files_of(package):
    """Paths in the package's share."""
    share = share_of(package)
    if share is None:
        return []
    names = []
    for path in below(share):
        name = os.path.relpath(path, share)
        in_launch = name.startswith("launch/") and not os.path.basename(name).startswith("__")
        ends = (".py", ".xml", ".yaml", ".yml") if in_launch else ("launch.py", "launch.xml", "launch.yaml", "launch.yml")
        if name.endswith(ends):
            names.append(name)
    return names


def find_launch_file(packages, asked):
    if os.path.isabs(asked) and os.path.isfile(asked):
        return asked
    first = asked.partition("/")[0]
    known = []
    for package in packages + ([first] if first != asked and first not in packages else []):
        share = share_of(package)
        if share is None:
            continue
        wanted = asked[len(package) + 1 :] if asked.startswith(package + "/") else asked
        for place in (wanted, os.path.join("launch", wanted)):
            if os.path.isfile(os.path.join(share, place)):
                return os.path.join(share, place)
        files = launch_files_of(package)
        known += files
        same = [f for f in files if os.path.basename(f) == wanted]
        if same:
            return os.path.join(share, same[0])
    raise Refused("not_found", what="launch file", name=asked, known=known)


# Executables


def find_executable(packages, asked):
    """Package, name and path of `EXE`, in one of these packages, or of `PACKAGE/EXE`, in any that the image has."""
    package, slash, executable = asked.partition("/")
    places = [(p, asked[len(p) + 1 :] if asked.startswith(p + "/") else asked) for p in packages]
    for package, wanted in places + ([(package, executable)] if slash else []):
        path = executables_of(package).get(wanted)
        if path is not None:
            return package, wanted, path
    return None


def find_component(packages, asked):
    """Package and class of `CLASS`, in one of these packages, or of `PACKAGE/CLASS`, in any that the image has."""
    package, slash, plugin = asked.partition("/")
    for package, wanted in [(package, plugin)] if slash else [(package, asked) for package in packages]:
        if wanted in components.classes_of(spaces(), package):
            return package, wanted
    return None


def rules_of(arguments):
    """Arguments, those that name the node (as on the command line of ROS 1) told as ROS 2 takes them; and which they are."""
    names = {}
    for argument in arguments:
        match = re.fullmatch(r"(__node|__name|__ns):=(.*)", argument)
        if match:
            names["__ns" if match.group(1) == "__ns" else "__node"] = match.group(2)
    if "--ros-args" not in arguments and names:
        rules = [a for a in arguments if re.match(r"__(node|name|ns):=", a)]
        arguments = [a for a in arguments if a not in rules]
        arguments += ["--ros-args"] + [word for rule in rules for word in ("-r", rule)]
    return arguments, names.get("__node"), names.get("__ns")


def from_executables(ask, plan, asked_nodes):
    taken = set()
    for words in asked_nodes:
        asked, *arguments = shlex.split(words) or [words]
        found = find_executable(ask["packages"], asked)
        component = None if found else find_component(ask["packages"], asked)
        if component is not None:
            contain(plan, *component, arguments, taken)
            continue
        if found is None:
            raise Refused("not_found", what="executable", name=asked, known=plan["executables"] + plan["components_known"])
        package, wanted, path = found
        arguments, given, namespace = rules_of(arguments)
        stem = given or stem_of(wanted)
        above = (namespace or "").rstrip("/") + "/"
        name, number = stem, 1
        while above + name in taken:
            number += 1
            name = "%s_%d" % (stem, number)
        taken.add(above + name)
        # As under `ros2 run` the program names its nodes itself: what they are called is looked at, and told where it is taken.
        named = given is not None
        if named and name != given:
            # Of several rules the first one counts.
            arguments = ["--ros-args", "-r", "__node:=" + name, "--"] + arguments
        plan["nodes"].append(planned(above + name, package, wanted, [path] + arguments, named))


def planned(name, package, executable, argv, named):
    return {
        "name": name,
        "package": package,
        "executable": executable,
        "argv": argv,
        "remaps": {},
        "environment": {},
        "directory": None,
        "respawn": False,
        "respawn_delay": 0.0,
        "required": False,
        "named": named,
    }


def contain(plan, package, plugin, arguments, taken):
    """A class is loaded into a container of its own."""
    path = executables_of(components.PACKAGE).get(components.PROGRAM)
    if path is None:
        raise Refused("no_container", plugin=plugin)
    name = components.container_name(plugin, taken)
    taken.add("/" + name)
    argv = [path, "--ros-args", "-r", "__node:=" + name]
    plan["nodes"].append(planned("/" + name, components.PACKAGE, components.PROGRAM, argv, True))
    plan["components"]["/" + name] = [components.of_command_line(package, plugin, arguments, Refused)]


def stem_of(executable):
    stem = re.sub(r"\W", "_", os.path.splitext(os.path.basename(executable))[0])
    return stem if stem[:1].isalpha() else "node_" + stem


# Plans


def can_launch():
    return all(importlib.util.find_spec(name) is not None for name in ("launch", "launch_ros"))


def make_plan(ask):
    plan = {"nodes": [], "components": {}, "parameters": {}, "environment": {}, "warnings": []}
    plan.update(executables=[], components_known=[], launch_files=[])
    plan["environment"] = json.loads(os.environ.pop(DIFFERENCE))
    for package in ask["packages"]:
        plan["executables"] += list(executables_of(package))
        plan["components_known"] += components.classes_of(spaces(), package)
        plan["launch_files"] += launch_files_of(package)
    launch = ask["launch"]
    nodes = ask["nodes"]
    if not launch and not nodes:
        if len(plan["executables"]) == 1:
            nodes = plan["executables"]
            if plan["launch_files"]:
                words = "%s is run directly, as the only executable; for remappings and parameters of a launch file push with --launch: %s"
                plan["warnings"].append(words % (nodes[0], ", ".join(plan["launch_files"])))
        elif len(plan["launch_files"]) == 1 and can_launch():
            launch = plan["launch_files"][0]
            if plan["executables"]:
                words = "%s is run, as the only launch file; for a single executable push with --node: %s"
                plan["warnings"].append(words % (launch, ", ".join(plan["executables"])))
        elif not plan["executables"] and len(plan["components_known"]) == 1:
            nodes = plan["components_known"]
        else:
            known = plan["executables"] + plan["components_known"]
            raise Refused("nothing", executables=known, launch_files=plan["launch_files"])
    if launch:
        import ros2_launch_plan

        path = find_launch_file(ask["packages"], launch)
        ros2_launch_plan.resolve(path, ask, plan, Refused, lambda refused: tell({"error": refused.about}))
    from_executables(ask, plan, nodes)
    for node in plan["nodes"]:
        for source, target in ask["remaps"].items():
            node["argv"] += ["--ros-args", "-r", "%s:=%s" % (source, target), "--"]
            node["remaps"][source] = target
    for loaded in plan["components"].values():
        for component in loaded:
            components.give(component, ask, Refused)
    for name, value in ask["params"].items():
        if name.startswith("/"):
            plan["parameters"][name] = value
            continue
        for node in plan["nodes"]:
            plan["parameters"]["%s/%s" % (node["name"], name.lstrip("~_"))] = value
    return plan


def tell(result):
    with open(PLAN, "w", encoding="utf-8") as file:
        json.dump(result, file)


def main():
    with open(ASK, encoding="utf-8") as file:
        ask = json.load(file)
    try:
        if DIFFERENCE not in os.environ:
            start_again(ask["prefix"])
        result = make_plan(ask)
    except Refused as refused:
        result = {"error": refused.about}
    except Exception:  # pylint: disable=broad-except
        # Launch files are programs: they may raise anything.
        words = traceback.format_exc().strip().splitlines()[-1]
        traceback.print_exc()
        result = {"error": {"kind": "launch", "file": ask["launch"] or "", "words": words}}
    tell(result)


if __name__ == "__main__":
    main()
