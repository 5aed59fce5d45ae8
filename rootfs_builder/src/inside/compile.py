"""Compiles ROS packages, one after the other, and installs them into one prefix.

Runs as an unprivileged user in a container without network. In: /cloudroid/job.json, sources below
/cloudroid/source (not written). Out: the prefix; progress and the compilers' output on standard output. A line
`::package NAME` says which package is next.
"""

import json
import os
import shutil
import stat
import subprocess
import sys

SOURCES = (".c", ".cc", ".cpp", ".cxx", ".h", ".hh", ".hpp", ".hxx", ".in", ".o", ".a")
# Neither of use to a running node nor small.
LEFT_OUT = {".git", ".svn", ".hg", "build", "devel", "install", "test", "tests", "doc", "docs", "include", "__pycache__"}


def run(argv, cwd, environment):
    print("+ " + " ".join(argv), flush=True)
    result = subprocess.run(argv, cwd=cwd, env=environment, stdin=subprocess.DEVNULL, check=False)
    if result.returncode != 0:
        print("%s ended with status %d" % (argv[0], result.returncode), flush=True)
        sys.exit(1)


def environment_of(prefix, given):
    """What setup.sh of the packages installed so far makes of the environment."""
    setup = os.path.join(prefix, "setup.sh")
    if not os.path.exists(setup):
        return dict(given)
    script = '. "$0" >&2 && exec env -0'
    output = subprocess.run(["/bin/sh", "-c", script, setup], env=given, stdout=subprocess.PIPE, check=True).stdout
    items = (item.partition("=") for item in output.decode("utf-8", "replace").split("\0") if "=" in item)
    return {name: value for name, _, value in items if name != "_"}


def copy_missing(source, target):
    """Copies a file where there is none yet; directories above are made."""
    if os.path.lexists(target):
        return
    os.makedirs(os.path.dirname(target), exist_ok=True)
    shutil.copy2(source, target, follow_symlinks=False)


def add_what_install_forgot(package, source, devel, prefix):
    """Many packages are only ever run from a devel space and have no install rules. What such a space offers is
    added: programs and libraries that were built, and the files that $(find PACKAGE) would show."""
    name = package["name"]
    programs = os.path.join(prefix, "lib", name)
    built = os.path.join(devel, "lib", name)
    if os.path.isdir(built):
        for entry in sorted(os.listdir(built)):
            path = os.path.join(built, entry)
            with open(path, "rb") as file:
                # devel spaces hold relays to scripts in the source space; the scripts come below.
                compiled = file.read(4) == b"\x7fELF"
            if compiled:
                copy_missing(path, os.path.join(programs, entry))
    libraries = os.path.join(devel, "lib")
    if os.path.isdir(libraries):
        for entry in sorted(os.listdir(libraries)):
            if ".so" in entry and not os.path.isdir(os.path.join(libraries, entry)):
                copy_missing(os.path.join(libraries, entry), os.path.join(prefix, "lib", entry))
    installed = set(os.listdir(programs)) if os.path.isdir(programs) else set()
    share = os.path.join(prefix, "share", name)
    for parent, directories, files in os.walk(source):
        directories[:] = sorted(d for d in directories if d not in LEFT_OUT and not d.startswith("."))
        for entry in sorted(files):
            path = os.path.join(parent, entry)
            if entry.endswith(SOURCES) or entry.startswith(".") or entry == "CMakeLists.txt":
                continue
            runnable = not os.path.islink(path) and os.stat(path).st_mode & stat.S_IXUSR
            if runnable and entry in installed:
                # rosrun would find two programs of one name.
                continue
            copy_missing(path, os.path.join(share, os.path.relpath(path, source)))


def build(package, job, given):
    name, prefix = package["name"], job["prefix"]
    source = os.path.join("/build/src", package["path"])
    directory = os.path.join("/build/build", name)
    devel = os.path.join(directory, "devel")
    os.makedirs(directory)
    environment = environment_of(prefix, given)
    configure = ["cmake", source, "-DCMAKE_INSTALL_PREFIX=" + prefix] + job["cmake"]
    if package["build_type"] == "catkin":
        configure += ["-DCATKIN_DEVEL_PREFIX=" + devel, "-DCATKIN_BUILD_BINARY_PACKAGE=OFF"]
    run(configure, directory, environment)
    run(["cmake", "--build", ".", "--parallel", str(job["jobs"])], directory, environment)
    run(["cmake", "--install", "."], directory, environment)
    add_what_install_forgot(package, source, devel, prefix)


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
    for package in job["packages"]:
        print("::package " + package["name"], flush=True)
        build(package, job, given)


main()
