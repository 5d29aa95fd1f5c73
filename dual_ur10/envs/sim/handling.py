"""Grippers and props in a batch of MuJoCo models: poses, wrenches, and the grippers' controllers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dual_ur10.assets.prop import Prop
from dual_ur10.assets.scene import sensor_slices
from dual_ur10.assets.settings import SceneSettings
from dual_ur10.envs.sim.feedforward import GRAVITY_M_S2
from dual_ur10.errors import ActionError, UnknownNameError
from dual_ur10.sim2real.cell.cell import Start
from dual_ur10.sim2real.cell.cell_config import CellConfig
from ur_core.kernel import RowLoop, Struct
from ur_core.kinematics.frames import to_base
from ur_core.kinematics.poses import Poses
from ur_core.kinematics.ur10 import ARMS
from ur_core.tools.tool import Tool, strokes_m
from ur_core.types import Array, Rows

_SLACK = 1.5  # of the lead of the servo's reference that full force needs

_WELDED_M = 0.04  # width of grippers that are welded to the bar


LATENCY_S: Final = 0.1
"""Delay from a command to the first motion, as in UMI's deployment configuration for its grippers."""


class GripperServos:
    """Controllers of both grippers of n cells: the width follows the delayed command at the gripper's speed.

    A finger that touches something stops there and presses. Its reference then stays a little ahead, so that it lets go
    at once when commanded, as a real gripper does, which measures its width.

    Args:
        n: Number of cells.
        ticks: Ticks per call.
        tick_s: Time between two commands.
        substeps: Physics steps per tick.
        slack_m: (2,) largest distance of each reference ahead of the fingers: more than full force needs.
        tools: Tools of both arms.
    """

    def __init__(
        self, n: int, ticks: int, tick_s: float, substeps: int, slack_m: Array, tools: tuple[Tool, Tool]
    ) -> None:
        delay = round(LATENCY_S / tick_s)
        self._most_m: Array = np.array(strokes_m(tools))
        self._waiting: Array = np.tile(self._most_m, (n, delay, 1))
        self._reference: Array = np.tile(self._most_m, (n, 1))
        self._commanded: Array = np.zeros((n, ticks, 2))
        self._opening: Array = np.zeros((n, 2))
        self._widths: Array = np.zeros((n, ticks * substeps, 2))
        struct = Struct(
            "Grippers",
            n=n,
            ticks=ticks,
            substeps=substeps,
            delay=delay,
            step_m=np.array([tool.speed_m_s[1] * tick_s for tool in tools]),
            slack_m=slack_m,
            commanded_m=self._commanded,
            opening_m=self._opening,
            waiting_m=self._waiting,
            reference_m=self._reference,
            widths_m=self._widths,
        )
        self._step = RowLoop("grippers_step", struct, n, 1)

    def reset(self, opening_m: Array, rows: Rows) -> None:
        """Start `rows` at rest at the widths, (len(rows), 2)."""
        self._waiting[rows] = opening_m[:, None]
        self._reference[rows] = opening_m

    def __call__(self, commanded_m: Array, opening_m: Array) -> Array:
        """Return the references of every physics step, (n, ticks * substeps, 2): the same array at every call.

        Args:
            commanded_m: (n, ticks, 2) commanded widths.
            opening_m: (n, 2) widths.

        Raises:
            ActionError: A width is beyond the gripper's range, or not a number.
        """
        within = (commanded_m >= 0.0) & (commanded_m <= self._most_m)
        if not np.logical_and.reduce(within, axis=None):
            row, tick, arm = np.argwhere(~within)[0]
            raise ActionError(
                f"gripper {('left', 'right')[arm]} is asked for an opening of {commanded_m[row, tick, arm]:.4g} m "
                f"(cell {row}): it has 0 to {self._most_m[arm]} m"
            )
        self._commanded[:], self._opening[:] = commanded_m, opening_m
        self._step()
        return self._widths


class Handled(NamedTuple):
    """Fields of `CellState` with the grippers; None without any."""

    flange_quat: Array | None
    gripper_m: Array | None
    wrench: Array | None


NOT_HANDLED: Final = Handled(None, None, None)


