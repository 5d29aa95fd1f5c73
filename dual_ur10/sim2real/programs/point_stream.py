"""Sender of few points per second to both controllers, which interpolate them; see `stream_script`.

It needs no supervisor: each controller's program stops its arm by itself if this program, the link or the other arm's
stop ends the points. What is left to this program is to stop the other arm at once, and to latch the stop.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np

from dual_ur10.errors import DualUR10Error, StartError, TrajectoryError, distinguishable
from dual_ur10.sim2real.cell_file.cell_file import CellFile
from dual_ur10.sim2real.commissioning.operator_prompts import Confirm
from dual_ur10.sim2real.control.limits import MotionLimits
from dual_ur10.sim2real.control.link_profiles import LinkProfile
from dual_ur10.sim2real.programs.program_link import MotionObserver, ProgrammedArms
from dual_ur10.sim2real.programs.stream_motion import PathProgress, StreamMotion, slowed
from dual_ur10.sim2real.programs.stream_script import NOMINAL_RATE, moves_script, points_script
from dual_ur10.sim2real.trajectory.interpolation import Interpolation, JointMotion
from dual_ur10.sim2real.trajectory.joint_trajectory import JointTrajectory, too_long
from dual_ur10.sim2real.trajectory.point_path import PointPath, check_targets
from ur_core.kinematics.ur10 import ARMS
from ur_core.processes.system import LOCAL, System
from ur_core.types import Array

_NEAR_RAD: Final = 1e-3  # from the first point to where the arms stand


class PointStream(ProgrammedArms):
    """Both controllers of a cell, behind a slow link. Construction connects and checks, and moves nothing.

    Args:
        file: Cell file.
        profile: Rate and mode; see `dual_ur10.sim2real.control.link_profiles.profile_for`.
        limits: Limits of motion, in real time; None: the hard limits. Those of the cell file apply in any case.
        confirm: Called with a description before the arms move; None: real arms need a yes at the terminal, emulated
            ones none.
        observer: See `ProgrammedArms`.
        system: Clock, network and state folder.

    Raises:
        StartError: The profile is one of direct `servoj` targets; or see `ProgrammedArms`.
        CellFaulted: See `ProgrammedArms`.
        CellBusyError: See `ProgrammedArms`.
        LinkError: See `ProgrammedArms`.
    """

    def __init__(
        self,
        file: CellFile,
        profile: LinkProfile,
        *,
        limits: MotionLimits | None = None,
        confirm: Confirm | None = None,
        observer: MotionObserver | None = None,
        system: System = LOCAL,
    ) -> None:
        if profile.mode == "servoj":
            raise StartError(
                f"at {profile.rate_hz:g} Hz the runner sends targets itself: make an environment on the cell file, or "
                "use a lower rate"
            )
        self.profile = profile
        config = file.config()
        self._tick_s = config.servoj.tick_s
        # The caps of a cell file are in real time, as these limits are.
        self.limits = replace(config, speed_factor=1.0).capped(MotionLimits() if limits is None else limits)
        self._token = round(1e3 * system.clock.now_s()) % 2**30
        rate_hz = min(1.0 / self._tick_s, 5.0 * profile.rate_hz)
        super().__init__(file, rate_hz, profile.interval_s / 2, confirm=confirm, observer=observer, system=system)

    @property
    def rate(self) -> float:
        """Rate of the path's time on the clock of this program."""
        return 1.0 if self.profile.mode == "movej" else NOMINAL_RATE

    def measured(self) -> Array:
        """Return the measured joint positions, (2, 6).

        Raises:
            StartError: An arm is not ready, moves, or its speed is scaled.
        """
        return self._measured(slowed)

    def thin(self, targets_rad: Array) -> PointPath:
        """Return the points of a path of targets, at the stream's rate and the cell's speed factor.

        Args:
            targets_rad: (n, 2, 6) targets in task time, one per control period, as an adapter makes them; from rest to
                rest.

        Raises:
            TrajectoryError: They are no such targets.
        """
        return PointPath.of_targets(targets_rad, self._tick_s / self._file.speed_factor, self.profile.interval_s)

    def points_of(self, trajectory: JointTrajectory, here_rad: Array) -> PointPath:
        """Return the points of a trajectory, at the stream's rate and the cell's speed factor.

        Args:
            trajectory: Trajectory from rest to rest. A first point later than 0 is reached from where the arms are. An
                arm that is not in it stays.
            here_rad: (2, 6) measured positions.

        Raises:
            TrajectoryError: It does not begin or end at rest, or is too long.
        """
        if text := too_long(trajectory.duration_s):
            raise TrajectoryError(text)
        rows = [ARMS.index(arm) for arm in trajectory.arms]
        motion = Interpolation(trajectory, JointMotion.at_rest(np.asarray(here_rad)[rows]))
        # With a target at rest before the start and one after the end, as cubics begin and end with an acceleration.
        ticks = np.arange(-1, 2 + math.ceil(trajectory.duration_s / self._tick_s), dtype=np.float64)
        targets = np.tile(here_rad, (len(ticks), 1, 1))
        targets[:, rows] = motion(self._tick_s * ticks).q_rad
        return self.thin(targets)

    def check(self, path: PointPath) -> None:
        """Pass a whole path through the safety gate, as the controllers will interpolate it.

        Raises:
            TrajectoryError: The gate refuses it, or it has other intervals than this stream.
        """
        interval_s = self.profile.interval_s
        if path.interval_s != interval_s:
            raise TrajectoryError(
                f"the path has a point every {path.interval_s:g} s, and this stream sends one every {interval_s:g} s: "
                "take its points at this interval"
            )
        targets = path.stops(self._tick_s) if self.profile.mode == "movej" else path.targets(self._tick_s)
        check_targets(targets, self.limits, self._tick_s, max(1, round(interval_s / self._tick_s)), self._clearance)

    def run(
        self,
        path: PointPath,
        *,
        canceled: Callable[[], bool] | None = None,
        feedback: Callable[[PathProgress], None] | None = None,
    ) -> bool:
        """Follow a path with both arms, and return True at its end.

        Args:
            path: The path, from where the arms are.
            canceled: Called at each event; True stops both arms, and the method returns False once both reported it.
            feedback: Called with each state of a moving arm.

        Raises:
            TrajectoryError: The gate refuses the path, or it begins elsewhere. Nothing has moved.
            StartError: An arm is not ready, or the motion was not confirmed. Nothing has moved.
            CellFaulted: Both arms were stopped, which is latched.
        """
        self._claim.latch.check()
        self.check(path)
        self._check_start(path)
        if self._confirm(f"Both arms follow a path of {path.duration_s:.1f} s from where they are.") is not True:
            raise StartError("the motion was not confirmed: nothing has moved")
        self._check_start(path)  # the answer may have taken minutes
        motion = StreamMotion(
            self._arms, path, self.profile, self._clock, feedback, emulated=self._file.kind == "emulated"
        )
        self._claim.note_moving()
        try:
            for arm in self._arms:
                self._token += 1
                arm.upload(self._script(self._token), self._token)
            reached = motion.run(canceled or (lambda: False))
            self._claim.note_stopped()
            return reached
        except (Exception, KeyboardInterrupt, SystemExit) as error:
            self._stop(self._arms)
            if isinstance(error, StartError) and not motion.begun:
                self._claim.note_stopped()  # a program that was not told to move does not
                raise
            faulted = self._latched(error)
            if not isinstance(error, DualUR10Error):
                raise
            raise faulted from error

    def _check_start(self, path: PointPath) -> None:
        """Check that both arms are ready where a path begins.

        Raises:
            TrajectoryError: It begins elsewhere.
            StartError: See `measured`.
        """
        here = self.measured()
        off = np.abs(here - path.q_rad[0])
        if off.max() > _NEAR_RAD:
            arm, joint = np.unravel_index(off.argmax(), off.shape)
            found, allowed = distinguishable(float(off.max()), _NEAR_RAD)
            raise TrajectoryError(
                f"the path begins {found} rad from where joint {joint} of the {ARMS[arm]} arm is, allowed are "
                f"{allowed}: bring the arms to its first point, as `follow --to FILE --cell CELL` does, or begin where "
                "they are"
            )

    def _script(self, token: int) -> str:
        speed = max(self.limits.speed_rad_s)
        if self.profile.mode == "movej":
            return moves_script(token, self.profile.servoj, speed, self.profile.interval_s)
        return points_script(token, self.profile.servoj, speed)
