"""Cell of two controllers: child processes stream to the arms in real time, and a mirror model shows their state.

It takes the same commands as the simulated cell, and writes them to shared memory before their control periods begin.
Each is followed by the brake that the safety gate has already checked: if the next command is late, both arms brake
along it together.
"""

from __future__ import annotations

import logging
import math
import weakref
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, Final, NoReturn

import numpy as np

from dual_ur10.errors import ActionError, ClosedError, DualUR10Error, LinkError, SettingsError, StartError
from dual_ur10.sim2real.cameras.camera_record import CameraRecord
from dual_ur10.sim2real.cameras.camera_set import CameraSet
from dual_ur10.sim2real.cell.cell import CellRequest, CellState, CellStep, Start
from dual_ur10.sim2real.cell.cell_config import CellConfig
from dual_ur10.sim2real.cell.mirror_model import MirrorModel
from dual_ur10.sim2real.cell_file.cell_file import CellFile
from dual_ur10.sim2real.commissioning.operator_prompts import Confirm
from dual_ur10.sim2real.control.adapter import Command
from dual_ur10.sim2real.control.clearance import Clearance
from dual_ur10.sim2real.control.command_queue import MAX_LATENCY_TICKS
from dual_ur10.sim2real.control.limits import MotionLimits
from dual_ur10.sim2real.peripherals.grippers import Grippers
from dual_ur10.sim2real.peripherals.object_tracker import Flanges, ObjectPlacer, ObjectTracker, placer_of, trackers_of
from dual_ur10.sim2real.runtime.path_to_start import AHEAD_TICKS, PathToStart, StalledError
from dual_ur10.sim2real.runtime.runner import Runner, TargetWriter, least_latency_ticks
from dual_ur10.sim2real.runtime.start_of_episode import StartOfEpisode
from dual_ur10.sim2real.runtime.tracking import PayloadWarning, TemperatureWarning
from ur_core.kinematics.frames import Frames
from ur_core.kinematics.poses import Poses
from ur_core.kinematics.rotations import quat_conjugate, quat_from_rotvec, quat_multiply, rotate
from ur_core.kinematics.ur10 import ARMS
from ur_core.links.arm_status import ArmStatus
from ur_core.mjcf.camera import Camera
from ur_core.processes.machine_load import is_too_busy
from ur_core.processes.system import LOCAL, System
from ur_core.types import Array, Rows

log = logging.getLogger(__name__)

_NOT_OF_FILE: Final = ("equipment", "timestep_s", "integrator", "gains", "meshes", "wrench_noise", "perturbation")
"""Fields that the task sets, or that are visual or of simulation only."""

MOST_COUPLED_M: Final = 0.002
"""Largest error of the arms' relative pose, 1 m from the right base, with which both may hold one object.

Simulated arms press on a welded bar with 7 N per mm of it with the compliant servos, and with 12 to 42 N with stiffer
ones. Nothing is known of real arms.
"""

_COUPLED_LEVER_M: Final = 1.0
_HELD_RAD: Final = 1e-9  # of rounding
_TRIES: Final = 3  # of a connection, and of an approach, while this machine stalls


