"""What a controller is connected to: an arm that can be measured and moved."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

from dual_ur10.types import Array


class ArmReading(NamedTuple):
    """What the controller of one arm measures.

    Attributes:
        q_rad: (6,) joint positions.
        qd_rad_s: (6,) joint speeds.
        torque_nm: (6,) torques of the joints' motors.
        wrench: (6,) force and torque on the flange, N and N·m, along the axes of the arm's `base`, without the
            gripper's own weight; zero where nothing measures it.
        gripper_m: Opening of the gripper; None if there is none.
    """

    q_rad: Array
    qd_rad_s: Array
    torque_nm: Array
    wrench: Array
    gripper_m: float | None


class World(Protocol):
    """Two arms and what is around them.

    Attributes:
        substeps: Physics steps of one control period.
        gripper_kg: Mass of a gripper; 0 if there is none.
    """

    substeps: int
    gripper_kg: float

    def read(self, arm: int) -> ArmReading:
        """Measure one arm."""

    def advance(self, plans: Sequence[Array], openings_m: Sequence[float | None], payloads_kg: Sequence[float]) -> None:
        """Move on by one control period.

        Args:
            plans: Per arm (substeps, 3, 6): position before, speed after and acceleration in every physics step.
            openings_m: Per arm the commanded opening of its gripper.
            payloads_kg: Per arm what its controller takes to be in its gripper.
        """

    def pose(self, body: str) -> tuple[Array, Array]:
        """Position (3,) and orientation (4,) of a body, in the cell frame.

        Raises:
            UnknownNameError: There is no such body.
        """

    def place(self, pose: Array) -> None:
        """Put the object that is handled at a pose, (7,) position and (w, x, y, z), at rest.

        Raises:
            SettingsError: There is none.
        """

    def draw(self) -> tuple[Any, Any]:
        """MuJoCo's model and data of what is now."""
