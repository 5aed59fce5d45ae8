"""Compiles ROS packages, one after the other, and installs them into one prefix; or, for a `check`, only configures
them.

Runs as an unprivileged user in a container without network. In: /cloudroid/job.json, sources below
/cloudroid/source (not written). Out: the prefix; progress and the compilers' output on standard output. A line
`::package NAME` says which package is next, `::configured NAME` which the check has looked at, and `::failed NAME` which
failed it.
"""

import concurrent.futures
import glob
import json
import os
import re
import shutil
import stat
import subprocess
import sys

import second_look

SOURCES = (".c", ".cc", ".cpp", ".cxx", ".h", ".hh", ".hpp", ".hxx", ".in", ".o", ".a")
# Neither of use to a running node nor small.
LEFT_OUT = {".git", ".svn", ".hg", "build", "devel", "install", "test", "tests", "doc", "docs", "include", "__pycache__"}
# Where an install space has what others look for, by the variable that names such places.
PLACES = (
    ("CMAKE_PREFIX_PATH", ("",)),
    ("LD_LIBRARY_PATH", ("lib",)),
    ("PATH", ("bin",)),
    ("PKG_CONFIG_PATH", ("lib/pkgconfig", "lib/*/pkgconfig", "share/pkgconfig")),
    ("PYTHONPATH", ("lib/python3/dist-packages",)),
)


def run(argv, cwd, environment):
    print("+ " + " ".join(argv), flush=True)
    result = subprocess.run(argv, cwd=cwd, env=environment, stdin=subprocess.DEVNULL, check=False)
    if result.returncode != 0:
        print("%s ended with status %d" % (argv[0], result.returncode), flush=True)
        sys.exit(1)


def environment_of(prefix, given):
    """The environment in which the packages installed so far are found: what their setup.sh makes of it, which catkin
    installs, and places that it does not name. Without any package of catkin there is none."""
    environment = dict(given)
    setup = os.path.join(prefix, "setup.sh")
    if os.path.exists(setup):
        script = '. "$0" >&2 && exec env -0'
        output = subprocess.run(["/bin/sh", "-c", script, setup], env=given, stdout=subprocess.PIPE, check=True).stdout
        items = (item.partition("=") for item in output.decode("utf-8", "replace").split("\0") if "=" in item)
        environment = {name: value for name, _, value in items if name != "_"}
    for variable, places in PLACES:
        found = [path.rstrip("/") for place in places for path in sorted(glob.glob(os.path.join(prefix, place)))]
        known = [path for path in environment.get(variable, "").split(":") if path]
        new = [path for path in found if path not in known]
        if new:
            environment[variable] = ":".join(new + known)
    return environment


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


def source_of(package):
    return os.path.join("/build/src", package["path"])


def directory_of(package):
    return os.path.join("/build/build", package["name"])


def devel_of(package):
    return os.path.join(directory_of(package), "devel")


def configuration(package, job):
    argv = ["cmake", source_of(package), "-DCMAKE_INSTALL_PREFIX=" + job["prefix"]] + job["cmake"]
    if package["build_type"] == "catkin":
        argv += ["-DCATKIN_DEVEL_PREFIX=" + devel_of(package), "-DCATKIN_BUILD_BINARY_PACKAGE=OFF"]
    return argv


def look_again(package, argv, environment, said):
    """What is not there of all that a package requires; see second_look.missing."""
    directory = directory_of(package) + "-again"
    argv = [word.replace(directory_of(package), directory) for word in argv]
    return second_look.missing(argv, directory, environment, said)


def configure(package, job, environment):
    argv = configuration(package, job)
    print("+ " + " ".join(argv), flush=True)
    status, said = second_look.heard(argv, directory_of(package), environment, aloud=True)
    if status != 0:
        for line in second_look.lines(*look_again(package, argv, environment, said)):
            print(line, flush=True)
        print("cmake ended with status %d" % status, flush=True)
        sys.exit(1)


def build(package, job, given):
    prefix, source = job["prefix"], source_of(package)
    directory, devel = directory_of(package), devel_of(package)
    os.makedirs(directory)
    environment = environment_of(prefix, given)
    configure(package, job, environment)
    run(["cmake", "--build", ".", "--parallel", str(job["jobs"])], directory, environment)
    run(["cmake", "--install", "."], directory, environment)
    add_what_install_forgot(package, source, devel, prefix)


def stand_in(package):
    """Makes the devel space of a package that is only configured look as if it were built, as far as others notice
    when they are configured: the libraries that it exports are there, but empty."""
    devel, name = devel_of(package), package["name"]
    os.makedirs(os.path.join(devel, "include"), exist_ok=True)
    os.makedirs(os.path.join(devel, "lib"), exist_ok=True)
    path = os.path.join(devel, "share", name, "cmake", name + "Config.cmake")
    if not os.path.exists(path):
        return
    with open(path, encoding="utf-8", errors="replace") as file:
        text = file.read()
    for line in re.findall(r'set\(libraries "([^"]*)"\)', text):
        for library in line.split(";"):
            if re.fullmatch(r"[\w.+-]+", library):
                with open(os.path.join(devel, "lib", "lib%s.so" % library), "ab"):
                    pass


