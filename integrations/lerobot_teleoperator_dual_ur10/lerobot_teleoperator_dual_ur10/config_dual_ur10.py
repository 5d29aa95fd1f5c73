"""Settings of the teleoperator."""

from __future__ import annotations

from dataclasses import dataclass

from lerobot.teleoperators import TeleoperatorConfig


@TeleoperatorConfig.register_subclass("dual_ur10")
@dataclass(kw_only=True)
class DualUR10TeleopConfig(TeleoperatorConfig):
    """Settings of the input device.

    Attributes:
        device: A device and its arguments as for `--operator` of dual_ur10, such as
            "spacemouse:left=/dev/hidraw3,right=/dev/hidraw4", "gamepad", "leader:...", or "module:Class".
        grippers: The robot has grippers.
    """

    device: str = "spacemouse"
    grippers: bool = True
