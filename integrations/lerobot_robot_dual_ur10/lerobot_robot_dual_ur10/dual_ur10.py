"""Two UR arms as a robot of LeRobot, through the adapter and the safety gate of dual_ur10."""

from __future__ import annotations

import weakref
from functools import cached_property
from typing import Any

import numpy as np
from lerobot.robots import Robot

from dual_ur10.errors import ClosedError
from dual_ur10.lerobot.live_arms import LiveArms
from dual_ur10.policies.learned.lerobot_files import IMAGES, image_key, image_keys
from lerobot_robot_dual_ur10.config_dual_ur10 import DualUR10RobotConfig

_connected: weakref.WeakSet[DualUR10Robot] = weakref.WeakSet()


class DualUR10Robot(Robot):
    """Both arms, which hold the position that was commanded last.

    Observations and actions are `left_shoulder_pan.pos` ... `right_gripper.pos`: commanded joints in rad, and grippers
    from 0, closed, to 1, open; and images by camera. Motion is limited, and led along what is in its way. What the gate
    refuses ends the motion: both arms stop on their path, and the next call raises why.

    Args:
        config: Settings.

    Attributes:
        cameras: Names of the observed cameras, as LeRobot's recorder counts them.
        arms: The arms.

    Raises:
        DualUR10Error: A name or a value is not legal, or two cameras would have one name in LeRobot.
    """

    config_class = DualUR10RobotConfig
    name = "dual_ur10"

    def __init__(self, config: DualUR10RobotConfig) -> None:
        image_keys(config.images)  # no two are one
        super().__init__(config)
        self.config = config
        record = {} if config.record is None else {"record": config.record, "record_about": {"policy": "LeRobot"}}
        self.arms = LiveArms(
            config.env,
            cameras=config.images,
            size=(config.height, config.width),
            cell=config.cell,
            **config.settings,
            **record,
        )
        self.cameras = {self._camera(each): None for each in config.images}

    @staticmethod
    def _camera(name: str) -> str:
        return image_key(name).removeprefix(IMAGES)

    @cached_property
    def observation_features(self) -> dict[str, Any]:
        """Types of positions, and shapes of images, by name."""
        images = {self._camera(each): (*self.arms.size, 3) for each in self.arms.cameras}
        return {**self.action_features, **images}

    @cached_property
    def action_features(self) -> dict[str, Any]:
        """Types of positions by name."""
        return dict.fromkeys(self.arms.names, float)

    @property
    def is_connected(self) -> bool:
        """True while the arms can be commanded."""
        return self.arms.started

    @property
    def is_calibrated(self) -> bool:
        """True: bases are calibrated with `dual-ur10 cell calibrate`."""
        return True

    def connect(self, calibrate: bool = True) -> None:
        """Move both arms to their start, which an operator confirms on real arms."""
        self.arms.start()
        _connected.add(self)

    def calibrate(self) -> None:
        """Do nothing; see `is_calibrated`."""

    def configure(self) -> None:
        """Do nothing: the cell file has the settings."""

    def get_observation(self) -> dict[str, Any]:
        """Return positions and images by name."""
        positions, _, images = self.arms.observation()
        found: dict[str, Any] = dict(zip(self.arms.names, map(float, positions), strict=True))
        return {**found, **{self._camera(each): image for each, image in images.items()}}

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        """Command positions by name, and return them as they were commanded, in float32."""
        sent = np.array([action[each] for each in self.arms.names], dtype=np.float32)
        self.arms.command(sent)
        return dict(zip(self.arms.names, map(float, sent), strict=True))

    def disconnect(self) -> None:
        """Stop both arms on their path, and release them."""
        _connected.discard(self)
        self.arms.stop()


def connected() -> DualUR10Robot:
    """Return the robot that is connected in this process, for a teleoperator that leads it.

    Raises:
        ClosedError: None is, or several are.
    """
    found = [each for each in _connected if each.is_connected]
    if len(found) != 1:
        raise ClosedError(f"{len(found)} robots of type dual_ur10 are connected in this program: connect one")
    return found[0]
