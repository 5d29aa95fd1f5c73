"""Input devices of dual_ur10 as a teleoperator of LeRobot: `--teleop.type=dual_ur10`."""

from lerobot_teleoperator_dual_ur10.config_dual_ur10 import DualUR10TeleopConfig
from lerobot_teleoperator_dual_ur10.dual_ur10 import DualUR10Teleop

__all__ = ["DualUR10Teleop", "DualUR10TeleopConfig"]
