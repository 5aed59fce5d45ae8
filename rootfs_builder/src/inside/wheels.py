"""Puts wheels below a prefix as ROS is laid out there: modules in lib/pythonX.Y/site-packages, all else as it is named.

Runs as root in a container without network: `wheels.py JOB DIRECTORY`. In: the job, and the wheels that it names, in the
directory. Out: the prefix; a line `::wheel NAME` for each. The same wheels give the same files.

The form of wheels: https://packaging.python.org/en/latest/specifications/binary-distribution-format/
"""

import configparser
import filecmp
import json
import os
import py_compile
import re
import stat
import struct
import sys
import zipfile

PROGRAM = """#!%s
import sys
from %s import %s
if __name__ == "__main__":
    sys.exit(%s())
"""

# How the libraries of generated Python modules are called.
OF_PYTHON = "__rosidl_generator_py.so"
# The ELF format (System V gABI, chapter 5): types of segments, tags of the dynamic section.
PT_LOAD = 1
PT_DYNAMIC = 2
DT_NEEDED = 1
DT_STRTAB = 5


class Prefix:
    def __init__(self, path, rewrite):
        self.path = path
        self.rewrite = sorted(rewrite.items())
        self.site = os.path.join(path, "lib", "python%d.%d" % sys.version_info[:2], "site-packages")
        # What was put there, in the order in which it came.
        self.files = {}

    def place_of(self, entry, wheel):
        """Where a file of a wheel goes, by the scheme that its first directories name."""
        name = wheel.split("-")[0]
        match = re.fullmatch(r"[^/]+\.data/([^/]+)/(.+)", entry)
        scheme, rest = match.groups() if match else ("purelib", entry)
        root = {
            "purelib": self.site,
            "platlib": self.site,
            "data": self.path,
            "scripts": os.path.join(self.path, "bin"),
            "headers": os.path.join(self.path, "include", name),
        }[scheme]
        place = os.path.normpath(os.path.join(root, rest))
        if not place.startswith(self.path + "/"):
            sys.exit("%s: %s is outside of the prefix" % (wheel, entry))
        return place, scheme

    def write(self, place, data, runs):
        os.makedirs(os.path.dirname(place), exist_ok=True)
        if place in self.files:
            # Otherwise the one that comes last would count, whichever that is.
            with open(place, "rb") as file:
                if file.read() != data:
                    sys.exit("two wheels contain different versions of %s" % place)
        with open(place, "wb") as file:
            file.write(data)
        os.chmod(place, 0o755 if runs else 0o644)
        self.files[place] = None

    def program(self, name, target):
        module, _, function = target.partition(":")
        first = function.split(".")[0]
        text = PROGRAM % (sys.executable, module.strip(), first.strip(), function.strip())
        self.write(os.path.join(self.path, "bin", name), text.encode(), True)


def install(directory, wheel, prefix):
    with zipfile.ZipFile(os.path.join(directory, wheel)) as archive:
        for info in sorted(archive.infolist(), key=lambda info: info.filename):
            # Compiled elsewhere: the times of sources in it are not those of the files here.
            if info.is_dir() or info.filename.endswith(".pyc"):
                continue
            place, scheme = prefix.place_of(info.filename, wheel)
            data = archive.read(info)
            runs = scheme == "scripts" or bool(info.external_attr >> 16 & stat.S_IXUSR)
            if scheme == "scripts" and data.startswith(b"#!python"):
                _, end, rest = data.partition(b"\n")
                data = b"#!" + sys.executable.encode() + end + rest
            if os.path.dirname(place) == os.path.join(prefix.path, "lib") and not place.endswith(OF_PYTHON):
                data = without_python(data)
            if place.endswith(".cmake"):
                for old, new in prefix.rewrite:
                    data = data.replace(old.encode(), new.encode())
            prefix.write(place, data, runs)
            if re.fullmatch(r"[^/]+\.dist-info/entry_points\.txt", info.filename):
                points = configparser.ConfigParser(delimiters=("=",), interpolation=None)
                points.optionxform = str
                points.read_string(data.decode("utf-8"))
                if points.has_section("console_scripts"):
                    for name, target in points.items("console_scripts"):
                        prefix.program(name, target.split("[")[0].strip())


def without_python(data):
    """A library, such as librcl.so, without what it is linked with and does not use: libraries of generated Python modules, which
    only Python can load, so that no program in C++ could load it. Their entries name another library that it needs once more."""
    if not data.startswith(b"\x7fELF\x02\x01"):
        return data
    (table,) = struct.unpack_from("<Q", data, 32)
    size, count = struct.unpack_from("<HH", data, 54)
    headers = [struct.unpack_from("<IIQQQQQQ", data, table + size * index) for index in range(count)]
    entries = []
    for kind, _, offset, _, _, length, _, _ in headers:
        if kind == PT_DYNAMIC:
            entries = [(at + 8, *struct.unpack_from("<qQ", data, at)) for at in range(offset, offset + length, 16)]
    strings = 0
    for _, tag, address in entries:
        for kind, _, offset, start, _, length, _, _ in headers:
            if tag == DT_STRTAB and kind == PT_LOAD and start <= address < start + length:
                strings = offset + address - start
    needed = [(at, value) for at, tag, value in entries if tag == DT_NEEDED]
    ending = OF_PYTHON.encode() + b"\0"
    names = {value: data[strings + value : data.index(b"\0", strings + value) + 1] for _, value in needed}
    others = [value for _, value in needed if not names[value].endswith(ending)]
    if not others:
        return data
    changed = bytearray(data)
    for at, value in needed:
        if names[value].endswith(ending):
            struct.pack_into("<Q", changed, at, others[0])
    return bytes(changed)


def share_libraries(prefix):
    """Wheels bring the libraries that they were linked with, each its own copies of them, in directories NAME.libs; their
    names end in a hash. One copy of each is kept, and is also where the linker looks by default: in lib."""
    library = os.path.join(prefix.path, "lib")
    for path in sorted(prefix.files):
        directory, name = os.path.split(path)
        if not directory.endswith(".libs") or os.path.dirname(directory) != prefix.site:
            continue
        kept = os.path.join(library, name)
        if not os.path.lexists(kept):
            os.link(path, kept)
        elif filecmp.cmp(path, kept, shallow=False):
            os.unlink(path)
            os.link(kept, path)


def compile_modules(prefix):
    """With the source's hash in it, a compiled module is the same every time, and good whatever the file's time is."""
    for path in sorted(prefix.files):
        if path.endswith(".py") and path.startswith(prefix.site + "/"):
            try:
                py_compile.compile(path, doraise=True, invalidation_mode=py_compile.PycInvalidationMode.CHECKED_HASH)
            except py_compile.PyCompileError as error:
                # Packages hold templates that are called .py.
                print("not compiled: %s" % error.msg.strip().splitlines()[-1], flush=True)


def main(path, directory):
    os.umask(0o022)
    with open(path, encoding="utf-8") as file:
        job = json.load(file)
    prefix = Prefix(job["prefix"], job["rewrite"])
    for wheel in job["wheels"]:
        print("::wheel " + wheel, flush=True)
        install(directory, wheel, prefix)
    for path, text in sorted(job["files"].items()):
        prefix.write(os.path.join(prefix.path, path), text.encode(), False)
    share_libraries(prefix)
    compile_modules(prefix)


main(*sys.argv[1:])
