"""Finds out all that a package's CMake requires and that is not there. CMake itself stops at the first of it."""

import collections
import os
import re
import shutil
import subprocess
import sys

# Given to CMake before a project's own files, it tells of each package that is required and not there, and goes on as if it
# were. Of a component of catkin that is told when catkin itself looks for it. Modules of pkg-config that are not required are
# looked for without a word.
PROVIDER = """
cmake_minimum_required(VERSION 3.24)
message(STATUS "::looking again")
macro(cloudroid_look method name)
  if("${name}" STREQUAL "PkgConfig")
    find_package(PkgConfig QUIET BYPASS_PROVIDER)
    cmake_language(EVAL CODE [[
      macro(pkg_check_modules prefix)
        set(_cloudroid_asked ${ARGN})
        if("REQUIRED" IN_LIST _cloudroid_asked)
          list(REMOVE_ITEM _cloudroid_asked REQUIRED QUIET)
        else()
          list(PREPEND _cloudroid_asked QUIET)
        endif()
        _pkg_check_modules(${prefix} ${_cloudroid_asked})
      endmacro()
    ]])
  elseif(NOT "${name}" STREQUAL "catkin" AND "${ARGN}" MATCHES "(^|;)REQUIRED(;|$)")
    set(_cloudroid_asked_${name} ${ARGN})
    list(TRANSFORM _cloudroid_asked_${name} REPLACE "^REQUIRED$" "COMPONENTS")
    find_package(${name} ${_cloudroid_asked_${name}} QUIET BYPASS_PROVIDER)
    string(TOUPPER "${name}" _cloudroid_upper)
    if(NOT ${name}_FOUND AND NOT ${_cloudroid_upper}_FOUND)
      if(EXISTS "${CMAKE_ROOT}/Modules/Find${name}.cmake")
        message(STATUS "::not found ${name}")
      else()
        message(STATUS "::missing ${name}")
      endif()
      set(${name}_FOUND_CATKIN_PROJECT TRUE)
    endif()
    set(${name}_FOUND TRUE)
  endif()
endmacro()
cmake_language(SET_DEPENDENCY_PROVIDER cloudroid_look SUPPORTED_METHODS FIND_PACKAGE)
"""
# What CMake says of a package, and pkg-config of a module, of which there are two in use.
ABSENT_PACKAGE = re.compile(r"package configuration file provided by|Could NOT find \S+ \(missing:")
ABSENT_MODULE = re.compile(r"^--   (?:No package '([^']+)' found|Package '([^']+)', required by '[^']*', not found)$", re.MULTILINE)
# A required module, by the complaint that comes after pkg-config's own words.
REQUIRED = re.compile(r"((?:^--   .*\n)+)(?=CMake Error at \S+/FindPkgConfig\.cmake)", re.MULTILINE)


# Bytes of a program's output that are remembered, the last ones.
MOST = 4 << 20


def heard(argv, cwd, environment, aloud=False):
    """The status of a program, and what it said last: `aloud`, also as it comes."""
    output, size = collections.deque(), 0
    with subprocess.Popen(
        argv, cwd=cwd, env=environment, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    ) as process:
        for line in iter(lambda: process.stdout.readline(1 << 16), b""):
            output.append(line)
            size += len(line)
            while size > MOST:
                size -= len(output.popleft())
            if aloud:
                # As it is: what it prints need not be text.
                sys.stdout.buffer.write(line)
                sys.stdout.buffer.flush()
    return process.returncode, b"".join(output).decode("utf-8", "replace")


def modules_in(text):
    return [one or other for one, other in ABSENT_MODULE.findall(text)]


def missing(argv, directory, environment, said):
    """Lists of packages, of libraries that CMake looks for by modules of its own, and of modules of pkg-config. `argv`: CMake's command line, to be run again in a directory that is
    made; `said`: what it said when it failed. Nothing, where that was no complaint of this kind."""
    required = REQUIRED.search(said)
    is_complaint = required is not None or ABSENT_PACKAGE.search(said) is not None
    if not is_complaint or shutil.which(argv[0], path=environment.get("PATH")) is None:
        return [], [], []
    os.makedirs(directory)
    provider = os.path.join(directory, "provider.cmake")
    with open(provider, "w", encoding="utf-8") as file:
        file.write(PROVIDER)
    _, output = heard(argv + ["-DCMAKE_PROJECT_TOP_LEVEL_INCLUDES=" + provider], directory, environment)
    packages = re.findall(r"^-- ::missing (\S+)$", output, re.MULTILINE)
    libraries = re.findall(r"^-- ::not found (\S+)$", output, re.MULTILINE)
    modules = modules_in(required.group(1)) if required else []
    # Before version 3.24 CMake takes no notice of what it was given, and says the same again.
    if "-- ::looking again\n" in output:
        modules += modules_in(output)
    return tuple(list(dict.fromkeys(names)) for names in (packages, libraries, modules))


def lines(packages, libraries, modules):
    """Words that name them, as CMake and pkg-config would."""
    found = ['Could not find a package configuration file provided by "%s"' % name for name in packages]
    found += ["Could NOT find %s (missing: what its files are)" % name for name in libraries]
    found += ["No package '%s' found, for pkg-config" % name for name in modules]
    return (["Missing requirements:"] if found else []) + found
