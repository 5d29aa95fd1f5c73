"""Commands that follow a trajectory: `follow`, `follow-points` on a slow link, and `follow-serial`."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from rich.markup import escape
from rich.table import Table

from dual_ur10.cli.options import CellName, Perturbed, PowerOn, check_extras, console, errors, keywords_of
from dual_ur10.cli.session import interrupts_noted, on_virtual, power_on
from dual_ur10.errors import SettingsError, TrajectoryError
from dual_ur10.sim2real.cell_file.cell_file import load_cell_file
from dual_ur10.sim2real.trajectory.goal import GoalState
from ur_core.files import check_target
from ur_core.kinematics.ur10 import ARMS, JOINTS
from ur_core.processes.interrupts import INTERRUPTED
from ur_core.processes.system import LOCAL, System
from ur_core.types import Array, Closing

if TYPE_CHECKING:
    from dual_ur10.sim2real.cell_file.cell_file import CellFile
    from dual_ur10.sim2real.trajectory.executor import TrajectoryExecutor
    from dual_ur10.sim2real.trajectory.goal import Feedback, GoalResult, TrajectoryGoal
    from dual_ur10.sim2real.trajectory.handle import GoalHandle
    from dual_ur10.sim2real.trajectory.joint_trajectory import JointTrajectory

NOT_REACHED = 1
"""Exit code of a goal that was not reached."""

_SHOWN_S = 1.0
_SAME_RAD = 1e-9
_FORMATS = "A trajectory: .json or .yaml as in ROS's JointTrajectory, or .csv."

_File = Annotated[Path, typer.Argument(metavar="FILE", help=_FORMATS)]
_FileIfAny = Annotated[Path | None, typer.Argument(metavar="FILE", help=_FORMATS)]
_To = Annotated[
    str | None,
    typer.Option(
        "--to",
        metavar="CONFIG",
        help="Move to a configuration, after FILE if there is one, around what is in the way: home, 12 joint "
        "angles with commas, left: or right: and six, or the first point of another file.",
    ),
]
_Retime = Annotated[
    bool,
    typer.Option("--retime", help="Pass the points of FILE as fast as allowed. Times are not needed, and not used."),
]
_Duration = Annotated[float | None, typer.Option("--duration", metavar="S", help="The same, but in this time.")]
_Seed = Annotated[int, typer.Option("--seed", min=0, help="Seed of the planner's samples for --to.")]
_Scaling = Annotated[
    float, typer.Option("--scaling", help="Rate of the trajectory's time, at most 1: slower on the same path.")
]
_PathTolerance = Annotated[
    float | None, typer.Option("--path-tolerance", metavar="RAD", help="Largest distance of a joint from the path.")
]
_GoalTolerance = Annotated[
    float | None, typer.Option("--goal-tolerance", metavar="RAD", help="The same from the last point, at the end.")
]
_GoalTime = Annotated[
    float | None,
    typer.Option("--goal-time", metavar="S", help="Time after the last point in which both arms must rest there."),
]
_Partial = Annotated[
    bool, typer.Option("--allow-partial", help="Leave out the last row of a CSV file if it was cut off.")
]
_Record = Annotated[
    Path | None,
    typer.Option("--record", metavar="CSV", help="Write desired and measured positions to a new file."),
]


def follow(
    file: _FileIfAny = None,
    cell: CellName = None,
    to: _To = None,
    retime: _Retime = False,
    duration: _Duration = None,
    seed: _Seed = 0,
    perturbed: Perturbed = False,
    scaling: _Scaling = 1.0,
    path_tolerance: _PathTolerance = None,
    goal_tolerance: _GoalTolerance = None,
    goal_time: _GoalTime = None,
    power: PowerOn = False,
    partial: _Partial = False,
    record: _Record = None,
) -> None:
    """Follow a trajectory with one arm or both, or move to a configuration: in MuJoCo, or on two controllers.

    The arms first move to the first point: on two controllers slowly, once you confirm it. There, --to without a file
    is this slow motion. Ctrl-C stops both arms on the path; a second one closes the cell.
    """
    from dual_ur10.follower import home_of, make_follower

    check_extras(cell=cell)
    chosen = keywords_of(None, perturbed, on_virtual(cell, None)).get("cell", "mujoco")
    if file is None and to is None:
        raise SettingsError("there is nothing to follow: name a FILE, a configuration with --to, or both")
    if file is None and (retime or duration is not None):
        raise SettingsError("--retime and --duration are for the points of a FILE: name one")
    given = {"path_tolerance_rad": path_tolerance, "goal_tolerance_rad": goal_tolerance, "goal_time_s": goal_time}
    motion = _Goals(home_of(chosen), to, {name: each for name, each in given.items() if each is not None}, seed)
    if file is not None:
        motion.read(file, partial, retime or duration is not None, duration)
    with nullcontext() if record is None else _Table(record, motion.arms) as table:
        if power:
            power_on(cell)
        arms = motion.arms
        with make_follower(chosen, arm=arms[0] if len(arms) < len(ARMS) else None) as executor:
            executor.scaling = scaling
            executor.start(motion.start(cell is not None))
            moved = False
            for goal in motion.goals(executor):
                moved = True
                _reach(executor, goal, table)
            if not moved:
                console.print("[green]the arms are there[/]")


class _Goals:
    """Goals of one command: the points of a file, if one was read, and then a configuration, if one is named.

    Args:
        home: Joint positions of both arms at home, (2, 6) rad.
        to: Text of the configuration.
        tolerances: Tolerances of each goal.
        seed: Seed of the planner's samples.

    Raises:
        DualUR10Error: The text is no configuration, or a tolerance is not legal.
    """

    def __init__(self, home: Array, to: str | None, tolerances: dict[str, Any], seed: int) -> None:
        from dual_ur10.sim2real.trajectory.joint_trajectory import JointTrajectory
        from dual_ur10.sim2real.trajectory.planning import configuration_of

        self._home, self._to, self._tolerances, self._seed = home, to, tolerances, seed
        self._from_file = self._retime = False
        self._duration_s: float | None = None
        self._arms, self._end = (ARMS, home) if to is None else configuration_of(to, home)
        self.goal = self._goal(JointTrajectory(self._arms, np.zeros(1), self._end[None]))

    def read(self, file: Path, partial: bool, retime: bool, duration_s: float | None) -> None:
        """Read the points that come first.

        Raises:
            DualUR10Error: The file cannot be read, is no trajectory, or does not fit the tolerances.
        """
        from dual_ur10.sim2real.trajectory.files import read_trajectory
        from dual_ur10.sim2real.trajectory.joint_trajectory import JointTrajectory

        trajectory = read_trajectory(file, number_points=retime, allow_partial=partial)
        if retime:
            trajectory = JointTrajectory(trajectory.arms, trajectory.time_s, trajectory.q_rad)
        self.goal = self._goal(trajectory)
        self._from_file, self._retime, self._duration_s = True, retime, duration_s

    @property
    def arms(self) -> tuple[str, ...]:
        """Arms of all goals."""
        further = () if self._to is None else self._arms
        return tuple(each for each in ARMS if each in {*self.goal.trajectory.arms, *further})

    def start(self, slowly: bool) -> Array:
        """Return joint positions, (2, 6) rad, to which the arms are brought first; without a file only if `slowly`."""
        start = self._home.copy()
        if self._from_file or slowly:
            start[self.goal.rows] = self.goal.trajectory.q_rad[0]
        return start

    def goals(self, executor: TrajectoryExecutor) -> Iterator[TrajectoryGoal]:
        """Yield the goals; each begins where the one before it ended.

        Raises:
            DualUR10Error: No path or no timing was found.
        """
        from dual_ur10.sim2real.trajectory.planning import plan_to

        if self._from_file:
            yield self._timed(executor) if self._retime else self.goal
        here = executor.desired_q_rad
        there = here.copy()
        there[[ARMS.index(each) for each in self._arms]] = self._end
        if self._to is not None and np.abs(there - here).max() > _SAME_RAD:
            generator = np.random.default_rng(self._seed)
            planned = plan_to(here, there, executor.gate, executor.law, generator, arms=self._arms)
            yield self._goal(planned)

    def _timed(self, executor: TrajectoryExecutor) -> TrajectoryGoal:
        """Return the points of the file, as fast as allowed or in the time that was asked for."""
        from dual_ur10.sim2real.trajectory.path_timing import time_path

        points = self.goal.trajectory
        path = np.repeat(executor.desired_q_rad[None], len(points), axis=0)
        path[:, self.goal.rows] = points.q_rad
        timed = time_path(path, executor.gate, executor.law, arms=points.arms, duration_s=self._duration_s)
        return self._goal(timed)

    def _goal(self, trajectory: JointTrajectory) -> TrajectoryGoal:
        from dual_ur10.sim2real.trajectory.goal import TrajectoryGoal

        return TrajectoryGoal(trajectory, **self._tolerances)


class _Table(Closing):
    """New CSV file with a row per period: time, path time, scaling, desired and measured positions, flange errors.

    Args:
        path: The file.
        arms: Arms of all goals.

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
        self._writer, self._arms = csv.writer(self._file, lineterminator="\n"), arms
        names = [f"{arm}/{joint}" for arm in arms for joint in JOINTS]
        columns = [f"{name}.{kind}_rad" for kind in ("desired", "actual") for name in names]
        flanges = [f"{arm}/flange.error_m" for arm in arms]
        self._writer.writerow(["time_s", "path_s", "scaling", *columns, *flanges])

    def add(self, feedback: Feedback, arms: tuple[str, ...]) -> None:
        """Write a row of a goal of some arms; the columns of the other stay empty."""
        times = [feedback.time_s, feedback.path_s, feedback.scaling]
        values: list[float | None] = []
        for each in (feedback.desired_q_rad, feedback.actual_q_rad, feedback.flange_error_m[:, None]):
            for arm in self._arms:
                values += each[arms.index(arm)].tolist() if arm in arms else [None] * each.shape[1]
        self._writer.writerow(["" if each is None else f"{each:.9g}" for each in [*times, *values]])

    def close(self) -> None:
        """Close the file. May be called twice."""
        self._file.close()


