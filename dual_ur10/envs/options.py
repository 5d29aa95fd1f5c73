"""Keywords that every environment has, whatever its interface: Gymnasium, vector, PettingZoo, dm_env."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, Literal, get_args

import numpy as np

from dual_ur10.errors import SettingsError, UnknownNameError
from dual_ur10.sim2real.adapter import ActionMode

DEFAULT_RATE_HZ = 25.0

ObservationKind = Literal["state", "pixels", "both"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class EnvOptions:
    """Keywords of every environment.

    Raises:
        UnknownNameError: `observation` is none of its names.
        SettingsError: `cameras` names none, or one twice; or a value is of the wrong kind.

    Attributes:
        cell: "mujoco" or a `dual_ur10.sim2real.cell.CellConfig`.
        policy_rate_hz: Actions per second. The period must be a whole number of controller ticks (8 ms on a CB3).
        action_mode: "joint_delta", "joint_position" or "tcp_delta"; see `dual_ur10.sim2real.adapter.ServojAdapter`.
        action_latency_ticks: Ticks from an observation to the first target of its action. 0 is an ideal machine;
            a policy meant for real arms should be developed with the latency it will have.
        compensate_lag: Whether the adapter takes the lag of `servoj` out.
        randomization: What differs from episode to episode: a name of
            `dual_ur10.envs.randomization.PRESETS`, a mapping of single values, or a `Randomization`.
        observation: "state" gives an array; "pixels" a dict of images by camera; "both" a dict of both.
        cameras: Cameras of an observation with pixels: names of `dual_ur10.assets.scene.cameras`.
        pixels_rate_hz: Images per second of an observation with pixels, the policy's rate divided by a whole number;
            None: a new one with every observation.
        camera: Camera of `render`, of the same names.
        width, height: Size of images in pixels, those of `render` and those observed.
        shadows: Draw shadows and reflections; see `dual_ur10.envs.rendering.Renderer`.
    """

    cell: object = "mujoco"
    policy_rate_hz: float = DEFAULT_RATE_HZ
    action_mode: ActionMode = "joint_delta"
    action_latency_ticks: int = 0
    compensate_lag: bool = True
    randomization: object = "none"
    observation: ObservationKind = "state"
    cameras: tuple[str, ...] = ("front",)
    pixels_rate_hz: float | None = None
    camera: str = "perspective"
    width: int = 640
    height: int = 480
    shadows: bool = False

    def __post_init__(self) -> None:
        for name in ("compensate_lag", "shadows"):
            if not isinstance(getattr(self, name), bool | np.bool_):
                raise SettingsError(f"{name} is {getattr(self, name)!r}: it must be True or False")
        for name in ("policy_rate_hz", "action_latency_ticks", "width", "height"):
            if isinstance(getattr(self, name), bool):
                raise SettingsError(f"{name} is {getattr(self, name)!r}: it must be a number")
        if not isinstance(self.action_mode, str):
            raise UnknownNameError("action mode", str(self.action_mode), get_args(ActionMode))
        if self.observation not in get_args(ObservationKind):
            raise UnknownNameError("observation", str(self.observation), get_args(ObservationKind))
        if not isinstance(self.cameras, str | tuple | list):
            raise SettingsError(f"cameras are {self.cameras!r}: name one, or several in a tuple")
        cameras = (self.cameras,) if isinstance(self.cameras, str) else tuple(self.cameras)
        if not cameras or len(set(cameras)) < len(cameras):
            raise SettingsError(f"cameras are {cameras!r}: name at least one, and each once")
        object.__setattr__(self, "cameras", cameras)


OPTION_NAMES = tuple(each.name for each in dataclasses.fields(EnvOptions))
"""Keywords of every environment, beside those of its task."""


def split_keywords(keywords: Mapping[str, Any]) -> tuple[EnvOptions, dict[str, Any]]:
    """The options among the keywords of an environment, and the rest, which are its task's.

    Raises:
        UnknownNameError: `observation` is none of its names.
        SettingsError: `cameras` names none, or one twice.
    """
    rest = dict(keywords)
    options = {name: rest.pop(name) for name in OPTION_NAMES if name in rest}
    return EnvOptions(**options), rest
