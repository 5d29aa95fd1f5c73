"""CupOnTray, a task for two arms in one file."""

from two_arm_tasks import cup_on_tray

__all__ = ["cup_on_tray"]