class RtdeCell:
    """Two arms with their equipment, behind two controllers. Construction connects and checks, and moves nothing.

    Args:
        config: Configuration of a cell file, with a task's equipment.
        ticks: Targets per call of `advance`.
        limits: Limits of the task in task time, from which the gate's brake follows.
        clearance: Computes the distances of the approach.
        latency_ticks: Latency L of commands.
        couples: Both arms may hold one object between them; commands state when they do.
        confirm: Called with a description before the arms move to a start; None: real arms need a yes at the terminal,
            emulated ones none.
        only: "left" or "right": the only arm that moves; None: both.
        cameras: Names of the cameras whose images are observed.
        views: Those of them that the program added to the scene.
        image_size: Height and width of observed images.
        system: Clock, network and processes.

    Attributes:
        images: Images of the observed cameras; None: none are.

    Raises:
        SettingsError: There is no cell file, the configuration differs from it, or the latency is not legal.
        CellFaulted: A latched stop was not cleared.
        CellBusyError: Another program moves one of the arms.
        StartError: A controller is not ready, or the relative pose of the bases is too uncertain for one object.
        LinkError: A controller, a gripper or a camera cannot be reached.
    """

    n = 1

    def __init__(
        self,
        config: CellConfig,
        ticks: int,
        *,
        limits: MotionLimits,
        clearance: Clearance,
        latency_ticks: int,
        couples: bool = False,
        confirm: Confirm | None = None,
        only: str | None = None,
        cameras: Sequence[str] = (),
        views: tuple[Camera, ...] = (),
        image_size: tuple[int, int] = (480, 640),
        system: System = LOCAL,
    ) -> None:
        self.system = system
        self.config, self.file = config, _checked_file(config, latency_ticks, couples)
        self.ticks, self.latency_ticks = ticks, int(latency_ticks)
        self._warned_late = False
        self._tick_s = config.servoj.tick_s
        self._targets = TargetWriter(limits, self._tick_s, max(AHEAD_TICKS, ticks))
        self._path = PathToStart(
            limits,
            clearance,
            self._tick_s,
            ticks,
            self.file.speed_factor,
            self._targets,
            emulated=self.file.kind == "emulated",
        )
        self._limits, self._clearance, self._confirm = limits, clearance, confirm
        self._only = None if only is None else ARMS.index(only)
        self._held_q_rad: Array = np.full(6, np.nan)
        self._mirror = MirrorModel(config.scene)
        self._origin: int | None = None  # number of the target of tick 0 of the episode
        self._elapsed = 0
        self._paused = False  # no command was due since the last one
        self._warnings = [(TemperatureWarning(name), PayloadWarning(name)) for name in ARMS]
        self._grippers: Grippers | None = None
        self._trackers: dict[str, ObjectTracker] = {}
        self._observed, self._views, self._image_size = tuple(cameras), views, image_size
        self.images: CameraSet | None = None
        self._camera_record: CameraRecord | None = None
        self._frames = Frames((config.left, config.right))
        self._placer: ObjectPlacer | None = None
        self._garbage = system.garbage()
        self._relax = system.hurry()  # this program owes actions in time, also while a training fills the machine
        try:
            self._garbage.collect()  # before any thread waits for an answer: in a large program it takes half a second
            self._runner: Runner | None = self._connected()
        except BaseException:
            self._let_go()
            raise
        self._end = weakref.finalize(self, self._runner.close)
        try:
            self._equip()
        except BaseException:
            self.close()
            raise

    def _connected(self) -> Runner:
        """Return a new runner. Where this machine delays emulated controllers, try again: nothing has moved.

        Raises:
            CellFaulted, CellBusyError, StartError, LinkError: As in the constructor.
        """
        left = _TRIES
        while True:
            try:
                return Runner(self.file, self.config, system=self.system)
            except (LinkError, StartError) as error:
                left -= 1
                if not (left and self.file.kind == "emulated" and is_too_busy(str(error))):
                    raise
                log.warning("%s. Nothing has moved; connecting again", error)

    def _equip(self) -> None:
        """Connect to grippers, object trackers, object placer and cameras."""
        equipment, file = self.config.equipment, self.file
        if equipment.grippers:
            for name, arm in zip(ARMS, file.arms, strict=True):
                if arm.gripper.kind == "none":
                    raise SettingsError(f"this task needs grippers, and {name}.gripper in {file.source} is of none")
            runner = self._open
            self._grippers = Grippers(
                file, force_n=equipment.grip_force_n, permitted=lambda: runner.moves_on, system=self.system
            )
        self._trackers = trackers_of(file, equipment.props, self.system)
        self._placer = placer_of(file, self.system)
        if self._observed:
            self.images = CameraSet(
                file, self.config, self._observed, self._image_size, views=self._views, system=self.system
            )
        self._begin = StartOfEpisode(
            file,
            self.config,
            self._path,
            limits=self._limits,
            clearance=self._clearance,
            confirm=self._confirm,
            only=self._only,
            grippers=self._grippers,
            placer=self._placer,
            system=self.system,
        )

    # An episode.

    def reset(
        self,
        start: Start,
        rows: Rows | None = None,
        *,
        seeds: Sequence[int] | None = None,
        perturbation: Mapping[str, Array] | None = None,
    ) -> CellStep:
        """Stop both arms, and after confirmation move them slowly to the start of an episode.

        Args:
            start: Start of the episode.
            rows: Rows of simulated cells; unused.
            seeds: Seeds of simulated cells; unused.
            perturbation: Perturbation of simulated cells; unused.

        Raises:
            StartError: There is no path, it was not confirmed, an arm or gripper does not arrive, or nothing sets or
                measures a joint of a prop.
            CellFaulted: The arms were stopped.
            LinkError: A gripper, the object tracker or an observed camera was lost.
        """
        runner = self._open
        runner.check()
        self._begin.check_joints(start)
        self.finish()
        runner.cell.limit_scaling(1.0)
        if runner.begun:
            runner.wait_for(runner.end)
            now = runner.last()
        else:
            now = np.array([each.q_rad for each in runner.statuses()])
        runner.cell.couple(False)  # the arms rest
        goal = np.array(start.q_rad, dtype=np.float64).reshape(2, 6)
        if self._only is not None:
            goal[1 - self._only] = now[1 - self._only]
        for left in reversed(range(_TRIES)):
            try:
                self._begin.approach(runner, now, goal, start)
                break
            except StalledError as error:
                if not left:
                    raise
                log.warning("%s. They continue from there", error)
                now = runner.last()
        statuses = self._path.arrived(runner, goal)
        self._begin.place_props(start)
        self._mirror.start(start)
        if self._only is not None:
            self._held_q_rad = goal[1 - self._only]
        self._origin, self._elapsed, self._paused = None, 0, False
        self._garbage.prepare_episode()
        return CellStep(self._state(statuses), None if self._only is None else goal[None])

    def advance(self, command: Command) -> CellStep:
        """Send the targets of [now + L, now + L + period), and return the state at now + period, in real time.

        Raises:
            ActionError: A target would move the arm that is held.
            CellFaulted: Both arms have a latched stop, as where a gripper, object tracker or observed camera was
                lost.
        """
        runner = self._open
        runner.check()
        if self._only is not None and not np.allclose(
            command.targets_rad[0, :, 1 - self._only], self._held_q_rad, rtol=0.0, atol=_HELD_RAD
        ):
            raise ActionError(
                f"the {ARMS[1 - self._only]} arm is held, and a target would move it: command the {ARMS[self._only]} "
                "arm alone, or make the environment of both"
            )
        if self._origin is None:
            self._origin = runner.next
        first = self._origin + self._elapsed + self.latency_ticks
        self._elapsed += self.ticks
        runner.cell.limit_scaling(command.scaling)
        runner.cell.couple(command.coupled)
        if not self._targets.write(runner, first, command.targets_rad[0]):
            return self._stopped(runner, first)
        runner.cell.expect(first + self.ticks, live=True)
        self._paused = False
        try:
            if self._grippers is not None and command.gripper_m is not None:
                self._grip(runner, first, command.gripper_m[0, 0])
            end = self._origin + self._elapsed
            runner.wait_for(end)
            statuses = runner.statuses_after(end)
            return CellStep(self._state(statuses), first_target=first, target_q_rad=_targets(statuses))
        except (LinkError, ClosedError) as error:
            self._stop_without_equipment(runner, error)

    def _stop_without_equipment(self, runner: Runner, error: DualUR10Error) -> NoReturn:
        """Make a latched stop of both arms, whose gripper, object tracker or camera has failed.

        Raises:
            CellFaulted: Always, but for a cell that was closed meanwhile.
        """
        runner.stop(str(error))
        runner.check()
        raise error

    def _grip(self, runner: Runner, first: int, width_m: Array) -> None:
        """Command gripper widths for the time of target `first`; none while the speed sliders stop time."""
        at_s = runner.time_of(first)
        if math.isfinite(at_s) and self._grippers is not None:
            widths: list[float | None] = [float(each) for each in width_m]
            if self._only is not None:
                widths[1 - self._only] = None
            self._grippers.command(widths, at_s)

    def _stopped(self, runner: Runner, first: int) -> CellStep:
        """Wait until both arms have stopped, after an action missed the deadline of target `first`."""
        if not (self._warned_late or self._paused):  # further warnings would hide other messages
            self._warned_late = True
            log.warning(
                "an action missed its deadline: both arms stop, and continue from there. Further ones are counted, and "
                "in the record"
            )
        runner.cell.expect(runner.end, live=True)
        runner.wait_for(runner.end)
        rest = runner.last()
        self._targets.rest_at(rest)
        self._origin = runner.next - self._elapsed
        runner.cell.expect(self._origin + self._elapsed + self.latency_ticks, live=True)
        try:
            statuses = runner.statuses()
            step = CellStep(self._state(statuses), rest[None], late=True, first_target=first)
            return step._replace(target_q_rad=_targets(statuses))
        except LinkError as error:
            self._stop_without_equipment(runner, error)

    def finish(self) -> None:
        """End the episode: both arms stop along the brake that follows their targets."""
        if self._runner is not None and self._origin is not None:
            self._paused = True
            self._runner.cell.expect(0.0, live=False)

    def stop(self, reason: str) -> str:
        """Make a latched stop of both arms because of a fault of the program; return what the operator has to do."""
        if self._runner is None:
            return ""
        self._runner.stop(reason)
        try:
            self._runner.check()
        except DualUR10Error as error:
            return str(error)
        return ""

    def model_and_data(self, row: int) -> tuple[Any, Any]:
        """Return the MuJoCo model and data of the mirror model for rendering."""
        return self._mirror.model_and_data()

    def copy_state(self, row: int, model: Any, data: Any) -> None:
        """Copy the measured state to another model of this scene, and that model's data; see `Cell.copy_state`."""
        self._mirror.copy_state(model, data)

    def close(self) -> None:
        """Stop both arms and close all connections. Grippers keep their hold. May be called twice."""
        if self._runner is not None:
            self._runner.close()  # after an interrupt it is called again
            self._end.detach()
            self._runner = None
            self._let_go()
        for each in (self._grippers, *self._trackers.values(), self._placer, self._camera_record, self.images):
            if each is not None:
                each.close()

    def _let_go(self) -> None:
        """Leave the program as it was before this cell was made."""
        self._garbage.release()
        self._relax()

    @property
    def memory_names(self) -> tuple[str, str]:
        """Names of both arms' memories, for the recorder."""
        left, right = self._open.arms
        return left.name, right.name

    @property
    def live_view(self) -> tuple[str, ...]:
        """Path of the view of a live page's process, and the names of the memories that it reads."""
        cameras = () if self.images is None else self.images.memories
        return "dual_ur10.sim2real.runtime.live_view:LiveView", *self.memory_names, self._open.cell.name, *cameras

    def record_cameras(self, folder: Path, begin_s: float, note: Callable[[str, str], None]) -> None:
        """Let all cameras of the cell write videos into the folder of a run; see `CameraRecord`."""
        self._camera_record = CameraRecord(self.file, self.images, folder, begin_s, note, system=self.system)

    def record(self) -> None:
        """Do nothing: the arms' memories hold the record."""

    def integration_state(self) -> bytes | None:
        """Return None: arms have no simulation state."""
        return None

    @property
    def runner(self) -> Runner:
        """Runner of the child processes.

        Raises:
            ClosedError: The cell was closed.
        """
        return self._open

    @property
    def _open(self) -> Runner:
        if self._runner is None:
            raise ClosedError("this cell was closed: make a new one")
        return self._runner

    def __getstate__(self) -> dict[str, Any]:
        raise SettingsError("a cell of two controllers cannot be pickled or copied: there is one of it")

    def _state(self, statuses: Sequence[ArmStatus]) -> CellState:
        """Return the measured state in task time."""
        for warnings, status in zip(self._warnings, statuses, strict=True):
            for warn in warnings:
                warn(status)
        slow = self.file.speed_factor
        q, qd = (np.array([getattr(each, name) for each in statuses]) for name in ("q_rad", "qd_rad_s"))
        widths = wrench = None
        if self._grippers is not None:
            fault = self._grippers.fault_except(None if self._only is None else ARMS[1 - self._only])
            if fault:
                raise LinkError(f"a gripper does not follow its command: {fault}")
            # One without a measurement counts as open.
            widths = np.array(
                [
                    tool.stroke_m if each is None else each
                    for tool, each in zip(self.config.equipment.tools, self._grippers.opening_m, strict=True)
                ]
            )
            wrench = np.array([_wrench_at_flange(each) for each in statuses])
        if self.images is not None:
            self.images.look(self.system.clock.now_s())
        if self._camera_record is not None:
            self._camera_record.poll()
        time_s = self._elapsed * self._tick_s
        state = self._mirror.follow(time_s, q, qd / slow, gripper_m=widths, wrench=wrench)
        if not self._trackers:
            return state
        flanges = Flanges(state.flange_m[0], self._frames.quat_to_cell(state.flange_base_quat)[0])
        now_s = self.system.clock.now_s()
        seen = {name: tracker.pose(now_s, flanges) for name, tracker in self._trackers.items()}
        posed = {each.name for each in self.config.equipment.props if each.posed}
        self._mirror.place(
            {
                name: Poses(np.asarray(each.position_m), np.asarray(each.quat))
                for name, each in seen.items()
                if name in posed
            },
            {joint: value for each in seen.values() for joint, value in each.joints.items()},
        )
        return self._mirror.follow(time_s, q, qd / slow, gripper_m=widths, wrench=wrench)


