"""Interface of a cell of two arms: its state, its steps and the request for one.

A cell executes joint targets tick by tick and returns its state; it does not depend on tasks. The simulated cell is
`dual_ur10.envs.sim.mujoco_cell.MujocoCell`, the dry run `dual_ur10.envs.sim.echo_cell.EchoCell`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from dual_ur10.assets.prop import Prop
from dual_ur10.errors import TaskError, UnknownNameError
from dual_ur10.sim2real.cell.cell_config import CellConfig
from dual_ur10.sim2real.control.adapter import Command
from dual_ur10.sim2real.control.clearance import Clearance
from dual_ur10.sim2real.control.limits import MotionLimits
from ur_core.kinematics.poses import Poses
from ur_core.mjcf.camera import Camera
from ur_core.processes.system import LOCAL, System
from ur_core.types import Array, Rows


class CellState(NamedTuple):
    """Measurements of n cells at one instant, limited to those of a real cell.

    The arrays belong to the cell and change with its next call: copy those that you keep.

    Attributes:
        time_s: (n,) time since the reset, a whole number of ticks.
        q_rad: (n, 2, 6) joint positions.
        qd_rad_s: (n, 2, 6) joint speeds.
        flange_base_m: (n, 2, 3) flange position in each arm's own `base` frame, as UR's controller reports it.
        flange_base_quat: (n, 2, 4) flange orientation in that frame, (w, x, y, z).
        flange_m: (n, 2, 3) flange position in the cell frame.
        failed: (n,) true if the physics diverged; the other values of such a row are those of its last valid instant.
        flange_quat: (n, 2, 4) flange orientation in the cell frame, (w, x, y, z).
        gripper_m: (n, 2) opening of each gripper; None without grippers, like the wrench.
        wrench: (n, 2, 6) force (N) and torque about the flange (N·m) of the gripped object on each gripper, in the
            arm's `base` frame; the gripper's own weight is subtracted, as by a controller that knows its payload.
        objects: Poses of the props that move or are placed, by their names: position_m (n, 3) in the cell frame, and
            quat (n, 4).
        joints: Positions of the props' hinges (rad) and slides (m), (n,) each, by their names.
    """

    time_s: Array
    q_rad: Array
    qd_rad_s: Array
    flange_base_m: Array
    flange_base_quat: Array
    flange_m: Array
    failed: NDArray[np.bool_]
    flange_quat: Array | None = None
    gripper_m: Array | None = None
    wrench: Array | None = None
    objects: Mapping[str, Poses] = MappingProxyType({})
    joints: Mapping[str, Array] = MappingProxyType({})


class Start(NamedTuple):
    """Initial state of an episode in k cells.

    Attributes:
        q_rad: (k, 2, 6) joint positions, at rest.
        gripper_m: (k, 2) opening of each gripper; None without grippers.
        objects: Poses of props by their names, (k, 7) position in the cell frame and orientation (w, x, y, z) each.
            One that is left out is where its MJCF has it; then that states a `pos`.
        joints: Positions of the props' joints by their names, (k,) each; one that is left out is as in the MJCF.
        sampled: Random values of the episode by name, (k, ...) each.
        commanded_m: (k, 2) width that each gripper is commanded, in simulation: fingers press on what is between them.
            None: `gripper_m`.
        payload_kg: (k, 2) mass in each gripper that simulated controllers know from the start; None: none.
    """

    q_rad: Array
    gripper_m: Array | None = None
    objects: Mapping[str, Array] = MappingProxyType({})
    joints: Mapping[str, Array] = MappingProxyType({})
    sampled: Mapping[str, Array] = MappingProxyType({})
    commanded_m: Array | None = None
    payload_kg: Array | None = None

    @property
    def widths_m(self) -> Array | None:
        """Commanded widths of the grippers, (k, 2); None without grippers."""
        return self.gripper_m if self.commanded_m is None else self.commanded_m


def check_start(start: Start, props: Sequence[Prop]) -> None:
    """Check that a start names props and joints of the scene only, and leaves out no prop that has to be placed.

    Raises:
        UnknownNameError: It names another one.
        TaskError: It leaves out a prop whose MJCF states no position, which would be at the cell's origin.
    """
    for prop in props:
        if prop.posed and not prop.located and prop.name not in start.objects:
            raise TaskError(
                f"the start of an episode leaves out the prop {prop.name!r}, which would be at the cell's origin: give "
                f"Start.objects[{prop.name!r}] its pose, or the body in its MJCF a pos"
            )
    posed = [each.name for each in props if each.posed]
    joints = [joint for each in props for joint in each.joints]
    for kind, found, allowed in (("prop that is placed", start.objects, posed), ("joint", start.joints, joints)):
        for name in found:
            if name not in allowed:
                raise UnknownNameError(f"{kind}, in the start of an episode,", name, allowed)


class TickTrace(NamedTuple):
    """Targets and joint states of one simulated cell at the end of every tick of a step.

    Attributes:
        sent_rad: (ticks, 2, 6) targets as sent.
        reference_rad: (ticks, 2, 6) output of the servoj law.
        q_rad: (ticks, 2, 6) joint positions.
        qd_rad_s: (ticks, 2, 6) joint speeds.
    """

    sent_rad: Array
    reference_rad: Array
    q_rad: Array
    qd_rad_s: Array


class CellStep(NamedTuple):
    """State of n cells after a reset or a step, and how the step was executed.

    Attributes:
        state: State at the end of the step.
        stopped_q_rad: (n, 2, 6) joint positions at which the arms stopped, instead of those commanded; the next command
            must continue from them. None: the arms follow the commands.
        late: True if the command missed its deadline, so that both arms stopped and none of its targets was sent.
        first_target: Number of the command's first target among those sent, or where it would have been; None: the
            recorder counts the targets itself.
        target_q_rad: (n, 2, 6) joint positions that the controllers want at the end of the step: those of arms without
            tracking errors; None: where the arms are.
        trace: Every tick of the step; None: not kept.
    """

    state: CellState
    stopped_q_rad: Array | None = None
    late: bool = False
    first_target: int | None = None
    target_q_rad: Array | None = None
    trace: TickTrace | None = None


class SeenImage(NamedTuple):
    """Image that a camera of a cell of controllers took.

    Attributes:
        image: (height, width, 3).
        exposed_s: Time of its exposure on the system's clock.
    """

    image: NDArray[np.uint8]
    exposed_s: float


class SeenImages(Protocol):
    """Images of the cameras of a cell of controllers. Such a cell has them as its attribute `images`.

    Attributes:
        seen: Image of each observed camera at the last state, by its name.
        looked_s: Time of that state on the system's clock.
    """

    seen: Mapping[str, SeenImage]
    looked_s: float


class Cell(Protocol):
    """Two arms behind one interface: simulated, emulated or real.

    Attributes:
        n: Number of cells.
    """

    n: int

    def reset(
        self,
        start: Start,
        rows: Rows | None = None,
        *,
        seeds: Sequence[int] | None = None,
        perturbation: Mapping[str, Array] | None = None,
    ) -> CellStep:
        """Bring all cells, or `rows` of them, to the start of an episode."""

    def advance(self, command: Command) -> CellStep:
        """Send the targets of one policy period, and return the state at its end."""

    def finish(self) -> None:
        """End the episode: no more targets follow, and arms that still move stop."""

    def stop(self, reason: str) -> str:
        """Make a latched stop of both arms, because of a fault of the commanding program.

        Returns:
            What the operator has to do now; "" if nothing moves without this program.
        """

    def model_and_data(self, row: int) -> tuple[Any, Any]:
        """Return MuJoCo's model and data of one cell, for a viewer: the same objects at every call, updated."""

    def copy_state(self, row: int, model: Any, data: Any) -> None:
        """Copy the state of one cell to another model of its scene, and that model's data.

        Derived quantities are not computed. Threads may call it at the same time, each with a model of its own.
        """

    def close(self) -> None:
        """Release everything. May be called twice."""


