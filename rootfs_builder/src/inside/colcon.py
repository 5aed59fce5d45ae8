"""Compiles packages of ROS 2, one after the other, by colcon, and installs them into one prefix; or, for a `check`, only
looks whether colcon takes them for what they are.

Runs as an unprivileged user in a container without network. In: /cloudroid/job.json, sources below
/cloudroid/source (not written). Out: the prefix; progress and the compilers' output on standard output. A line
`::package NAME` says which package is next, and `::failed NAME` which failed the check.
"""

import json
import os
import shlex
import shutil
import stat
import subprocess
import sys

import second_look

# What colcon's own Python makes of package.xml files: where one is not valid, colcon would build the package by whatever
# else it finds there, and not install it as a package of ROS.
READ_MANIFESTS = """
import json, sys
from catkin_pkg.package import InvalidPackage, parse_package
problems = {}
for path in sys.argv[1:]:
    try:
        parse_package(path, warnings=[])
    except InvalidPackage as error:
        problems[path] = str(error)
print(json.dumps(problems))
"""


def run(argv, cwd, environment):
    print("+ " + " ".join(argv), flush=True)
    result = subprocess.run(argv, cwd=cwd, env=environment, stdin=subprocess.DEVNULL, check=False)
    if result.returncode != 0:
        print("%s ended with status %d" % (argv[0], result.returncode), flush=True)
        sys.exit(1)


def environment_of(prefix, given):
    """What the setup scripts of the packages installed so far make of the environment."""
    environment = dict(given)
    if os.path.exists(os.path.join(prefix, "local_setup.sh")):
        script = 'COLCON_CURRENT_PREFIX="$0"; . "$0/local_setup.sh" >&2 && exec env -0'
        output = subprocess.run(["/bin/sh", "-c", script, prefix], env=given, stdout=subprocess.PIPE, check=True).stdout
        items = (item.partition("=") for item in output.decode("utf-8", "replace").split("\0") if "=" in item)
        environment = {name: value for name, _, value in items if name not in ("_", "COLCON_CURRENT_PREFIX")}
    return environment


def has_colcon(environment):
    return shutil.which("colcon", path=environment.get("PATH")) is not None


def colcon(environment):
    program = shutil.which("colcon", path=environment.get("PATH"))
    if program is None:
        print("the base has no colcon in its PATH, which builds packages of ROS 2", flush=True)
        sys.exit(1)
    return program


def python_of(program, environment):
    """The Python that a program of Python runs in: what it can import is not what this script can."""
    with open(program, "rb") as file:
        first = file.readline().decode("utf-8", "replace")
    words = shlex.split(first[2:]) if first.startswith("#!") else []
    words = [word for word in words if os.path.basename(word) != "env"]
    found = shutil.which(words[0], path=environment.get("PATH")) if words else None
    return found or sys.executable


def source_of(package):
    return os.path.join("/build/src", package["path"]).rstrip("/")


def invalid(packages, given):
    """What is wrong with package.xml files, by the names of their packages."""
    paths = {os.path.join(source_of(package), "package.xml"): package["name"] for package in packages}
    argv = [python_of(colcon(given), given), "-c", READ_MANIFESTS] + list(paths)
    result = subprocess.run(argv, env=given, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, check=False)
    if result.returncode != 0:
        print("cannot read the package.xml files with colcon's parser", flush=True)
        sys.exit(1)
    problems = json.loads(result.stdout.decode("utf-8"))
    return {paths[path]: "%s: %s" % (path, words) for path, words in problems.items()}


def check(job, given):
    problems = invalid(job["packages"], given) if has_colcon(given) else {}
    for name, words in problems.items():
        print("::failed " + name, flush=True)
        print(words, flush=True)
    sys.exit(1 if problems else 0)


def install_python(package, prefix, environment):
    """What colcon does for a package of Python, by setuptools alone: for an image that has no colcon."""
    version = "python%d.%d" % sys.version_info[:2]
    argv = [sys.executable, "setup.py", "install", "--single-version-externally-managed", "--record", "/build/record"]
    argv += ["--prefix", prefix, "--install-data", prefix]
    argv += ["--install-lib", os.path.join(prefix, "lib", version, "site-packages")]
    argv += ["--install-scripts", os.path.join(prefix, "lib", package["name"])]
    run(argv, source_of(package), environment)


def build(package, job, given):
    if package["build_type"] == "ament_python" and not has_colcon(given):
        install_python(package, job["prefix"], environment_of(job["prefix"], given))
        return
    for words in invalid([package], given).values():
        print(words, flush=True)
        sys.exit(1)
    environment = environment_of(job["prefix"], given)
    if package["build_type"] == "ament_python":
        # Of a setup.py that fails colcon shows its own stack.
        run([python_of(colcon(given), given), "setup.py", "--quiet", "--name"], source_of(package), environment)
    # Otherwise colcon asks make to wait while the machine is busy with others.
    environment["MAKEFLAGS"] = "-j%d" % job["jobs"]
    environment["CMAKE_BUILD_PARALLEL_LEVEL"] = str(job["jobs"])
    argv = [colcon(environment), "--log-base", "/build/log", "build"]
    argv += ["--paths", source_of(package), "--build-base", "/build/build"]
    argv += ["--install-base", job["prefix"], "--merge-install", "--executor", "sequential"]
    # The compilers' own words as they come, and nothing of colcon's between or after them.
    argv += ["--event-handlers", "console_direct+", "console_start_end-", "console_stderr-", "summary-"]
    # Tests need linters and more, and are not run here.
    argv += ["--cmake-args", "-DBUILD_TESTING=OFF"] + job["cmake"]
    print("+ " + " ".join(argv), flush=True)
    status, said = second_look.heard(argv, "/build", environment, aloud=True)
    if status != 0:
        if package["build_type"] != "ament_python":
            cmake = ["cmake", source_of(package), "-DBUILD_TESTING=OFF"] + job["cmake"]
            for line in second_look.lines(*second_look.missing(cmake, "/build/again", environment, said)):
                print(line, flush=True)
        print("%s ended with status %d" % (argv[0], status), flush=True)
        sys.exit(1)


def main():
    with open("/cloudroid/job.json", encoding="utf-8") as file:
        job = json.load(file)
    given = dict(os.environ)
    os.makedirs(given["HOME"], exist_ok=True)
    # Builds write into their sources: setuptools, code generators.
    shutil.copytree("/cloudroid/source", "/build/src", symlinks=True)
    for parent, _, files in os.walk("/build/src"):
        for entry in files:
            path = os.path.join(parent, entry)
            if not os.path.islink(path):
                os.chmod(path, os.stat(path).st_mode | stat.S_IWUSR)
    if job["check"]:
        check(job, given)
    for package in job["packages"]:
        print("::package " + package["name"], flush=True)
        build(package, job, given)


if __name__ == "__main__":
    main()