def _targets(statuses: Sequence[ArmStatus]) -> Array:
    """Return the joint positions, (1, 2, 6), that both controllers want."""
    return np.array([[each.target_q_rad for each in statuses]])


def _check_bases(file: CellFile) -> None:
    """Refuse to hold one object with arms whose relative pose is too uncertain.

    Raises:
        StartError: It is, or the file of a real cell does not state how uncertain.
    """
    stated = file.relative_uncertainty
    remedy = f"measure the bases with `python -m dual_ur10 cell calibrate {file.source}`"
    if stated is None:
        if file.kind == "real":
            raise StartError(
                f"{file.source} does not state how uncertain the bases are, and both arms are to hold one object: "
                f"{remedy}"
            )
        return  # an emulated cell whose bases are known
    error_m = stated[0] + _COUPLED_LEVER_M * stated[1]
    if error_m > MOST_COUPLED_M:
        raise StartError(
            f"the relative pose of the bases is uncertain by {1e3 * stated[0]:.3g} mm and {stated[1]:.3g} rad, "
            f"together {1e3 * error_m:.3g} mm at {_COUPLED_LEVER_M:g} m: with more than {1e3 * MOST_COUPLED_M:g} mm "
            f"both arms must not hold one object. For that, {remedy}"
        )


def _checked_file(config: CellConfig, latency_ticks: int, couples: bool) -> CellFile:
    """Return the cell file of a configuration, after a check of what was asked for.

    Raises:
        SettingsError: There is no cell file, the configuration differs from it, or the latency is not legal.
        StartError: The relative pose of the bases is too uncertain for one object.
    """
    if not isinstance(config.file, CellFile):
        raise SettingsError("a cell of two controllers needs a cell file: pass its path as `cell`")
    least = least_latency_ticks(config.servoj.tick_s)
    if not (isinstance(latency_ticks, int | np.integer) and least <= latency_ticks <= MAX_LATENCY_TICKS):
        raise SettingsError(
            f"action_latency_ticks is {latency_ticks!r}: two controllers need {least} to "
            f"{MAX_LATENCY_TICKS}, the time from a measurement to the first target that follows from it"
        )
    _check_against_file(config)
    if config.equipment.welded:
        raise SettingsError("arms that are welded to what they hold exist in simulation only: use a friction grasp")
    if couples:
        _check_bases(config.file)
    return config.file