def _reach(executor: TrajectoryExecutor, goal: TrajectoryGoal, table: _Table | None) -> None:
    """Follow a goal until both arms rest, and print the result.

    Raises:
        typer.Exit: It was not reached, or was interrupted.
    """
    # Rich loads modules when it prints first, for which a period has no time.
    trajectory, moved = goal.trajectory, " and ".join(goal.trajectory.arms)
    console.print(f"{moved}: {len(trajectory)} points, {trajectory.duration_s:.2f} s", highlight=False)
    handle = executor.execute(goal)
    shown, interrupted = _FeedbackPrinter(trajectory.duration_s), False

    def seen(feedback: Feedback) -> None:
        shown(feedback)
        if table is not None:
            table.add(feedback, trajectory.arms)

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


def _time(path_s: float, duration_s: float) -> str:
    return f"{path_s:8.2f} of {duration_s:.2f} s"


class _FeedbackPrinter:
    """Prints a feedback per second.

    Args:
        duration_s: Time of the whole path.
    """

    def __init__(self, duration_s: float) -> None:
        self._next_s, self._duration_s = 0.0, duration_s

    def __call__(self, feedback: Feedback) -> None:
        if feedback.path_s < self._next_s:
            return
        self._next_s = feedback.path_s + _SHOWN_S
        console.print(
            f"{_time(feedback.path_s, self._duration_s)}   joints {1e3 * np.abs(feedback.error_rad).max():.3f} mrad   "
            f"flanges {1e3 * feedback.flange_error_m.max():.3f} mm",
            highlight=False,
        )


