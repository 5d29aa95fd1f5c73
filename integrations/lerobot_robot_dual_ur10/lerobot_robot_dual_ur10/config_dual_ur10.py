"""Settings of the robot."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from lerobot.robots import RobotConfig


@RobotConfig.register_subclass("dual_ur10")
@dataclass(kw_only=True)
class DualUR10RobotConfig(RobotConfig):
    """Settings of both arms.

    Attributes:
        cell: "mujoco" for a simulation, or the path of a cell file of two controllers, emulated or real.
        env: Environment whose scene and grippers the arms have. Its episode must not end by itself.
        images: Cameras of the simulated model whose images are observed, such as ["front"].
        width, height: Size of an image.
        settings: Further keywords of the environment, such as {"robot": "ur10e"}.
        record: Folder for records of dual_ur10, which hold what the gate released; None: no record.
    """

    cell: str = "mujoco"
    env: str = "Free"
    images: list[str] = field(default_factory=list)
    width: int = 320
    height: int = 240
    settings: dict[str, Any] = field(default_factory=dict)
    record: str | None = None
