"""Mode codes and status bits of UR controllers.

Values: UR's RTDE guide, and `datatypes.h` of Universal Robots' client library.
"""

from __future__ import annotations

from enum import IntEnum, IntFlag


class RobotMode(IntEnum):
    """RTDE `robot_mode`, and the mode in the robot mode data of the primary interface."""

    NO_CONTROLLER = -1
    DISCONNECTED = 0
    CONFIRM_SAFETY = 1
    BOOTING = 2
    POWER_OFF = 3
    POWER_ON = 4
    IDLE = 5
    BACKDRIVE = 6
    RUNNING = 7
    UPDATING_FIRMWARE = 8


class SafetyMode(IntEnum):
    """RTDE `safety_mode`. A controller may send other numbers as well."""

    NORMAL = 1
    REDUCED = 2
    PROTECTIVE_STOP = 3
    RECOVERY = 4
    SAFEGUARD_STOP = 5
    SYSTEM_EMERGENCY_STOP = 6
    ROBOT_EMERGENCY_STOP = 7
    VIOLATION = 8
    FAULT = 9
    VALIDATE_JOINT_ID = 10
    UNDEFINED_SAFETY_MODE = 11
    AUTOMATIC_MODE_SAFEGUARD_STOP = 12
    SYSTEM_THREE_POSITION_ENABLING_STOP = 13
    TEACH_PENDANT_THREE_POSITION_ENABLING_STOP = 14


class SafetyBits(IntFlag):
    """RTDE `safety_status_bits`."""

    NORMAL = 1 << 0
    REDUCED = 1 << 1
    PROTECTIVE_STOPPED = 1 << 2
    RECOVERY = 1 << 3
    SAFEGUARD_STOPPED = 1 << 4
    SYSTEM_EMERGENCY_STOPPED = 1 << 5
    ROBOT_EMERGENCY_STOPPED = 1 << 6
    EMERGENCY_STOPPED = 1 << 7
    VIOLATION = 1 << 8
    FAULT = 1 << 9
    STOPPED_DUE_TO_SAFETY = 1 << 10


class RobotBits(IntFlag):
    """RTDE `robot_status_bits`."""

    POWER_ON = 1 << 0
    PROGRAM_RUNNING = 1 << 1
    TEACH_BUTTON = 1 << 2
    POWER_BUTTON = 1 << 3


class RuntimeState(IntEnum):
    """RTDE `runtime_state`: state of the program."""

    STOPPING = 0
    STOPPED = 1
    PLAYING = 2
    PAUSING = 3
    PAUSED = 4
    RESUMING = 5


class JointMode(IntEnum):
    """RTDE `joint_mode`."""

    POWER_OFF = 239
    IDLE = 247
    RUNNING = 253