def _print(goal: TrajectoryGoal, handle: GoalHandle, result: GoalResult) -> None:
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


def follow_points(
    file: _File,
    cell: Annotated[Path, typer.Option("--cell", metavar="FILE", help="The cell file of both controllers.")],
    rate: Annotated[
        float, typer.Option("--rate", metavar="HZ", help="Points per second, at least 2; below 5 by movej.")
    ],
    power: PowerOn = False,
    partial: _Partial = False,
) -> None:
    """Follow a trajectory on a slow link: both controllers interpolate between a few points per second.

    The arms must stand at the first point: `follow --to FILE --cell CELL` brings them there. Ctrl-C stops both arms.
    """
    from dual_ur10.sim2real.trajectory.files import read_trajectory

    trajectory = read_trajectory(file, allow_partial=partial)  # before brakes are released
    if power:
        power_on(cell)
    _stream(trajectory, load_cell_file(cell), rate)


def _stream(trajectory: JointTrajectory, cell: CellFile, rate_hz: float, system: System = LOCAL) -> None:
    """Follow a trajectory with programs on the controllers, which interpolate a few points per second.

    Raises:
        typer.Exit: It was interrupted.
        DualUR10Error: The path is refused, or both arms were stopped.
    """
    from dual_ur10.sim2real.control.link_profiles import profile_for
    from dual_ur10.sim2real.programs.point_stream import PointStream
    from dual_ur10.sim2real.programs.program_box import ProgramBox
    from dual_ur10.sim2real.programs.stream_motion import PathProgress

    next_s = 0.0

    def seen(progress: PathProgress) -> None:
        nonlocal next_s
        if progress.path_s >= next_s:
            next_s = progress.path_s + _SHOWN_S
            console.print(_time(progress.path_s, points.duration_s), highlight=False)

    box = ProgramBox(cell, "points", system=system)
    with PointStream(cell, profile_for(rate_hz, cell.config().servoj), observer=box, system=system) as stream:
        points = stream.points_of(trajectory, stream.measured())
        console.print(f"{len(points.q_rad)} points, {points.duration_s:.2f} s", highlight=False)
        with interrupts_noted() as interrupted:
            if not stream.run(points, canceled=interrupted.is_set, feedback=seen):
                errors.print("interrupted: both arms have stopped", highlight=False)
                raise typer.Exit(INTERRUPTED)
    console.print("[green]both arms are at the last point[/]", highlight=False)


