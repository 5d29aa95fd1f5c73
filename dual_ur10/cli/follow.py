"""The command `follow`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from rich.markup import escape
from rich.table import Table

from dual_ur10.cli.options import (
    CellFileName,
    Perturbed,
    PowerOn,
    console,
    errors,
    interrupts_noted,
    keywords_of,
    power_on,
)
from dual_ur10.errors import SettingsError
from dual_ur10.kinematics.ur10 import ARMS, JOINTS
from dual_ur10.sim2real.config.cell_file import load_cell_file
from dual_ur10.sim2real.processes.interrupts import INTERRUPTED
from dual_ur10.sim2real.processes.system import LOCAL, System
from dual_ur10.sim2real.trajectory.goal import GoalState
from dual_ur10.types import Array

if TYPE_CHECKING:
    from dual_ur10.sim2real.config.cell_file import CellFile
    from dual_ur10.sim2real.trajectory.executor import TrajectoryExecutor
    from dual_ur10.sim2real.trajectory.feedback_file import FeedbackFile
    from dual_ur10.sim2real.trajectory.goal import Feedback, Result, TrajectoryGoal
    from dual_ur10.sim2real.trajectory.handle import GoalHandle
    from dual_ur10.sim2real.trajectory.joint_trajectory import JointTrajectory

NOT_REACHED = 1
"""Exit code of a goal that was not reached."""

_SHOWN_S = 1.0
_SAME_RAD = 1e-9


def follow(
    file: Annotated[
        Path | None,
        typer.Argument(metavar="FILE", help="A trajectory: .json or .yaml as in ROS's JointTrajectory, or .csv."),
    ] = None,
    cell: CellFileName = None,
    to: Annotated[
        str | None,
        typer.Option(
            "--to",
            metavar="CONFIG",
            help="Move to a configuration, after FILE if there is one, around what is in the way: home, 12 joint "
            "angles with commas, left: or right: and six, or the first point of another file.",
        ),
    ] = None,
    retime: Annotated[
        bool,
        typer.Option(
            "--retime", help="Pass the points of FILE as fast as allowed. Times are not needed, and not used."
        ),
    ] = False,
    duration: Annotated[
        float | None, typer.Option("--duration", metavar="S", help="The same, but in this time.")
    ] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the planner's samples for --to.")] = 0,
    perturbed: Perturbed = False,
    scaling: Annotated[
        float, typer.Option("--scaling", help="Rate of the trajectory's time, at most 1: slower on the same path.")
    ] = 1.0,
    path_tolerance: Annotated[
        float | None, typer.Option("--path-tolerance", metavar="RAD", help="Largest distance of a joint from the path.")
    ] = None,
    goal_tolerance: Annotated[
        float | None, typer.Option("--goal-tolerance", metavar="RAD", help="The same from the last point, at the end.")
    ] = None,
    goal_time: Annotated[
        float | None,
        typer.Option("--goal-time", metavar="S", help="Time after the last point in which both arms must rest there."),
    ] = None,
    power: PowerOn = False,
    partial: Annotated[
        bool,
        typer.Option("--allow-partial", help="Leave out the last row of a CSV file if it was cut off."),
    ] = False,
    serial: Annotated[
        str | None,
        typer.Option("--serial", metavar="PORT", help="Servo arms without encoders on this serial port, open-loop."),
    ] = None,
    at_start: Annotated[
        bool, typer.Option("--at-start", help="With --serial: you see that these arms stand at the first point.")
    ] = False,
    rate: Annotated[
        float | None,
        typer.Option(
            "--rate",
            metavar="HZ",
            help="With --cell, on a slow link: points per second, interpolated by controllers. The arms must stand at "
            "the first point: `follow --to FILE` brings them there.",
        ),
    ] = None,
    record: Annotated[
        Path | None,
        typer.Option("--record", metavar="CSV", help="Write desired and measured positions to a new file."),
    ] = None,
) -> None:
    """Follow a trajectory with one arm or both, or move to a configuration: in MuJoCo, on controllers or a serial line.

    The arms first move to the first point, except with --rate and --serial: on two controllers slowly, once you confirm
    it. There, --to without a file is this slow motion. Ctrl-C stops both arms on the path; a second one closes the
    cell.
    """
    from dual_ur10.envs.core.follower import home_of, make_follower
    from dual_ur10.sim2real.trajectory.feedback_file import FeedbackFile
    from dual_ur10.sim2real.trajectory.files import read_trajectory
    from dual_ur10.sim2real.trajectory.goal import TrajectoryGoal
    from dual_ur10.sim2real.trajectory.joint_trajectory import JointTrajectory
    from dual_ur10.sim2real.trajectory.path_timing import time_path
    from dual_ur10.sim2real.trajectory.planning import configuration_of, plan_to

    keywords = keywords_of(None, perturbed, cell)
    if file is None and to is None:
        raise SettingsError("there is nothing to follow: name a FILE, a configuration with --to, or both")
    if file is None and (retime or duration is not None):
        raise SettingsError("--retime and --duration are for the points of a FILE: name one")
    retime = retime or duration is not None
    # What these two ways cannot honour is refused: nobody shall rely on a bound that nothing checks.
    unchecked = {
        "--path-tolerance": path_tolerance is not None,
        "--goal-tolerance": goal_tolerance is not None,
        "--goal-time": goal_time is not None,
        "--perturbed": perturbed,
        "--record": record is not None,
        "--to": to is not None,
        "--retime": retime,
    }
    if serial is not None or at_start:
        if file is None:
            raise SettingsError("arms on a serial line follow a FILE: name one")
        others = {"--cell": cell is not None, "--power-on": power, "--rate": rate is not None, **unchecked}
        names = [name for name, given in others.items() if given]
        _follow_on_line(read_trajectory(file, allow_partial=partial), serial, at_start, scaling, names)
        return
    if rate is not None:
        names = [name for name, given in {**unchecked, "--scaling": scaling != 1.0}.items() if given]
        if file is None or cell is None or names:
            raise SettingsError(
                f"--rate follows a FILE with the controllers of --cell{f', without {names[0]}' if names else ''}: name "
                "both, and leave the rest out"
            )
        if power:
            power_on(cell)
        _follow_points(read_trajectory(file, allow_partial=partial), load_cell_file(cell), rate)
        return
    given: dict[str, Any] = {
        "path_tolerance_rad": path_tolerance,
        "goal_tolerance_rad": goal_tolerance,
        "goal_time_s": goal_time,
    }
    tolerances = {name: each for name, each in given.items() if each is not None}

    home = home_of(keywords.get("cell", "mujoco"))
    arms, end = (ARMS, home) if to is None else configuration_of(to, home)
    trajectory = JointTrajectory(arms, np.zeros(1), end[None])
    if file is not None:
        trajectory = read_trajectory(file, number_points=retime, allow_partial=partial)
        if retime:
            trajectory = JointTrajectory(trajectory.arms, trajectory.time_s, trajectory.q_rad)
    goal = TrajectoryGoal(trajectory, **tolerances)
    start = home.copy()
    if file is not None or cell is not None:
        start[goal.rows] = trajectory.q_rad[0]

    def goals(executor: TrajectoryExecutor) -> Iterator[TrajectoryGoal]:
        if retime:
            path = np.repeat(executor.desired_q_rad[None], len(trajectory), axis=0)
            path[:, goal.rows] = trajectory.q_rad
            timed = time_path(path, executor.gate, executor.law, arms=trajectory.arms, duration_s=duration)
            yield replace(goal, trajectory=timed)
        elif file is not None:
            yield goal
        here = executor.desired_q_rad
        there = here.copy()
        there[[ARMS.index(each) for each in arms]] = end
        if to is not None and np.abs(there - here).max() > _SAME_RAD:
            generator = np.random.default_rng(seed)
            planned = plan_to(here, there, executor.gate, executor.law, generator, arms=trajectory.arms)
            yield TrajectoryGoal(planned, **tolerances)

    table = None if record is None else FeedbackFile(record, trajectory.arms)
    with nullcontext() if table is None else table:
        if power:
            power_on(cell)
        only = trajectory.arms[0] if len(trajectory.arms) < len(ARMS) else None
        with make_follower(keywords.get("cell", "mujoco"), arm=only) as executor:
            executor.scaling = scaling
            executor.start(start)
            moved = False
            for each in goals(executor):
                moved = True
                _reach(executor, each, table)
            if not moved:
                console.print("[green]the arms are there[/]")


def _reach(executor: TrajectoryExecutor, goal: TrajectoryGoal, table: FeedbackFile | None) -> None:
    """Follow a goal until both arms rest, and print the result.

    Raises:
        typer.Exit: It was not reached, or was interrupted.
    """
    # Rich loads modules when it prints first, for which a period has no time.
    trajectory, moved = goal.trajectory, " and ".join(goal.trajectory.arms)
    console.print(f"{moved}: {len(trajectory)} points, {trajectory.duration_s:.2f} s", highlight=False)
    handle = executor.execute(goal)
    shown, interrupted = _Shown(), False

    def seen(feedback: Feedback) -> None:
        shown(feedback)
        if table is not None:
            table.add(feedback)

    try:
        result = handle.wait(seen)
    except KeyboardInterrupt:
        interrupted = True
        errors.print("interrupted: both arms stop on the path", highlight=False)
        handle.cancel()
        result = handle.wait(seen)
    _print(goal, handle, result)
    if not result.succeeded:
        raise typer.Exit(INTERRUPTED if interrupted else NOT_REACHED)


def _follow_points(trajectory: JointTrajectory, cell: CellFile, rate_hz: float, system: System = LOCAL) -> None:
    """Follow a trajectory with programs on the controllers, which interpolate a few points per second.

    Raises:
        typer.Exit: It was interrupted.
        DualUR10Error: The path is refused, or both arms were stopped.
    """
    from dual_ur10.sim2real.control.link_profiles import profile_for
    from dual_ur10.sim2real.recording.program_box import ProgramBox
    from dual_ur10.sim2real.runtime.point_stream import PointStream
    from dual_ur10.sim2real.runtime.stream_motion import Progress

    next_s = 0.0

    def seen(progress: Progress) -> None:
        nonlocal next_s
        if progress.path_s >= next_s:
            next_s = progress.path_s + _SHOWN_S
            console.print(f"{progress.path_s:8.2f} s", highlight=False)

    box = ProgramBox(cell, "points", system=system)
    with PointStream(cell, profile_for(rate_hz, cell.config().servoj), observer=box, system=system) as stream:
        points = stream.points_of(trajectory, stream.measured())
        console.print(f"{len(points.q_rad)} points, {points.duration_s:.2f} s", highlight=False)
        with interrupts_noted() as interrupted:
            if not stream.run(points, canceled=interrupted.is_set, feedback=seen):
                errors.print("interrupted: both arms have stopped", highlight=False)
                raise typer.Exit(INTERRUPTED)
    console.print("[green]both arms are at the last point[/]", highlight=False)


def _follow_on_line(
    trajectory: JointTrajectory, port: str | None, at_start: bool, scaling: float, others: list[str]
) -> None:
    """Follow a trajectory with the arms on a serial line.

    Raises:
        SettingsError: Options do not go together, or the scaling is not legal.
    """
    from dual_ur10.sim2real.peripherals.open_loop_arm import execute, scaled

    if port is None:
        raise SettingsError("--at-start is for arms on a serial line: name their port with --serial, or leave it out")
    if others:
        raise SettingsError(f"{others[0]} is not for arms on a serial line: leave it out, or --serial")
    next_s = 0.0

    def seen(time_s: float, q_rad: Array) -> None:
        nonlocal next_s
        if time_s >= next_s:
            next_s = time_s + _SHOWN_S
            console.print(f"{time_s:8.2f} s   commanded, not measured", highlight=False)

    with interrupts_noted() as canceled:
        result = execute(scaled(trajectory, scaling), port, at_start=at_start, canceled=canceled.is_set, feedback=seen)
    succeeded = result.state == GoalState.SUCCEEDED
    console.print(
        f"[{'green' if succeeded else 'red'}]{result.state}[/], {result.code.name} ({result.code.value}): "
        f"{escape(result.text or 'the last point was commanded; nothing measures these arms')}",
        highlight=False,
        soft_wrap=True,
    )
    if not succeeded:
        raise typer.Exit(INTERRUPTED if canceled.is_set() else NOT_REACHED)


class _Shown:
    """Prints a feedback per second."""

    def __init__(self) -> None:
        self._next_s = 0.0

    def __call__(self, feedback: Feedback) -> None:
        if feedback.path_s < self._next_s:
            return
        self._next_s = feedback.path_s + _SHOWN_S
        console.print(
            f"{feedback.path_s:8.2f} s   joints {1e3 * np.abs(feedback.error_rad).max():.3f} mrad   flanges "
            f"{1e3 * feedback.flange_error_m.max():.3f} mm",
            highlight=False,
        )


def _print(goal: TrajectoryGoal, handle: GoalHandle, result: Result) -> None:
    if handle.feedback is not None:
        table = Table(header_style="bold")
        for header in ("arm", "largest joint error\n[dim]mrad[/]", "of", "RMS\n[dim]mrad[/]"):
            table.add_column(header, justify="left" if header in ("arm", "of") else "right")
        table.add_column("largest flange error\n[dim]mm[/]", justify="right")
        table.add_column("RMS\n[dim]mm[/]", justify="right")
        for row, arm in enumerate(goal.trajectory.arms):
            joint = int(result.largest_error_rad[row].argmax())
            table.add_row(
                arm,
                f"{1e3 * result.largest_error_rad[row, joint]:.4f}",
                JOINTS[joint],
                f"{1e3 * result.rms_error_rad[row].max():.4f}",
                f"{1e3 * result.largest_flange_error_m[row]:.4f}",
                f"{1e3 * result.rms_flange_error_m[row]:.4f}",
            )
        console.print(table)
    colour = "green" if result.succeeded else "red"
    console.print(
        f"[{colour}]{result.state}[/], {result.code.name} ({result.code.value}), after {result.time_s:.2f} s: "
        f"{escape(result.text)}",
        highlight=False,
        soft_wrap=True,
    )
