"""What a cell is: two arms, and what stands between them. It takes targets tick by tick and gives a state.

A cell knows nothing of tasks. The simulated cell is `dual_ur10.envs.mujoco_cell.MujocoCell`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal, NamedTuple, Protocol, get_args

import numpy as np
from numpy.typing import NDArray

from dual_ur10.assets.scene import CLEARANCE_CUTOFF_M, ArmMount, SceneSettings
from dual_ur10.errors import RateError, SettingsError, UnknownNameError
from dual_ur10.sim2real.adapter import Command
from dual_ur10.sim2real.clearance import MINIMUM_M
from dual_ur10.sim2real.servoj import ServojProfile

Array = NDArray[np.float64]
Rows = NDArray[np.intp]

Numbers = float | Array | tuple[Any, ...]

CellKind = Literal["mujoco"]


class CellState(NamedTuple):
    """What can be measured of n cells at one instant. Only what a real cell can measure, too.

    The arrays are the cell's own and change with its next call: copy what is to be kept.

    Attributes:
        time_s: (n,) time since the reset, a whole number of ticks.
        q_rad: (n, 2, 6) joint positions.
        qd_rad_s: (n, 2, 6) joint speeds.
        flange_base_m: (n, 2, 3) flange position in each arm's own `base` frame, as UR's controller reports it.
        flange_base_quat: (n, 2, 4) flange orientation in that frame, (w, x, y, z).
        flange_m: (n, 2, 3) flange position in the cell frame.
        failed: (n,) whether the physics diverged; the other values of such a row are those of its last good instant.
    """

    time_s: Array
    q_rad: Array
    qd_rad_s: Array
    flange_base_m: Array
    flange_base_quat: Array
    flange_m: Array
    failed: NDArray[np.bool_]


class Cell(Protocol):
    """Two arms behind one interface: simulated, emulated or real."""

    n: int

    def reset(self, q_rad: Array, rows: Rows | None = None) -> CellState:
        """Bring the arms to rest at `q_rad`, (n, 2, 6), in all cells or in `rows` (then (len(rows), 2, 6))."""

    def advance(self, command: Command) -> CellState:
        """Send the targets of one control period, and return the state at its end."""

    def close(self) -> None:
        """Release everything. May be called twice."""


@dataclass(frozen=True)
class Perturbation:
    """How a simulated plant differs from what the adapter and the controller believe of it.

    Each value is one number for all, or an array that broadcasts to the shape given; arrays are kept as nested tuples,
    so that equal perturbations are equal and hash alike. The defaults change nothing.

    Attributes:
        mass_scale: (n, 2) factor on all link masses and inertias. The controller goes on compensating the gravity of
            the nominal arm.
        friction_nm: (n, 2, 6) Coulomb friction of the joints.
        lookahead_scale: (n, 2) factor on the lookahead time of the law.
        latency_s: (n, 2) constant delay of every target, rounded to whole physics steps.
        jitter_s: (n, 2) largest additional delay, uniform, per tick; targets keep their order.
        loss: (n, 2) probability that a target is lost; the one before is held.
        payload_kg: (n, 2) mass at the flange.
        declared_payload_kg: (n, 2) what the controller was told of it, as with `set_payload`.
    """

    mass_scale: Numbers = 1.0
    friction_nm: Numbers = 0.0
    lookahead_scale: Numbers = 1.0
    latency_s: Numbers = 0.0
    jitter_s: Numbers = 0.0
    loss: Numbers = 0.0
    payload_kg: Numbers = 0.0
    declared_payload_kg: Numbers = 0.0

    def __post_init__(self) -> None:
        for name, low, high in (
            ("mass_scale", 0.1, 10.0),
            ("friction_nm", 0.0, 100.0),
            ("lookahead_scale", 0.1, 10.0),
            ("latency_s", 0.0, 0.2),
            ("jitter_s", 0.0, 0.2),
            ("loss", 0.0, 0.9),
            ("payload_kg", 0.0, 10.0),
            ("declared_payload_kg", 0.0, 10.0),
        ):
            try:
                value = np.asarray(getattr(self, name), dtype=np.float64)
            except (TypeError, ValueError):
                raise SettingsError(f"perturbation {name} is {getattr(self, name)!r}: it must be numbers") from None
            if not ((value >= low) & (value <= high)).all():
                raise SettingsError(f"perturbation {name} is {getattr(self, name)!r}: allowed are {low} to {high}")
            object.__setattr__(self, name, _plain(value.tolist()))

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any]) -> Perturbation:
        """Build from plain keywords.

        Raises:
            UnknownNameError: A key is not one of the attributes.
        """
        known = [each.name for each in fields(cls)]
        for key in values:
            if key not in known:
                raise UnknownNameError("perturbation", str(key), known)
        return cls(**values)

    def expanded(self, n: int) -> dict[str, Array]:
        """All values as arrays of their full shape."""
        shapes = {"friction_nm": (n, 2, 6)}
        result = {}
        for each in fields(self):
            shape = shapes.get(each.name, (n, 2))
            try:
                value = np.broadcast_to(np.asarray(getattr(self, each.name), dtype=np.float64), shape)
            except ValueError:
                found = np.shape(getattr(self, each.name))
                raise SettingsError(f"perturbation {each.name} has shape {found}: it must fit {shape}") from None
            result[each.name] = value.copy()
        return result


def _plain(values: Any) -> Any:
    """Numbers as they are, nested lists as nested tuples."""
    return tuple(map(_plain, values)) if isinstance(values, list) else values


TYPICAL_PERTURBATION = Perturbation(
    mass_scale=1.05,
    friction_nm=np.array([5.0, 5.0, 3.0, 1.0, 1.0, 1.0]),
    lookahead_scale=1.05,
    latency_s=0.002,
)
"""The plant that accuracy figures called "perturbed" are measured on: masses +5 %, joint friction, lookahead +5 %,
2 ms of latency that nobody compensates."""


@dataclass(frozen=True)
class CellConfig:
    """A cell, as given to `gym.make(..., cell=...)`.

    Attributes:
        kind: "mujoco", the simulated cell.
        left, right: Where each arm stands, and its kinematics.
        servoj: Controller family and servoj settings of both arms.
        timestep_s: Physics step; it must divide the controller's tick.
        gains: Joint servos, a name of `dual_ur10.assets.scene.GAINS`.
        minimum_clearance_m: Smallest distance between two bodies that the safety gate lets the arms come to.
        perturbation: How the simulated plant differs from what is believed of it.
        meshes: Draw real meshes, if the package example-robot-data is installed.

    Raises:
        RateError: The physics step does not divide the tick.
        SettingsError: Another value is not legal.
    """

    kind: CellKind = "mujoco"
    left: ArmMount = field(default_factory=lambda: SceneSettings().left)
    right: ArmMount = field(default_factory=lambda: SceneSettings().right)
    servoj: ServojProfile = field(default_factory=ServojProfile)
    timestep_s: float = 0.002
    gains: str = "stiff"
    minimum_clearance_m: float = MINIMUM_M
    perturbation: Perturbation = field(default_factory=Perturbation)
    meshes: bool = False

    def __post_init__(self) -> None:
        if self.kind not in get_args(CellKind):
            raise UnknownNameError("cell kind", str(self.kind), get_args(CellKind))
        if not 0.005 <= self.minimum_clearance_m < CLEARANCE_CUTOFF_M:
            raise SettingsError(
                f"minimum_clearance_m is {self.minimum_clearance_m!r}: it must be at least 0.005 m and below "
                f"{CLEARANCE_CUTOFF_M} m, beyond which distances are not measured"
            )
        _ = self.scene, self.substeps

    @property
    def scene(self) -> SceneSettings:
        """The scene of this cell."""
        return SceneSettings(
            left=self.left, right=self.right, timestep_s=self.timestep_s, gains=self.gains, meshes=self.meshes
        )

    @property
    def substeps(self) -> int:
        """Physics steps per controller tick."""
        steps = self.servoj.tick_s / self.timestep_s
        whole = round(steps)
        if whole < 1 or abs(steps - whole) > 1e-9 * steps:
            tick_ms = self.servoj.tick_s * 1e3
            raise RateError(
                f"timestep_s is {self.timestep_s:g}: it must divide the controller's tick of {tick_ms:g} ms, such as "
                f"{', '.join(f'{tick_ms / parts / 1e3:g}' for parts in (2, 4, 8))}"
            )
        return whole

    def with_perturbation(self, **values: Any) -> CellConfig:
        """The same cell with some values of its perturbation changed."""
        changed = Perturbation.from_mapping({**self._perturbation_values(), **values})
        return replace(self, perturbation=changed)

    def _perturbation_values(self) -> dict[str, Any]:
        return {each.name: getattr(self.perturbation, each.name) for each in fields(self.perturbation)}


def resolve_cell(cell: object) -> CellConfig:
    """The configuration that the keyword `cell` stands for.

    Raises:
        UnknownNameError: Neither "mujoco" nor a `CellConfig`.
    """
    if isinstance(cell, CellConfig):
        return cell
    if cell == "mujoco":
        return CellConfig()
    raise UnknownNameError("cell", str(cell), ("mujoco", "a dual_ur10.CellConfig"))
