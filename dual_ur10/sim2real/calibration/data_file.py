"""Data file of a calibration: observations as they were measured, in JSON.

The file grows by one observation at a time and is never overwritten with fewer. Joint angles are kept, and no poses:
the kinematics of the arms come from the cell file whenever an estimate is made.
"""

from __future__ import annotations

import contextlib
import datetime
import fcntl
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from dual_ur10.errors import CalibrationError
from dual_ur10.sim2real.calibration.board import Board, Intrinsics, calibrated_camera, corners, located, read_image
from dual_ur10.sim2real.calibration.camera_pose import CornerView
from dual_ur10.sim2real.calibration.observations import BarPose, BoardView, Carrier, Noise, Observation, Touch
from ur_core.files import check_target, read_named, write_text
from ur_core.findings import listed
from ur_core.types import Array

MAX_BYTES: Final = 4 << 20
MAX_OBSERVATIONS: Final = 2000
"""Most observations of a file; the work of an estimate grows with their number."""

_MOST_FINDINGS: Final = 3

Triple = tuple[float, float, float]
Six = tuple[float, float, float, float, float, float]
Text = Annotated[str, Field(max_length=200)]


class _Entry(BaseModel):
    """A table of the file: strict about types, without unknown keys."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True, allow_inf_nan=False)


class TouchEntry(_Entry):
    """One point touched by both tips; see `Touch`."""

    kind: Literal["touch"] = "touch"
    left_q_rad: Six
    right_q_rad: Six
    left_tcp_m: Triple
    right_tcp_m: Triple
    time: Text | None = None


class BarEntry(_Entry):
    """One pose of a bar in both hands; see `BarPose`."""

    kind: Literal["bar"] = "bar"
    left_q_rad: Six
    right_q_rad: Six
    grasp: Text = "1"
    time: Text | None = None


class ViewEntry(_Entry):
    """One view of a board: an image beside the data file, or the board's pose in the camera's frame."""

    kind: Literal["board"] = "board"
    camera_on: Carrier
    board_on: Carrier
    left_q_rad: Six | None = None
    right_q_rad: Six | None = None
    image: Text | None = None
    position_m: Triple | None = None
    rotation_rad: Triple | None = None
    time: Text | None = None


class BoardEntry(_Entry):
    """Board of markers; see `Board`."""

    squares_x: int
    squares_y: int
    square_m: float
    marker_m: float
    dictionary: Text = "DICT_5X5_100"


class CameraEntry(_Entry):
    """Intrinsics of a camera; see `Intrinsics`."""

    matrix_px: tuple[float, float, float, float]
    distortion: Annotated[tuple[float, ...], Field(max_length=8)] = ()


class NoiseEntry(_Entry):
    """Standard deviations; see `Noise`."""

    touch_m: float = Noise.touch_m
    bar_m: float = Noise.bar_m
    bar_rad: float = Noise.bar_rad
    board_m: float = Noise.board_m
    board_rad: float = Noise.board_rad


Entry = Annotated[TouchEntry | BarEntry | ViewEntry, Field(discriminator="kind")]


class DataFile(_Entry):
    """Content of a data file.

    Attributes:
        noise: Standard deviations, where they differ from the defaults.
        board: The board of all views.
        cameras: Known intrinsics by what the camera is mounted on; others are calibrated from its images.
        observations: In the order of their measurement.
    """

    noise: NoiseEntry = NoiseEntry()
    board: BoardEntry | None = None
    cameras: dict[Carrier, CameraEntry] = {}
    observations: Annotated[tuple[Entry, ...], Field(max_length=MAX_OBSERVATIONS)] = ()

    def standard_deviations(self) -> Noise:
        """Return the noise.

        Raises:
            CalibrationError: A value is out of range.
        """
        return Noise(**self.noise.model_dump())

    def measured(self, folder: Path) -> list[Observation]:
        """Return the observations. Boards are located in their images.

        Args:
            folder: Folder that image names start from.

        Raises:
            CalibrationError: An observation is out of range, or an image does not show the board.
            MissingExtraError: There are images, and OpenCV is not installed.
        """
        cameras = {name: Intrinsics(each.matrix_px, each.distortion) for name, each in self.cameras.items()}
        found: list[Observation] = []
        for number, entry in enumerate(self.observations, start=1):
            try:
                found.append(self._measured(entry, folder, cameras))
            except CalibrationError as error:
                raise CalibrationError(f"observation {number}: {error}") from error
        return found

    def corner_views(
        self, folder: Path, frame: Callable[[Carrier, tuple[Six | None, Six | None]], Array]
    ) -> tuple[list[CornerView], tuple[int, int], Carrier]:
        """Return the corners of the board in all images of one camera.

        Args:
            folder: Folder that image names start from.
            frame: Function of a carrier and the joint angles of both arms that returns its pose, (4, 4), in the cell.

        Returns:
            The views, height and width of the images, and what the camera is mounted on.

        Raises:
            CalibrationError: There are no images or no board, they are of several cameras, or an image does not show
                the board.
            MissingExtraError: OpenCV is not installed.
        """
        entries = [each for each in self.observations if isinstance(each, ViewEntry) and each.image is not None]
        carriers = {each.camera_on for each in entries}
        if self.board is None or not entries:
            raise CalibrationError("a camera is calibrated from `board` and observations with an `image`: add them")
        if len(carriers) > 1:
            raise CalibrationError(
                f"the images are of cameras on {' and '.join(sorted(carriers))}: use a data file for each camera"
            )
        board, sizes, views = Board(**self.board.model_dump()), set(), []
        for entry in entries:
            image = read_image(folder / str(entry.image))
            sizes.add((int(image.shape[0]), int(image.shape[1])))
            on_board, in_image = corners(image, board, str(entry.image))
            joints = entry.left_q_rad, entry.right_q_rad
            BoardView(entry.camera_on, entry.board_on, *joints, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))  # checks them
            views.append(CornerView(frame(entry.camera_on, joints), frame(entry.board_on, joints), on_board, in_image))
        if len(sizes) > 1:
            raise CalibrationError("the images differ in size: they are not of one camera. Take them again")
        return views, sizes.pop(), carriers.pop()

    def _measured(self, entry: Any, folder: Path, cameras: dict[Carrier, Intrinsics]) -> Observation:
        if isinstance(entry, TouchEntry):
            return Touch(entry.left_q_rad, entry.right_q_rad, entry.left_tcp_m, entry.right_tcp_m)
        if isinstance(entry, BarEntry):
            return BarPose(entry.left_q_rad, entry.right_q_rad, entry.grasp)
        position, rotation = entry.position_m, entry.rotation_rad
        if (entry.image is None) is (position is None) or (position is None) is not (rotation is None):
            raise CalibrationError("a view needs either `image`, or `position_m` and `rotation_rad`: give one of them")
        if position is None or rotation is None:
            if self.board is None:
                raise CalibrationError("there are images, and the file has no `board`: describe the board in it")
            board = Board(**self.board.model_dump())
            if entry.camera_on not in cameras:
                images = [
                    folder / each.image
                    for each in self.observations
                    if isinstance(each, ViewEntry) and each.camera_on == entry.camera_on and each.image is not None
                ]
                cameras[entry.camera_on] = calibrated_camera(images, board)
            position, rotation = located(folder / entry.image, board, cameras[entry.camera_on])
        return BoardView(entry.camera_on, entry.board_on, entry.left_q_rad, entry.right_q_rad, position, rotation)


def parse(content: bytes, source: str = "the data file") -> DataFile:
    """Parse the content of a data file.

    Raises:
        CalibrationError: It is not valid.
    """
    if len(content) > MAX_BYTES:
        raise CalibrationError(f"{source} is longer than {MAX_BYTES} bytes: name a data file of a calibration")
    try:
        return DataFile.model_validate_json(content)
    except ValidationError as error:
        errors = error.errors(include_url=False, include_input=False, include_context=False)
        findings = listed(errors, lambda each: f"{_place(each['loc'])}{each['msg']}", _MOST_FINDINGS)
        raise CalibrationError(
            f"{source} is no data file of a calibration: {findings}. Correct these places; nothing was changed"
        ) from None


def _place(location: tuple[int | str, ...]) -> str:
    """Return the place in words. Observations are numbered from 1."""
    parts = [str(each + 1) if isinstance(each, int) and k == 1 else str(each) for k, each in enumerate(location)]
    return f"{' '.join(parts)}: " if parts else ""


def read(path: str | Path) -> DataFile:
    """Read a data file.

    Raises:
        CalibrationError: It cannot be read or is not valid.
    """
    path = Path(path)
    content = read_named(
        path,
        MAX_BYTES,
        CalibrationError,
        absent=f"there is no data file {path}: record observations with `--record touch` or `--record bar`, or correct "
        "the name",
        remedy="Correct the name, or the rights of the file",
    )
    return parse(content, str(path))


def append(path: str | Path, entry: TouchEntry | BarEntry | ViewEntry, now: datetime.datetime) -> int:
    """Append an observation to a data file, at once and atomically. The file is made if there is none.

    Programs that append to one file at the same time wait for each other.

    Args:
        path: The data file.
        entry: The observation.
        now: Time of the measurement.

    Returns:
        Number of observations in the file.

    Raises:
        CalibrationError: The existing file is not valid: it stays as it is.
        DualUR10Error: The file cannot be written.
    """
    path = Path(path)
    with _locked(check_target(path).parent):
        data = read(path) if path.exists() else DataFile()
        stamped = entry.model_copy(update={"time": now.isoformat(timespec="seconds")})
        if len(data.observations) >= MAX_OBSERVATIONS:
            raise CalibrationError(f"{path} has {MAX_OBSERVATIONS} observations, the most of a file: name another file")
        grown = data.model_copy(update={"observations": (*data.observations, stamped)})
        write_text(path, grown.model_dump_json(indent=1, exclude_none=True, exclude_defaults=False) + "\n")
    return len(grown.observations)


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Hold a folder locked: a data file itself is replaced whenever it grows."""
    with contextlib.ExitStack() as opened:
        with contextlib.suppress(OSError):  # a file system without locks, or a folder that cannot be read
            number = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
            opened.callback(os.close, number)
            fcntl.flock(number, fcntl.LOCK_EX)
        yield
