"""Two UR arms as a robot of LeRobot: `--robot.type=dual_ur10`."""

from lerobot_robot_dual_ur10.config_dual_ur10 import DualUR10RobotConfig
from lerobot_robot_dual_ur10.dual_ur10 import DualUR10Robot, connected

__all__ = ["DualUR10Robot", "DualUR10RobotConfig", "connected"]