def against(spaces, job, given):
    """The environment in which these devel spaces are found."""
    environment = environment_of(job["prefix"], given)
    for name, below in (
        ("CMAKE_PREFIX_PATH", ""),
        ("PYTHONPATH", "lib/python3/dist-packages"),
        ("PKG_CONFIG_PATH", "lib/pkgconfig"),
    ):
        paths = [os.path.join(space, below).rstrip("/") for space in spaces]
        environment[name] = ":".join(paths + [p for p in environment.get(name, "").split(":") if p])
    sources = [source_of(package) for package in job["packages"]]
    environment["ROS_PACKAGE_PATH"] = ":".join(sources + [environment.get("ROS_PACKAGE_PATH", "/usr/share")])
    return environment


def may_export(package, name):
    """Whether a package's build files look as if it installs a CMake configuration of this name."""
    word = re.escape(name)
    pattern = re.compile(r"project\s*\(\s*%s\b|\b%sConfig|\b%s-config|EXPORT\s+%s\b" % (word, word, word, word), re.IGNORECASE)
    for parent, _, files in os.walk(source_of(package)):
        for entry in files:
            if pattern.search(entry):
                return True
            if entry == "CMakeLists.txt" or entry.endswith((".cmake", ".cmake.in")):
                with open(os.path.join(parent, entry), encoding="utf-8", errors="replace") as file:
                    if pattern.search(file.read()):
                        return True
    return False


def has_modules(package):
    """Whether a package may install modules of pkg-config."""
    names = (entry for _, _, files in os.walk(source_of(package)) for entry in files)
    return any(entry.endswith((".pc", ".pc.in", ".pc.cmake")) for entry in names)


def is_nobodys(name, packages, job):
    """Whether none of the packages that are compiled here can be meant by the name of a CMake configuration."""
    return name not in job["workspace"] and not any(may_export(other, name) for other in packages)


def is_certain(package, output, job):
    """Whether a failed configuration would fail as well once all packages before it are compiled. Wherever that cannot
    be known it is not certain: then it is tried again at its turn."""
    others = [other for other in job["packages"] if other["name"] != package["name"]]
    text = " ".join(output.split())
    asked = re.findall(r'package configuration file provided by "([^"]+)"', text)
    if asked:
        return any(is_nobodys(name, others, job) for name in asked)
    if re.search(r"CMake Error at \S+/FindPkgConfig\.cmake", text):
        return not any(has_modules(other) for other in others)
    if package["needs"]:
        return False
    _, _, complaint = text.partition("CMake Error")
    return not any(re.search(r"(?<!\w)%s(?!\w)" % re.escape(other["name"]), complaint) for other in others)


def configure_only(package, spaces, job, given):
    """Configures a package; its output where it fails and would fail at its turn as well, else whether it is done."""
    directory = directory_of(package)
    os.makedirs(directory)
    environment = against(spaces, job, given)
    argv = configuration(package, job)
    status, said = second_look.heard(argv, directory, environment)
    if status == 0 or not is_certain(package, said, job):
        return status == 0, None
    packages, libraries, modules = look_again(package, argv, environment, said)
    others = [other for other in job["packages"] if other["name"] != package["name"]]
    # What another package may bring is not missed yet.
    packages = [name for name in packages if is_nobodys(name, others, job)]
    modules = [] if any(has_modules(other) for other in others) else modules
    return False, "\n".join([said.rstrip("\n")] + second_look.lines(packages, libraries, modules))


def check(job, given):
    """Configures all packages, each as soon as those that it needs are, before time is spent on compiling any."""
    waiting = {package["name"]: package for package in job["packages"]}
    spaces, failures = {}, {}
    with concurrent.futures.ThreadPoolExecutor(max_workers=job["jobs"]) as pool:
        running = {}
        while waiting or running:
            for name, package in list(waiting.items()):
                if any(need in waiting or need in (p["name"] for p in running.values()) for need in package["needs"]):
                    continue
                del waiting[name]
                found = [spaces[need] for need in reversed(package["needs"]) if need in spaces]
                running[pool.submit(configure_only, package, found, job, given)] = package
            done, _ = concurrent.futures.wait(running, return_when=concurrent.futures.FIRST_COMPLETED)
            for future in done:
                package = running.pop(future)
                is_done, output = future.result()
                if is_done:
                    stand_in(package)
                    spaces[package["name"]] = devel_of(package)
                elif output is not None:
                    failures[package["name"]] = output
                print("::configured " + package["name"], flush=True)
    for package in job["packages"]:
        if package["name"] in failures:
            print("::failed " + package["name"], flush=True)
            print(failures[package["name"]], flush=True)
    sys.exit(1 if failures else 0)


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
