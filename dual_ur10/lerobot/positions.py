"""Joints in rad and grippers from 0 to 1 of both arms, as datasets and LeRobot's robots have them."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from dual_ur10.errors import ActionError, RecordingError
from dual_ur10.lerobot.features import position_names
from dual_ur10.policies.learned.signature import EnvironmentView
from ur_core.types import Array, Single

_COMMANDED: Final = "commanded_q_rad"
_WIDTH: Final = "gripper_m"


class Positions:
    """Positions of both arms in the observations and the actions of an environment.

    Args:
        view: Layout of its observations and signature of its actions.

    Attributes:
        stroke_m: (2,) largest width of each gripper; None: there are none.
        names: Names of the positions, 12 or 14, such as "left_shoulder_pan.pos".

    Raises:
        RecordingError: Its observations do not show what is commanded.
    """

    def __init__(self, view: EnvironmentView) -> None:
        if _COMMANDED not in view.layout.names:
            raise RecordingError(
                f"the observations of {view.signature.env_id} have no field {_COMMANDED!r}: begin the layout of its "
                "task with ARM_FIELDS"
            )
        self._view = view
        grippers = view.signature.actions.gripper
        self.stroke_m: Array | None = view.setup.make_adapter().stroke_m if grippers else None
        self.names = position_names(grippers=grippers)

    def commanded(self, observation: Array) -> Array:
        """Return the commanded joints, (n, 2, 6), that observations show, (n, size)."""
        if self._view.setup.options.concise:
            shown: Array = self._view.setup.make_task().concise_view().commanded_q_rad(observation)
            return shown
        found: Array = self._view.layout.split(observation)[_COMMANDED]
        return found

    def measured(self, observation: Array) -> Array | None:
        """Return the measured widths, (n, 2), as fractions of the strokes; None: there are no grippers."""
        if self.stroke_m is None:
            return None
        if _WIDTH not in self._view.layout.names:
            return np.ones((len(observation), 2))
        found: Array = self._view.layout.split(observation)[_WIDTH][..., 0] / self.stroke_m
        return found

    def state(self, observation: Array) -> Single:
        """Return commanded joints and measured widths, (n, 12 or 14), that observations show, (n, size)."""
        return joined(self.commanded(observation), self.measured(observation))

    def action(self, positions: NDArray[np.floating]) -> Single:
        """Return the action of `action_mode="joint_position"` that commands positions, (12 or 14,).

        Raises:
            ActionError: There are others than `names`, or some are not finite.
        """
        values = np.array(positions, dtype=np.float32).reshape(-1)
        if len(values) != len(self.names) or not np.isfinite(values).all():
            raise ActionError(
                f"positions are {values}: expected are {len(self.names)} finite numbers, {self.names[0]} ..."
            )
        if self.stroke_m is not None:
            values[6::7] = 2.0 * values[6::7] - 1.0
        return values


def joined(joints_rad: Array, widths: Array | None) -> Single:
    """Return positions in float32, (n, 12 or 14), of joints, (n, 2, 6), and widths, (n, 2)."""
    parts = [joints_rad] if widths is None else [joints_rad, widths[:, :, None]]
    found: Single = np.concatenate(parts, axis=2).reshape(len(joints_rad), -1).astype(np.float32)
    return found
