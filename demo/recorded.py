"""A recording with what is true for it: OpenCV's sample pictures of a chessboard, and what its authors found out by them.

They calibrated the camera by all the pictures together, and kept the result beside them: the camera, the board, and
where the board was in each picture.
"""

import os
import sys
from dataclasses import dataclass

import cv2
import numpy


@dataclass(frozen=True)
class Recording:
    """What was recorded, and the files of the pictures with the board's pose in each: rotation vector and metres."""

    columns: int
    rows: int
    square: float
    matrix: numpy.ndarray
    distortion: numpy.ndarray
    width: int
    height: int
    boards: list

    @classmethod
    def read(cls, directory):
        """Reads it where Debian's opencv-doc has put it."""
        # Nodes of a file can be read as long as the file itself is held.
        calibration = opened(os.path.join(directory, "calibration.yml"))
        listed = calibration.getNode("images")
        names = [listed.at(index).string() for index in range(listed.size())]
        found = opened(os.path.join(directory, "left_intrinsics.yml"))
        poses = found.getNode("extrinsic_parameters").mat()
        if len(poses) != len(names):
            sys.exit(f"{directory}: {len(names)} pictures and {len(poses)} poses; another version of opencv-doc?")

        def number(name):
            return found.getNode(name).real()

        return cls(
            columns=int(number("board_width")),
            rows=int(number("board_height")),
            square=number("square_size"),
            matrix=found.getNode("camera_matrix").mat(),
            distortion=found.getNode("distortion_coefficients").mat().ravel(),
            width=int(number("image_width")),
            height=int(number("image_height")),
            boards=[
                (os.path.join(directory, name), pose[:3], pose[3:]) for name, pose in zip(names, poses)
            ],
        )


def opened(path):
    """The file, which is written in OpenCV's own format."""
    storage = cv2.FileStorage(path, cv2.FILE_STORAGE_READ)
    if not storage.isOpened():
        sys.exit(f"{path}: cannot be opened; is Debian's opencv-doc installed?")
    return storage


def loaded(path):
    """The picture of a file, as bgr8."""
    picture = cv2.imread(path)
    if picture is None:
        sys.exit(f"{path}: cannot be read; is Debian's opencv-doc installed?")
    return picture
