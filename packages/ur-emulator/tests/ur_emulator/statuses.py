"""Statuses of arms for tests."""

from ur_core.links.arm_status import OPTIONAL_VARIABLES, STATUS_VARIABLES, ArmStatus
from ur_core.links.rtde_stream import Sample
from ur_emulator.controller.rtde_variables import zero_values
from ur_emulator.profile import PROFILES

MOVING = {"robot_mode": 7, "safety_mode": 1, "robot_status_bits": 3, "safety_status_bits": 1, "runtime_state": 2}


def status_of(**values):
    """Return a status in which an arm may move, with other values for these fields."""
    zeros = zero_values(PROFILES["cb3"])
    all_values = {name: zeros[name] for name in (*STATUS_VARIABLES, *OPTIONAL_VARIABLES)}
    return ArmStatus.from_sample(Sample({**all_values, "speed_scaling": 1.0, **MOVING, **values}, 5.0))
