"""Boards of markers (ChArUco) in images: intrinsics of a camera, and the board's pose in its frame.

OpenCV detects the board; it is loaded with the first image. The camera's frame has x to the right, y down, z forward;
the board's origin is its top left corner, as OpenCV has them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from dual_ur10.errors import CalibrationError, MissingExtraError
from ur_core.types import Array, Vector3

_LEAST_CORNERS: Final = 6
_LEAST_IMAGES: Final = 5
_MOST_MISFIT: Final = 0.1  # RMS of marker corners from a plane image of the board, in marker lengths
_MOST_PIXELS: Final = 2.0  # RMS
_MOST_SQUARES: Final = 50


@dataclass(frozen=True)
class Board:
    """ChArUco board.

    Attributes:
        squares_x, squares_y: Numbers of squares.
        square_m: Edge of a square.
        marker_m: Edge of a marker.
        dictionary: Name of OpenCV's predefined dictionary, such as "DICT_5X5_100".

    Raises:
        CalibrationError: A value is out of range.
    """

    squares_x: int
    squares_y: int
    square_m: float
    marker_m: float
    dictionary: str = "DICT_5X5_100"

    def __post_init__(self) -> None:
        if not (3 <= self.squares_x <= _MOST_SQUARES and 3 <= self.squares_y <= _MOST_SQUARES):
            raise CalibrationError(
                f"the board has {self.squares_x} by {self.squares_y} squares: allowed are 3 to {_MOST_SQUARES} each way"
            )
        if not (1e-3 <= self.marker_m < self.square_m <= 1.0):
            raise CalibrationError(
                f"the board has squares of {self.square_m!r} m and markers of {self.marker_m!r} m: markers must be "
                "smaller, and both between 0.001 and 1 m"
            )

    def detector(self) -> tuple[Any, Any]:
        """Return OpenCV's board and its detector of markers.

        Raises:
            CalibrationError: There is no such dictionary, or it has too few markers.
            MissingExtraError: OpenCV is not installed.
        """
        cv2 = opencv()
        number = getattr(cv2.aruco, self.dictionary, None) if self.dictionary.startswith("DICT_") else None
        if number is None:
            raise CalibrationError(
                f"there is no dictionary {self.dictionary!r} of markers: name one of OpenCV's, such as 'DICT_5X5_100'"
            )
        dictionary = cv2.aruco.getPredefinedDictionary(number)
        if len(dictionary.bytesList) < self.markers:
            raise CalibrationError(
                f"a board of {self.squares_x} by {self.squares_y} squares has {self.markers} markers, "
                f"{self.dictionary} only {len(dictionary.bytesList)}: name its own dictionary"
            )
        size = (self.squares_x, self.squares_y)
        board = cv2.aruco.CharucoBoard(size, self.square_m, self.marker_m, dictionary)
        return board, cv2.aruco.ArucoDetector(dictionary)

    @property
    def markers(self) -> int:
        """Number of markers: one in each white square."""
        return self.squares_x * self.squares_y // 2


class Intrinsics(NamedTuple):
    """Intrinsics of a camera.

    Attributes:
        matrix_px: Focal lengths fx, fy and centre cx, cy, in pixels.
        distortion: OpenCV's coefficients, up to 8; none: no distortion.
    """

    matrix_px: tuple[float, float, float, float]
    distortion: tuple[float, ...] = ()

    @property
    def matrix(self) -> Array:
        """(3, 3) camera matrix."""
        fx, fy, cx, cy = self.matrix_px
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def opencv() -> Any:
    """Return the module cv2.

    Raises:
        MissingExtraError: It is not installed.
    """
    try:
        import cv2
    except ImportError as error:
        raise MissingExtraError("OpenCV", "calibration", "locating a board of markers in images") from error
    return cv2


def read_image(path: Path) -> Any:
    """Read an image in grey.

    Raises:
        CalibrationError: It cannot be read.
    """
    cv2 = opencv()
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) if path.is_file() else None
    if image is None:
        raise CalibrationError(f"{path} is no image that OpenCV reads: correct the name, or save it as PNG")
    return image


def corners(image: Any, board: Board, name: str = "the image") -> tuple[Array, Array]:
    """Return the corners of squares of the board in an image.

    Args:
        image: (height, width) grey values.
        board: The board.
        name: The image, for messages.

    Returns:
        Points on the board (n, 3) in m, and in the image (n, 2) in pixels.

    Raises:
        CalibrationError: Too little of the board is in the image, or it shows another board.
        MissingExtraError: OpenCV is not installed.
    """
    cv2 = opencv()
    cv_board, detector = board.detector()
    marker_corners, ids, _ = detector.detectMarkers(image)
    numbers = np.empty(0, dtype=int) if ids is None else np.asarray(ids).ravel()
    if not len(numbers):
        raise CalibrationError(
            f"{name} shows no marker of {board.dictionary}: check the dictionary, the light and the focus"
        )
    if numbers.max() >= board.markers:
        raise CalibrationError(
            f"{name} shows the marker {numbers.max()}: a board of {board.squares_x} by {board.squares_y} squares has "
            f"markers 0 to {board.markers - 1}. Count its squares, and correct `board`"
        )
    _check_plane(cv2, cv_board, board, marker_corners, ids, name)
    found, found_ids, _, _ = cv2.aruco.CharucoDetector(cv_board).detectBoard(image)
    if found is None or found_ids is None or len(found_ids) < _LEAST_CORNERS:
        count = 0 if found_ids is None else len(found_ids)
        raise CalibrationError(
            f"{name} shows {count} corners of the board, {_LEAST_CORNERS} are needed: bring it closer and into the "
            "light, or check the number of squares in `board`"
        )
    objects, points = cv_board.matchImagePoints(found, found_ids)
    return np.reshape(objects, (-1, 3)).astype(float), np.reshape(points, (-1, 2)).astype(float)


def _check_plane(cv2: Any, cv_board: Any, board: Board, marker_corners: Any, ids: Any, name: str) -> None:
    """Refuse markers that do not stand where a board of these squares has them."""
    if len(ids) < 2:
        return  # a single marker stands anywhere
    objects = np.concatenate([np.asarray(cv_board.getObjPoints())[number, :, :2] for number in np.ravel(ids)])
    points = np.reshape(marker_corners, (-1, 2)).astype(float)
    homography, _ = cv2.findHomography(points, objects.astype(float), 0)
    if homography is None:
        return
    there = cv2.perspectiveTransform(points[None], homography)[0]
    misfit = float(np.sqrt(((there - objects) ** 2).sum(-1).mean())) / board.marker_m
    if misfit > _MOST_MISFIT:
        raise CalibrationError(
            f"the markers in {name} do not stand as on a board of {board.squares_x} by {board.squares_y} squares with "
            f"markers of {board.marker_m / board.square_m:.2f} of a square (off by {misfit:.2g} markers): count the "
            "squares each way, measure both edges, and correct `board`"
        )


def calibration_of(objects: Sequence[Array], points: Sequence[Array], shape: tuple[int, ...]) -> tuple[Any, ...]:
    """Return OpenCV's calibration of a camera with two radial and two tangential coefficients.

    Args:
        objects: Points on the board (n, 3) in m, of each image.
        points: The same in each image (n, 2), in pixels.
        shape: Height and width of the images.

    Returns:
        Error (RMS, pixels), camera matrix, distortion, and rotation vector and position (m) of the board of each image.

    Raises:
        CalibrationError: The points decide no camera.
        MissingExtraError: OpenCV is not installed.
    """
    cv2 = opencv()
    both = ([each.astype(np.float32) for each in some] for some in (objects, points))
    try:
        found: tuple[Any, ...] = cv2.calibrateCamera(*both, shape[::-1], None, None, flags=cv2.CALIB_FIX_K3)
    except cv2.error as error:
        raise CalibrationError(
            f"the images do not calibrate a camera ({' '.join(str(error).split())[:200]}): take them again, with more "
            "than one row of the board's corners in each"
        ) from error
    return found


def calibrated_camera(images: Sequence[Path], board: Board) -> Intrinsics:
    """Calibrate a camera from its images of the board, with two radial and two tangential coefficients.

    Raises:
        CalibrationError: There are too few images, they differ in size, or they do not fit one camera.
        MissingExtraError: OpenCV is not installed.
    """
    if len(images) < _LEAST_IMAGES:
        raise CalibrationError(
            f"{len(images)} images of a camera without intrinsics: {_LEAST_IMAGES} are needed to calibrate it. Take "
            "more, with the board tilted, or give `cameras` in the data file"
        )
    grey = [read_image(path) for path in images]
    if len({each.shape for each in grey}) > 1:
        raise CalibrationError("the images of one camera differ in size: they are not of one camera. Take them again")
    found = [corners(image, board, path.name) for image, path in zip(grey, images, strict=True)]
    objects, points = zip(*found, strict=True)
    rms, matrix, distortion, _, _ = calibration_of(objects, points, grey[0].shape)
    if not rms < _MOST_PIXELS:
        raise CalibrationError(
            f"the images do not fit one camera ({rms:.2g} pixels RMS, allowed {_MOST_PIXELS:g}): check `board`, keep "
            "the focus, and take them again"
        )
    fx, fy, cx, cy = matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]
    return Intrinsics((float(fx), float(fy), float(cx), float(cy)), tuple(map(float, np.ravel(distortion)[:4])))


def located(path: Path, board: Board, camera: Intrinsics) -> tuple[Vector3, Vector3]:
    """Return the pose of the board in an image.

    Returns:
        Position (3,) in the camera's frame and rotation vector (3,).

    Raises:
        CalibrationError: The image does not show the board, or does not fit the camera.
        MissingExtraError: OpenCV is not installed.
    """
    cv2 = opencv()
    objects, points = corners(read_image(path), board, path.name)
    distortion = np.asarray(camera.distortion, dtype=float)
    if len(distortion) not in (0, 4, 5, 8):
        raise CalibrationError(f"a camera has {len(distortion)} coefficients of distortion: allowed are 0, 4, 5 or 8")
    good, rotation, position = cv2.solvePnP(objects, points, camera.matrix, distortion)
    there = cv2.projectPoints(objects, rotation, position, camera.matrix, distortion)[0].reshape(-1, 2)
    rms = float(np.sqrt(((there - points) ** 2).sum(-1).mean()))
    if not (good and rms < _MOST_PIXELS):
        raise CalibrationError(
            f"{path.name} does not fit the camera ({rms:.2g} pixels RMS, allowed {_MOST_PIXELS:g}): check `cameras` "
            "and `board`"
        )
    return tuple(map(float, position.ravel())), tuple(map(float, rotation.ravel()))  # type: ignore[return-value]  # 3