@dataclass(frozen=True, kw_only=True)
class CellRequest:
    """Request for a cell, from which the factory of its kind makes it.

    Attributes:
        config: Configuration, with a task's equipment.
        ticks: Controller ticks per call of `Cell.advance`.
        limits: Motion limits, which all targets keep already.
        clearance: Distances between bodies, for motions to a start.
        n: Number of cells.
        threads: Number of threads to compute on.
        latency_ticks: Delay of commands in ticks.
        randomized: True if anything differs from episode to episode.
        varied: Names of the values of `Perturbation` that differ from episode to episode.
        contacts: True if bodies may touch.
        couples: True if both arms may hold one object between them; commands state when they do.
        confirm: Called with a description before arms of controllers move to a start; None: the cell decides.
        only: "left" or "right": the only arm that moves; None: both may.
        cameras: Names of the cameras whose images are observed.
        views: Those of them that the program added to the scene.
        image_size: Height and width of observed images.
        system: Clock, network and threads.
    """

    config: CellConfig
    ticks: int
    limits: MotionLimits
    clearance: Clearance
    n: int = 1
    threads: int = 1
    latency_ticks: int = 0
    randomized: bool = False
    varied: tuple[str, ...] = ()
    contacts: bool = True
    couples: bool = False
    confirm: Callable[[str], bool] | None = None
    only: str | None = None
    cameras: tuple[str, ...] = ()
    views: tuple[Camera, ...] = ()
    image_size: tuple[int, int] = (480, 640)
    system: System = LOCAL