class Handling:
    """State of the grippers of n cells.

    Args:
        batch: A batch of models composed by `dual_ur10.assets.scene`.
        settings: A scene with grippers.
    """

    def __init__(self, batch: Any, settings: SceneSettings) -> None:
        model, n = batch.model, batch.nsim
        self.n, self._settings = n, settings
        qpos = batch.bind("qpos")
        self._fingers: Array = qpos[:, :16].reshape(n, 2, 8)[..., 6:]
        where = sensor_slices(model)
        sensors: Array = batch.bind("sensordata")
        first = where["left/wrench_force"].start
        self._forces: Array = sensors[:, first : first + 12].reshape(n, 2, 2, 3)
        left, right = (model.body(f"{arm}/gripper").id for arm in ARMS)
        self._orientations: Array = batch.bind("xquat")[:, left : right + 1 : right - left]
        weights = [_weight(model, arm) for arm in ARMS]
        weight_n = np.array([mass_kg * GRAVITY_M_S2 for mass_kg, _ in weights])
        self._kp = np.array([float(model.actuator(f"{arm}/gripper").gainprm[0]) for arm in ARMS])
        self._sensed: Array = np.zeros((n, 2, 2, 3))
        self._base_quat: Array = np.zeros((n, 2, 4))
        self._computed, self._wrench = np.zeros((2, n, 2, 6))
        struct = Struct(
            "Wrench",
            n=n,
            weight_n=weight_n,
            moment_nm=np.array([weight * lever_m for weight, (_, lever_m) in zip(weight_n, weights, strict=True)]),
            up=np.ascontiguousarray(
                to_base(settings.mounts)[1][:, :, 2]
            ),  # controllers know how their bases are mounted
            sensed=self._sensed,
            quat=self._base_quat,
            wrench=self._computed,
        )
        self._compute = RowLoop("wrench_compute", struct, n, 1)

    def servos(self, config: CellConfig, steps: int) -> GripperServos:
        """Make the controllers of the grippers, for so many physics steps per call."""
        equipment = config.equipment
        slack_m = _SLACK * equipment.grip_force_n / self._kp
        ticks, tick_s = steps // config.substeps, config.servoj.tick_s
        return GripperServos(self.n, ticks, tick_s, config.substeps, slack_m, equipment.tools)

    @property
    def opening_m(self) -> Array:
        """Width of each gripper, (n, 2)."""
        opening: Array = np.add.reduce(self._fingers, axis=2)
        return opening

    def reset(self, start: Start, rows: Rows) -> Array:
        """Put the fingers of `rows` at the start of an episode; return the widths, (len(rows), 2)."""
        opening = np.full((len(rows), 2), _WELDED_M) if start.gripper_m is None else np.asarray(start.gripper_m)
        self._fingers[rows] = opening[..., None] / 2
        self._wrench = self._wrench.copy()  # that of the state before is the caller's
        self._wrench[rows] = 0.0
        return opening

    def feel(self) -> None:
        """Read the forces of the last physics step; call it before anything else is computed.

        Stages of the batch that stop before accelerations leave stale values of any cell in the force sensors.
        """
        np.copyto(self._sensed, self._forces)

    def state(self, flange_base_quat: Array, failed: NDArray[np.bool_] | None) -> Handled:
        """Return the measurable state.

        Args:
            flange_base_quat: (n, 2, 4) orientation of the flanges in the arms' `base` frames.
            failed: (n,) True for rows that have no new force, after a step; None: there was no step.
        """
        if failed is not None:
            np.copyto(self._base_quat, flange_base_quat)
            self._compute()
            wrench = self._computed.copy()
            if np.count_nonzero(failed):
                wrench[failed] = self._wrench[failed]
            self._wrench = wrench
        return Handled(self._orientations, self.opening_m, self._wrench)


class Props:
    """Poses and joints of the props of n cells.

    Args:
        batch: A batch of models composed by `dual_ur10.assets.scene`.
        props: Props of its scene.

    Attributes:
        objects: Views of the poses by name.
        joints: Views of the joints' positions by name.
    """

    def __init__(self, batch: Any, props: Sequence[Prop]) -> None:
        model, qpos = batch.model, batch.bind("qpos")
        self.objects: dict[str, Poses] = {}
        self.joints: dict[str, Array] = {}
        self._dofs: dict[str, slice] = {}
        self._joint_dofs: dict[str, int] = {}
        for prop in props:
            if prop.free:
                joint = model.joint(f"{prop.name}/free")
                first, dof = int(joint.qposadr[0]), int(joint.dofadr[0])
                self.objects[prop.name] = Poses(qpos[:, first : first + 3], qpos[:, first + 3 : first + 7])
                self._dofs[prop.name] = slice(dof, dof + 6)
            elif prop.placed:
                row = int(model.body(prop.body).mocapid[0])
                position_m, quat = batch.bind("mocap_pos"), batch.bind("mocap_quat")
                self.objects[prop.name] = Poses(position_m[:, row], quat[:, row])
            for name in prop.joints:
                joint = model.joint(f"{prop.name}/{name}")
                self.joints[name] = qpos[:, int(joint.qposadr[0])]
                self._joint_dofs[name] = int(joint.dofadr[0])

    def reset(self, start: Start, rows: Rows) -> None:
        """Put the props of `rows` where an episode begins."""
        for name, pose in start.objects.items():
            self.objects[name].position_m[rows], self.objects[name].quat[rows] = pose[:, :3], pose[:, 3:]
        for name, value in start.joints.items():
            self.joints[name][rows] = value

    def place(self, name: str, pose: Array, qvel: Array) -> None:
        """Put a prop of every cell at a pose, (7,), at rest.

        Raises:
            UnknownNameError: There is no such prop, or nothing places it.
        """
        if name not in self.objects:
            raise UnknownNameError("prop that can be placed", name, list(self.objects))
        self.objects[name].position_m[:], self.objects[name].quat[:] = pose[:3], pose[3:]
        if name in self._dofs:
            qvel[:, self._dofs[name]] = 0.0

    def set_joints(self, values: Mapping[str, float], qvel: Array) -> None:
        """Put joints of the props of every cell at positions, at rest.

        Raises:
            UnknownNameError: There is no such joint.
        """
        for name in values:
            if name not in self.joints:
                raise UnknownNameError("joint of a prop", name, list(self.joints))
        for name, value in values.items():
            self.joints[name][:] = value
            qvel[:, self._joint_dofs[name]] = 0.0


def _weight(model: Any, arm: str) -> tuple[float, Array]:
    """Return the mass of an arm's gripper, and its centre in the flange's frame, (3,), with the fingers on its axis."""
    mass, moment = 0.0, np.zeros(3)
    for name in ("gripper", "finger_1", "finger_2"):
        body = model.body(f"{arm}/{name}")
        mass += float(body.mass[0])
        # The fingers' offsets across the axis cancel.
        moment += float(body.mass[0]) * body.ipos * (name == "gripper" or np.array([1.0, 0.0, 1.0]))
    return mass, moment / mass