def _check_against_file(config: CellConfig) -> None:
    """Check that the configuration is that of the cell file, which the arms' processes use.

    Raises:
        SettingsError: It differs.
    """
    of_file = None if config.file is None else config.file.config()
    for field in fields(config):
        if field.name not in _NOT_OF_FILE and getattr(config, field.name) != getattr(of_file, field.name):
            raise SettingsError(
                f"{field.name} of the cell is {getattr(config, field.name)!r:.200}, and its cell file says "
                f"{getattr(of_file, field.name)!r:.200}: write it there, and pass the path of that file as `cell`"
            )


def _wrench_at_flange(status: ArmStatus) -> Array:
    """Return force and torque about the flange, (6,), in `base`, from those about the tool centre point."""
    wrench = np.array(status.tcp_force)
    offset = status.tcp_offset
    if offset is not None and any(offset[:3]):
        rotation = quat_multiply(quat_from_rotvec(status.tcp_pose[3:]), quat_conjugate(quat_from_rotvec(offset[3:])))
        wrench[3:] += np.cross(rotate(rotation, np.array(offset[:3])), wrench[:3])
    return wrench


def make_rtde_cell(request: CellRequest) -> RtdeCell:
    """Make the cell of two controllers of a request.

    Raises:
        DualUR10Error: See `RtdeCell`.
    """
    return RtdeCell(
        request.config,
        request.ticks,
        limits=request.limits,
        clearance=request.clearance,
        latency_ticks=request.latency_ticks,
        couples=request.couples,
        confirm=request.confirm,
        only=request.only,
        cameras=request.cameras,
        views=request.views,
        image_size=request.image_size,
        system=request.system,
    )