def follow_serial(
    file: _File,
    port: Annotated[str, typer.Option("--port", metavar="PORT", help="Serial port of the arms.")],
    at_start: Annotated[
        bool, typer.Option("--at-start", help="You see that the arms stand at the first point.")
    ] = False,
    scaling: _Scaling = 1.0,
    partial: _Partial = False,
) -> None:
    """Follow a trajectory with servo arms without encoders on a serial line, open-loop.

    Nothing measures these arms, and no safety gate knows them. Ctrl-C slows them down along the path.
    """
    from dual_ur10.sim2real.serial_arm.open_loop_arm import execute, scaled
    from dual_ur10.sim2real.trajectory.files import read_trajectory

    trajectory = scaled(read_trajectory(file, allow_partial=partial), scaling)
    next_s = 0.0

    def seen(time_s: float, q_rad: Array) -> None:
        nonlocal next_s
        if time_s >= next_s:
            next_s = time_s + _SHOWN_S
            console.print(f"{_time(time_s, trajectory.duration_s)}   commanded, not measured", highlight=False)

    with interrupts_noted() as canceled:
        result = execute(trajectory, port, at_start=at_start, canceled=canceled.is_set, feedback=seen)
    succeeded = result.state == GoalState.SUCCEEDED
    console.print(
        f"[{'green' if succeeded else 'red'}]{result.state}[/], {result.code.name} ({result.code.value}): "
        f"{escape(result.text or 'the last point was commanded; nothing measures these arms')}",
        highlight=False,
        soft_wrap=True,
    )
    if not succeeded:
        raise typer.Exit(INTERRUPTED if canceled.is_set() else NOT_REACHED)
