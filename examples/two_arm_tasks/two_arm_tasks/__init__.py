"""Two tasks for two arms, one file each: PegInsertion and TrayBalance."""

from two_arm_tasks import peg_insertion, tray_balance

__all__ = ["peg_insertion", "tray_balance"]
