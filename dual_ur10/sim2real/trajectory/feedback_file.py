"""Table of a goal's feedback as CSV."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from dual_ur10.errors import TrajectoryError
from dual_ur10.files import check_target
from dual_ur10.kinematics.ur10 import JOINTS
from dual_ur10.sim2real.trajectory.goal import Feedback
from dual_ur10.types import Closing


class FeedbackFile(Closing):
    """New CSV file with a row per period: time, path time, scaling, desired and measured positions, flange errors.

    Args:
        path: The file.
        arms: Arms of the goal.

    Raises:
        TrajectoryError: The file exists, or cannot be written.
        DualUR10Error: Its folder does not exist, or cannot be written to.
    """

    def __init__(self, path: str | Path, arms: tuple[str, ...]) -> None:
        try:
            self._file = check_target(path).open("x", encoding="utf-8", newline="")
        except FileExistsError:
            raise TrajectoryError(f"{path} exists: choose another name, or remove it") from None
        except OSError as error:
            raise TrajectoryError(f"cannot write {path}: {error}") from error
        self._writer = csv.writer(self._file, lineterminator="\n")
        names = [f"{arm}/{joint}" for arm in arms for joint in JOINTS]
        columns = [f"{name}.{kind}_rad" for kind in ("desired", "actual") for name in names]
        flanges = [f"{arm}/flange.error_m" for arm in arms]
        self._writer.writerow(["time_s", "path_s", "scaling", *columns, *flanges])

    def add(self, feedback: Feedback) -> None:
        """Write a row."""
        values = [feedback.desired_q_rad.ravel(), feedback.actual_q_rad.ravel(), feedback.flange_error_m]
        times = [feedback.time_s, feedback.path_s, feedback.scaling]
        self._writer.writerow([f"{each:.9g}" for each in [*times, *np.concatenate(values).tolist()]])

    def close(self) -> None:
        """Close the file. May be called twice."""
        self._file.close()
