"""Where a chessboard is in a picture, and in front of the camera. Nothing in here knows of ROS."""

from dataclasses import dataclass

import cv2
import numpy

# How far around a corner its exact place is looked for, in pixels each way: less than half a small square.
CORNER_WINDOW = (5, 5)
CORNER_PRECISION = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 0.01)


@dataclass(frozen=True)
class Board:
    """A chessboard by its inner corners."""

    columns: int
    rows: int
    square: float  # metres

    def corners(self):
        """The corners in the board's own frame, row by row, in metres."""
        corners = numpy.zeros((self.rows * self.columns, 3))
        corners[:, :2] = numpy.mgrid[0 : self.columns, 0 : self.rows].T.reshape(-1, 2) * self.square
        return corners


@dataclass(frozen=True)
class Camera:
    """A calibrated camera."""

    matrix: numpy.ndarray  # 3x3
    distortion: numpy.ndarray  # 4, 5 or 8 coefficients, in OpenCV's order; or none
    width: int
    height: int


@dataclass(frozen=True)
class Found:
    """A board that was found: its corners in the picture, and its pose in the camera's optical frame."""

    corners: numpy.ndarray
    rotation: numpy.ndarray  # a vector: its direction is the axis, its length the angle
    translation: numpy.ndarray


def find(gray, board, camera):
    """Looks for the board in a grey picture; None if all of it cannot be seen."""
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
    seen, corners = cv2.findChessboardCorners(gray, (board.columns, board.rows), flags=flags)
    if not seen:
        return None
    corners = cv2.cornerSubPix(gray, corners, CORNER_WINDOW, (-1, -1), CORNER_PRECISION)
    solved, rotation, translation = cv2.solvePnP(board.corners(), corners, camera.matrix, camera.distortion)
    if not solved:
        return None
    return Found(corners, rotation.ravel(), translation.ravel())


def draw(picture, found, board, camera):
    """Draws the corners and the board's axes, three squares long, into a picture in colour."""
    cv2.drawChessboardCorners(picture, (board.columns, board.rows), found.corners, True)
    length = 3 * board.square
    cv2.drawFrameAxes(picture, camera.matrix, camera.distortion, found.rotation, found.translation, length)


def quaternion(rotation):
    """x, y, z and w of a rotation vector."""
    angle = float(numpy.linalg.norm(rotation))
    if angle == 0.0:
        return 0.0, 0.0, 0.0, 1.0
    x, y, z = (float(part) for part in rotation / angle * numpy.sin(angle / 2))
    return x, y, z, float(numpy.cos(angle / 2))
