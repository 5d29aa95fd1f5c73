"""Input devices of dual_ur10 as a teleoperator of LeRobot."""

from __future__ import annotations

from functools import cached_property
from typing import Any

from lerobot.teleoperators import Teleoperator
from lerobot_robot_dual_ur10 import connected

from dual_ur10.lerobot.features import position_names
from dual_ur10.lerobot.live_arms import LiveOperator
from lerobot_teleoperator_dual_ur10.config_dual_ur10 import DualUR10TeleopConfig


class DualUR10Teleop(Teleoperator):
    """Person who leads the robot `dual_ur10` that is connected in the same program.

    Devices that give speeds continue from the commanded joints of the robot, and a clutch that is released leaves its
    arm where it is. The button "stop", or a device that is gone, ends the program's loop with an error; the arms then
    hold their position until the robot is disconnected.

    Args:
        config: Settings.
    """

    config_class = DualUR10TeleopConfig
    name = "dual_ur10"

    def __init__(self, config: DualUR10TeleopConfig) -> None:
        super().__init__(config)
        self.config = config
        self._operator: LiveOperator | None = None
        self._is_connected = False

    @cached_property
    def action_features(self) -> dict[str, Any]:
        """Types of positions by name."""
        return dict.fromkeys(position_names(grippers=self.config.grippers), float)

    @property
    def feedback_features(self) -> dict[str, Any]:
        """Nothing: no device of these has motors that are driven."""
        return {}

    @property
    def is_connected(self) -> bool:
        """True after `connect`; the device is opened with the first action, when the robot is there."""
        return self._is_connected

    @property
    def is_calibrated(self) -> bool:
        """True: leader arms find their turns by the configuration of the robot."""
        return True

    def connect(self, calibrate: bool = True) -> None:
        """Do nothing but to note it; see `is_connected`."""
        self._is_connected = True

    def calibrate(self) -> None:
        """Do nothing; see `is_calibrated`."""

    def configure(self) -> None:
        """Do nothing."""

    def get_action(self) -> dict[str, float]:
        """Return the positions that the person commands, by name."""
        if self._operator is None:
            self._operator = LiveOperator(connected().arms, self.config.device)
        return self._operator()

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        """Do nothing; see `feedback_features`."""

    def disconnect(self) -> None:
        """Close the device."""
        operator, self._operator, self._is_connected = self._operator, None, False
        if operator is not None:
            operator.close()
