"""Start of an episode on two controllers: the operator's confirmation, and the motion of arms, grippers and props."""

from __future__ import annotations

from typing import Final

import numpy as np

from dual_ur10.errors import StartError
from dual_ur10.sim2real.cell.cell import Start
from dual_ur10.sim2real.cell.cell_config import CellConfig
from dual_ur10.sim2real.cell_file.cell_file import CellFile
from dual_ur10.sim2real.commissioning.operator_prompts import Confirm, prompt_for
from dual_ur10.sim2real.control.clearance import Clearance
from dual_ur10.sim2real.control.limits import MotionLimits
from dual_ur10.sim2real.peripherals.grippers import Grippers
from dual_ur10.sim2real.peripherals.object_tracker import ObjectPlacer
from dual_ur10.sim2real.runtime.approach import Approach, Rates, plan
from dual_ur10.sim2real.runtime.path_to_start import PathToStart
from dual_ur10.sim2real.runtime.runner import Runner
from ur_core.kinematics.ur10 import ARMS
from ur_core.processes.system import System
from ur_core.types import Array

_POLL_S: Final = 0.01
_OPENING_S: Final = 4.0
_OPENING_M: Final = 0.003  # largest error of an empty gripper's width


class StartOfEpisode:
    """Brings arms, grippers and props to the start of an episode.

    Args:
        file: Cell file.
        config: Configuration of the cell, with a task's equipment.
        path: Path on which the arms move.
        limits: Limits of the task in task time.
        clearance: Computes the distances of the approach.
        confirm: Called with a description before the arms move; None: see `prompt_for`.
        only: Index of the only arm that moves; None: both.
        grippers: Grippers of the task; None: it has none.
        placer: Puts props where the episode begins; None: a person does.
        system: Clock.
    """

    def __init__(
        self,
        file: CellFile,
        config: CellConfig,
        path: PathToStart,
        *,
        limits: MotionLimits,
        clearance: Clearance,
        confirm: Confirm | None,
        only: int | None,
        grippers: Grippers | None,
        placer: ObjectPlacer | None,
        system: System,
    ) -> None:
        self._file, self._config, self._path, self._system = file, config, path, system
        self._limits, self._clearance, self._confirm, self._only = limits, clearance, confirm, only
        self._grippers, self._placer = grippers, placer

    def check_joints(self, start: Start) -> None:
        """Refuse to believe that a person has put joints where nothing measures them.

        Raises:
            StartError: The start has such a joint, and this cell cannot put it there.
        """
        if self._placer is not None:
            return
        for prop in self._config.equipment.props:
            for joint in prop.joints if not prop.tracked else ():
                if joint in start.joints:
                    raise StartError(
                        f"the task starts with the joint {joint!r} of the prop {prop.name!r} set: this cell has "
                        "nothing that sets joints, and nothing measures what a person does. Let the prop be tracked, "
                        "or leave the joint out of the start"
                    )

    def approach(self, runner: Runner, now: Array, goal: Array, start: Start) -> None:
        """Move both arms from rest at `now` to `goal`, (2, 6) each, after confirmation.

        Raises:
            StalledError: This program stalled. Both arms rest on the path.
            StartError: There is no path, it was not confirmed, or an arm or gripper does not arrive.
        """
        factor = self._file.speed_factor
        rates = Rates(self._config.robots).capped(self._config).within(self._limits, factor)
        arms = ARMS if self._only is None else (ARMS[self._only],)
        approach = plan(now, goal, self._clearance, rates, factor, limits=self._limits, arms=arms)
        self._ask(self._question(approach, start))
        runner.check()  # the confirmation may have taken minutes
        self._open_grippers(runner, start)
        if not runner.begun:
            runner.begin(now)
        self._path.follow(runner, now, approach.targets(self._config.servoj.tick_s))

    def place_props(self, start: Start) -> None:
        """Put props, and their joints, where the episode begins, if this cell can."""
        if self._placer is None or not (start.objects or start.joints):
            return
        for prop in self._config.equipment.props:
            if prop.posed and prop.name in start.objects:
                pose = np.asarray(start.objects[prop.name]).reshape(7)
                self._placer.place(prop.name, pose[:3].tolist(), pose[3:].tolist())
        if start.joints:
            self._placer.set_joints({name: float(np.asarray(each).reshape(())) for name, each in start.joints.items()})
        self._system.clock.sleep(2.0 * _POLL_S)

    def _question(self, approach: Approach, start: Start) -> str:
        angles = np.abs(approach.parts - approach.parts[0]).reshape(-1, 2, 6).max(axis=(0, 2))
        text = ", ".join(
            f"{name} turns a joint by up to {each:.2f} rad" for name, each in zip(ARMS, angles, strict=True)
        )
        lines = [f"The arms move to where the task begins, in {approach.duration_s:.0f} s: {text}."]
        if approach.detour:
            lines.append(
                f"On the straight path {approach.detour}. They move around, in {len(approach.parts) - 1} straight "
                "parts of joint motion, and stop between them: watch them all the way."
            )
        if start.gripper_m is not None and self._grippers is not None:
            lines.append("Before that, the grippers are activated if they are not, and open: what they hold falls.")
        for prop in self._config.equipment.props:
            if prop.free and prop.name in start.objects:
                x, y, z = np.asarray(start.objects[prop.name]).reshape(7)[:3]
                lines.append(f"The {prop.name} should be at ({x:.3f}, {y:.3f}, {z:.3f}) m once they are there.")
            for joint in prop.joints:
                if joint in start.joints:
                    value = float(np.asarray(start.joints[joint]).reshape(()))
                    lines.append(f"The joint {joint} of the {prop.name} should be at {value:.3f} rad, or m, then.")
        lines.append("Keep everybody out of their reach, and a hand at the emergency stop.")
        return " ".join(lines)

    def _ask(self, question: str) -> None:
        """Ask for confirmation.

        Raises:
            StartError: The operator did not confirm.
        """
        confirm = prompt_for(self._file, self._confirm)
        if confirm(question) is not True:
            raise StartError("the motion to the start of the task was not confirmed: the arms have not moved")

    def _open_grippers(self, runner: Runner, start: Start) -> None:
        """Activate grippers where needed, and move them to their start.

        Raises:
            StartError: A gripper does not arrive.
            CellFaulted: The arms were stopped.
        """
        grippers = self._grippers
        if grippers is None:
            return
        held = None if self._only is None else ARMS[1 - self._only]
        grippers.activate(lambda question: True, held=held)  # their opening was confirmed
        if start.gripper_m is None:
            return
        wanted: list[float | None] = [float(each) for each in np.asarray(start.gripper_m).reshape(2)]
        if self._only is not None:
            wanted[1 - self._only] = None  # that one keeps its hold
        grippers.forget()  # a person may have moved them since
        grippers.command(wanted, self._system.clock.now_s())
        end = self._system.clock.now_s() + _OPENING_S
        while True:
            runner.check()
            fault = grippers.fault_except(held)
            if fault:
                raise StartError(f"a gripper does not follow its command: {fault}")
            found = grippers.opening_m
            off = [_is_off(*each) for each in zip(found, wanted, strict=True)]
            if not any(off):
                return
            if self._system.clock.now_s() > end:
                arm = off.index(True)
                raise StartError(
                    f"the {ARMS[arm]} gripper is open by {found[arm]} m after {_OPENING_S:g} s, and not by "
                    f"{wanted[arm]} m: check what is between its fingers"
                )
            self._system.clock.sleep(_POLL_S)


def _is_off(found_m: float | None, wanted_m: float | None) -> bool:
    return found_m is not None and wanted_m is not None and abs(found_m - wanted_m) > _OPENING_M
