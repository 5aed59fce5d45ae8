#!/usr/bin/env python3
"""Fetches scikit-image's samples for `make bench`: photographs, and the motorcycle disparity, a real float depth image.

samples.py DIRECTORY writes pictures and motorcycle_disp.f32: height, width (uint32), then floats, all little endian.
The last scikit-image whose wheel carries its pictures is 0.16; pip fetches it from the configured index.
"""

import ast
import pathlib
import struct
import subprocess
import sys
import tempfile
import zipfile

PICTURES = ["astronaut.png", "chelsea.png", "coffee.png", "motorcycle_left.png"]


def main(directory):
    with tempfile.TemporaryDirectory() as work:
        subprocess.run(
            [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--dest", work]
            + ["--only-binary", ":all:", "--python-version", "37", "--platform", "manylinux1_x86_64"]
            + ["scikit-image==0.16.2"],
            check=True,
        )
        wheel = next(pathlib.Path(work).glob("*.whl"))
        directory.mkdir(parents=True, exist_ok=True)
        for name in PICTURES:
            (directory / name).write_bytes(zipfile.ZipFile(wheel).read("skimage/data/" + name))
        with zipfile.ZipFile(wheel).open("skimage/data/motorcycle_disp.npz") as archive:
            with zipfile.ZipFile(archive).open("arr_0.npy") as array:
                data = array.read()
    assert data[:6] == b"\x93NUMPY" and data[6] == 1, "an npy file of version 1"
    length = struct.unpack("<H", data[8:10])[0]
    header = ast.literal_eval(data[10 : 10 + length].decode())
    assert header["descr"] == "<f4" and not header["fortran_order"], header
    height, width = header["shape"]
    target = directory / "motorcycle_disp.f32"
    target.write_bytes(struct.pack("<II", height, width) + data[10 + length :])


if __name__ == "__main__":
    main(pathlib.Path(sys.argv[1]))
