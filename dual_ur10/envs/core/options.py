"""Keywords that every environment has, whatever its interface: Gymnasium, vector, PettingZoo, dm_env."""

from __future__ import annotations

import dataclasses
import math
import numbers
import os
from collections.abc import Callable, Mapping
from typing import Any, Final, Literal, get_args

import numpy as np

from dual_ur10.errors import SettingsError, UnknownNameError
from dual_ur10.sim2real.cell.cell_config import CellConfig
from dual_ur10.sim2real.control.adapter import ActionMode, ActionScale, scale_of_steps
from dual_ur10.sim2real.control.command_queue import checked_latency
from ur_core.kinematics.robots import robot_model
from ur_core.kinematics.ur10 import ARMS
from ur_core.mjcf.camera import Camera

DEFAULT_RATE_HZ = 25.0

AS_ON_CONTROLLERS: Final = {"on_refusal": "terminate"}
"""Keywords with which a simulated episode ends where it would on two controllers, for evaluations and imitation."""

MOVE_TO_START: Final = "move_to_start"
"""Option of `reset` by which its caller consents to the motion to the start of an episode."""

ObservationKind = Literal["state", "goals", "pixels", "both", "flat"]
ObservationDtype = Literal["float64", "float32"]
OnRefusal = Literal["brake", "terminate"]
AtLimits = Literal["lead", "refuse"]
RewardForm = Literal["dense", "sparse"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class EnvOptions:
    """Keywords of every environment.

    Raises:
        UnknownNameError: `robot`, `observation`, `observation_dtype` or `reward` is not one of its names.
        SettingsError: `cameras` is empty or names a camera twice, or a value has the wrong type.

    Attributes:
        cell: "mujoco"; "echo", a dry run without physics, whose state is what was commanded; a
            `dual_ur10.sim2real.cell.cell_config.CellConfig`; or, for two controllers, the path of a cell file or a
            `dual_ur10.testing.VirtualCell`.
        robot: Model of both arms, such as "ur5e", or of the left and the right one; see
            `ur_core.kinematics.robots.ROBOTS`. A shorter arm stands nearer to the workspace. None: two UR10s, or
            those of `cell`.
        policy_rate_hz: Actions per second. The period must be a whole number of controller ticks (8 ms on a CB3).
        action_mode: "joint_delta", "joint_position", "tcp_delta" or "tcp_translation"; see
            `dual_ur10.sim2real.control.adapter.ServojAdapter`.
        action_scale: Factor of the steps that actions are, above 0 and at most 1: at 0.3 an action of 1 is a step of
            0.3 of the speed limit. A number, or a mapping with a factor for some groups: "joints" of "joint_delta",
            "translation" and "rotation" of "tcp_delta", "translation" of "tcp_translation". Widths of grippers are no
            steps, nor are the actions of "joint_position", for which a scale other than 1 is refused.
        action_latency_ticks: Ticks from an observation to the first target of its action. 0 is an ideal system.
            Develop a policy for real arms with the latency that it will have. None: 0 in simulation, and the ticks of
            40 ms on two controllers.
        compensate_lag: Compensate the lag of `servoj` in the adapter.
        at_limits: Reaction to motion that the safety gate would refuse. "lead": the adapter leads it along what is in
            its way, in simulation and on two controllers alike, and `info["led"]` is True; see
            `dual_ur10.sim2real.control.pipeline.Leading`. Only what cannot be led is refused. "refuse": it reaches the
            gate as it was planned.
        on_refusal: Reaction to a motion that the safety gate refuses. "terminate": the episode ends. "brake": both arms
            of the cell brake, and the episode continues from rest. A refusal costs a reward of 1, once until a motion
            is released again, and the episode cannot succeed, because on two controllers it would have ended. None:
            "brake" in simulation, so that exploration is not cut short, and "terminate" on two controllers, where
            nothing else is possible.
        reward: "dense", the weighted sum of the task's terms; or "sparse": 1 in the step that ends an episode with
            success, and 0 in all others, so that the return of an episode is 1 or 0. Its term is named "success"; those
            of the task, and that of refusals, stay in `info` and count nothing.
        reward_weights: Weights of terms by their names, in place of the task's own; "refusal" is one of them where
            refusals do not end episodes. None: the task's.
        progress_weight: Weight of a further term "progress": by how much an arm's weighted terms, without "finish" and
            "refusal", exceed their largest value of the episode so far. Its sum over an episode is at most what the
            best step earns, and nobody earns it twice. 0: there is none.
        randomization: Variation from episode to episode: a name of
            `dual_ur10.envs.core.randomization.PRESETS`, a mapping of single values, or a `Randomization`.
        observation: "state" gives an array of all numbers of the task; "goals" the few of them that lead to its goals,
            float32 between -1 and 1, see `dual_ur10.envs.tasks.observation_layout.ConciseView`; "pixels" a dict of
            images by camera; "both" a dict with `state` and `pixels`; "flat" a dict of images by camera and `state`, as
            Stable-Baselines3's `MultiInputPolicy` needs it.
        observation_dtype: Type of observed numbers, "float64" or "float32", of all interfaces. None: "float64", but
            "float32" with `observation="goals"`, which has no other.
        cameras: Cameras of an observation with pixels: names of `dual_ur10.assets.visuals.cameras`, and `Camera`s of
            your own, in the cell or on one of its bodies. One by itself, or a tuple.
        pixels_rate_hz: Images per second of an observation with pixels, the policy's rate divided by a whole number.
            None: a new image with every observation.
        camera: Camera of `render`, by one of the same names or a `Camera`.
        width, height: Size in pixels of images, both rendered and observed.
        shadows: Render shadows and reflections; see `dual_ur10.envs.rendering.images.Renderer`.
        starts: Ratios of the episodes that begin, at rest, in a state of the scripted policy after a stage, by the
            names of the task's stages: {"lift": 0.2} begins a fifth of them after `lift`. For training, in simulation
            alone; the others begin as always. None: all do.
        until: Stage whose passing is the success of an episode. Later ones earn only what an arm earns before they
            begin, such as for waiting. None: the last one.
        confirm: Function that is called on two controllers with a text before the arms move to the start of an episode;
            it returns True to permit the motion. Later resets then need no other consent. None: real arms ask for a
            confirmation at the terminal, emulated ones do not.
        arm: "left" or "right": the only arm that moves, in simulation, too; the other one holds its position, and
            `info["held_arm"]`, (2,), is True for it. None: both move.
        record: Folder for the record of this run, which gets its own subfolder; None: no record. On two controllers,
            the last ten seconds before a stop are recorded in any case.
        record_failure: Reaction on two controllers if the record cannot be written any more, for example because the
            disk is full: "go on", which is logged, or "stop".
        record_about: Description of the run in its record: `policy` (a name), `policy_sha256`, and any other value that
            JSON can hold. None: no description.
    """

    cell: object = "mujoco"
    robot: str | tuple[str, str] | None = None
    policy_rate_hz: float = DEFAULT_RATE_HZ
    action_mode: ActionMode = "joint_delta"
    action_scale: ActionScale = 1.0
    action_latency_ticks: int | None = None
    compensate_lag: bool = True
    at_limits: AtLimits = "lead"
    on_refusal: OnRefusal | None = None
    reward: RewardForm = "dense"
    reward_weights: Mapping[str, float] | None = None
    progress_weight: float = 0.0
    randomization: object = "none"
    observation: ObservationKind = "state"
    observation_dtype: ObservationDtype | None = None
    cameras: tuple[str | Camera, ...] = ("front",)
    pixels_rate_hz: float | None = None
    camera: str | Camera = "perspective"
    width: int = 640
    height: int = 480
    shadows: bool = False
    starts: Mapping[str, float] | None = None
    until: str | None = None
    confirm: Callable[[str], bool] | None = None
    arm: str | None = None
    record: str | os.PathLike[str] | None = None
    record_failure: Literal["go on", "stop"] = "go on"
    record_about: Mapping[str, Any] | None = None

    def __post_init__(self) -> None:
        for robot in self.robots or ():
            robot_model(robot)
        for name in ("compensate_lag", "shadows"):
            if not isinstance(getattr(self, name), bool | np.bool_):
                raise SettingsError(f"{name} is {getattr(self, name)!r}: it must be True or False")
        for name in ("policy_rate_hz", "width", "height"):
            if isinstance(getattr(self, name), bool):
                raise SettingsError(f"{name} is {getattr(self, name)!r}: it must be a number")
        if self.action_latency_ticks is not None:
            checked_latency(self.action_latency_ticks)
        if self.confirm is not None and not callable(self.confirm):
            raise SettingsError(f"confirm is {self.confirm!r}: it must be a function that is given a text, or None")
        if self.arm is not None and self.arm not in ARMS:
            raise UnknownNameError("arm", str(self.arm), [*ARMS, "None"])
        if self.record is not None and (
            not isinstance(self.record, str | os.PathLike) or "\0" in os.fsdecode(self.record)
        ):
            raise SettingsError(f"record is {self.record!r}: it must be the path of a folder, or None")
        if self.record_failure not in ("go on", "stop"):
            raise UnknownNameError("record_failure", str(self.record_failure), ["go on", "stop"])
        if self.record_about is not None:
            _check_about(self.record_about)
        if self.action_mode not in get_args(ActionMode):
            raise UnknownNameError("action mode", str(self.action_mode), get_args(ActionMode))
        scale_of_steps(self.action_mode, self.action_scale)
        if self.observation not in get_args(ObservationKind):
            raise UnknownNameError("observation", str(self.observation), get_args(ObservationKind))
        if self.observation_dtype is not None and self.observation_dtype not in get_args(ObservationDtype):
            raise UnknownNameError(
                "observation_dtype", str(self.observation_dtype), [*get_args(ObservationDtype), "None"]
            )
        if self.concise and self.observation_dtype == "float64":
            raise SettingsError(
                "observation is 'goals', which is float32, and observation_dtype 'float64': leave observation_dtype out"
            )
        if self.at_limits not in get_args(AtLimits):
            raise UnknownNameError("at_limits", str(self.at_limits), get_args(AtLimits))
        if self.on_refusal is not None and self.on_refusal not in get_args(OnRefusal):
            raise UnknownNameError("on_refusal", str(self.on_refusal), [*get_args(OnRefusal), "None"])
        if self.reward not in get_args(RewardForm):
            raise UnknownNameError("reward", str(self.reward), get_args(RewardForm))
        if self.reward_weights is not None:
            object.__setattr__(self, "reward_weights", _checked_weights(self.reward_weights, self.reward))
        weight = self.progress_weight
        if isinstance(weight, bool) or not isinstance(weight, numbers.Real) or not 0.0 <= weight < math.inf:
            raise SettingsError(f"progress_weight is {weight!r}: it must be a finite number, 0 or more")
        if weight and self.reward == "sparse":
            raise SettingsError('progress_weight has no effect with reward="sparse": leave out one of both')
        if self.starts is not None:
            object.__setattr__(self, "starts", _checked_starts(self.starts))
        if not isinstance(self.cameras, str | Camera | tuple | list):
            raise SettingsError(f"cameras are {self.cameras!r}: name one, or several in a tuple")
        cameras = (self.cameras,) if isinstance(self.cameras, str | Camera) else tuple(self.cameras)
        for each in (*cameras, self.camera):
            if not isinstance(each, str | Camera):
                raise SettingsError(f"{each!r:.120} is no camera: name one, or state a Camera")
        object.__setattr__(self, "cameras", cameras)
        names = self.camera_names
        if not names or len(set(names)) < len(names):
            raise SettingsError(f"cameras are {names!r}: name at least one, and each once")

    @property
    def concise(self) -> bool:
        """True if the concise view of the task's fields is observed."""
        return self.observation == "goals"

    @property
    def pictured(self) -> bool:
        """True if images are observed."""
        return self.observation in ("pixels", "both", "flat")

    @property
    def camera_names(self) -> tuple[str, ...]:
        """Names of the cameras of an observation with pixels."""
        return tuple(_name_of(each) for each in self.cameras)

    @property
    def render_camera(self) -> str:
        """Name of the camera of `render`."""
        return _name_of(self.camera)

    @property
    def own_cameras(self) -> tuple[Camera, ...]:
        """Cameras that the keywords add to the cell."""
        found = (each for each in (*self.cameras, self.camera) if isinstance(each, Camera))
        return tuple(dict.fromkeys(found))  # the same one may be rendered and observed

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of observed numbers."""
        return np.dtype(self.observation_dtype or ("float32" if self.concise else "float64"))

    @property
    def robots(self) -> tuple[str, str] | None:
        """Models of both arms; None: those of the cell.

        Raises:
            SettingsError: There are not two.
        """
        if self.robot is None:
            return None
        if isinstance(self.robot, str):
            return self.robot, self.robot
        if not isinstance(self.robot, tuple | list) or len(self.robot) != len(ARMS):
            raise SettingsError(f"robot is {self.robot!r}: name one model, or one for each arm, such as 'ur5e'")
        left, right = self.robot
        return left, right

    @property
    def held_arm(self) -> int | None:
        """Index of the arm that does not move; None: both move."""
        return None if self.arm is None else 1 - ARMS.index(self.arm)

    def latency_ticks(self, cell: CellConfig) -> int:
        """Return the latency of actions in this cell, in ticks."""
        return cell.latency_ticks if self.action_latency_ticks is None else self.action_latency_ticks


def _name_of(camera: object) -> str:
    return camera.name if isinstance(camera, Camera) else str(camera)


def _checked_weights(weights: object, reward: str) -> dict[str, float]:
    """Return weights as plain floats."""
    if reward == "sparse":
        raise SettingsError('reward_weights have no effect with reward="sparse": leave out one of both')
    if not isinstance(weights, Mapping):
        raise SettingsError(f"reward_weights are {weights!r:.200}: they must be a mapping, such as {{'refusal': 0.0}}")
    for name, value in weights.items():
        if isinstance(value, bool) or not isinstance(value, numbers.Real) or not math.isfinite(value):
            raise SettingsError(f"reward_weights[{name!r}] is {value!r}: it must be a finite number")
    return {name: float(value) for name, value in weights.items()}


def _checked_starts(starts: object) -> dict[str, float]:
    """Return ratios of starts as plain floats."""
    if not isinstance(starts, Mapping) or not starts:
        raise SettingsError(f"starts are {starts!r:.200}: they must be a mapping, such as {{'lift': 0.2}}, or None")
    for name, value in starts.items():
        if isinstance(value, bool) or not isinstance(value, numbers.Real) or not 0.0 < float(value) <= 1.0:
            raise SettingsError(f"starts[{name!r}] is {value!r}: it must be a number above 0 and at most 1")
    found = {name: float(value) for name, value in starts.items()}
    if sum(found.values()) > 1.0 + 1e-9:
        raise SettingsError(f"starts add up to {sum(found.values()):g}: 1 is every episode")
    return found


def _check_about(about: object) -> None:
    """Check the description of a run."""
    if not isinstance(about, Mapping) or not all(isinstance(name, str) for name in about):
        raise SettingsError(f"record_about is {about!r:.200}: it must be a mapping, such as {{'policy': 'mine'}}")
    for name in ("policy", "policy_sha256"):
        if not isinstance(about.get(name, ""), str):
            raise SettingsError(f"record_about says {name} {about[name]!r:.200}: it must be a text")


IMAGE_OPTIONS: Final = ("cameras", "width", "height", "pixels_rate_hz", "shadows")
"""Keywords on which observed images depend."""

OPTION_NAMES = tuple(each.name for each in dataclasses.fields(EnvOptions))
"""Keywords of every environment, in addition to those of its task."""


def split_keywords(keywords: Mapping[str, Any]) -> tuple[EnvOptions, dict[str, Any]]:
    """Split the keywords of an environment into its options and those of its task.

    Raises:
        UnknownNameError: `observation` is not one of its names.
        SettingsError: `cameras` is empty or names a camera twice, or a value has the wrong type.
    """
    rest = dict(keywords)
    options = {name: rest.pop(name) for name in OPTION_NAMES if name in rest}
    return EnvOptions(**options), rest


def take_consent(options: dict[str, Any]) -> bool:
    """Remove `move_to_start` from the options of a reset and return it; False if it is not there.

    Raises:
        SettingsError: It is neither True nor False.
    """
    consent = options.pop(MOVE_TO_START, False)
    if not isinstance(consent, bool):
        raise SettingsError(f"the reset option {MOVE_TO_START} is {consent!r}: it must be True or False")
    return consent


def check_count(name: str, value: object, *, optional: bool = False) -> None:
    """Check that a setting is a whole number of 1 or more.

    Raises:
        SettingsError: It is not.
    """
    if optional and value is None:
        return
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
        raise SettingsError(
            f"{name} is {value!r}: it must be a whole number, 1 or more{', or None' if optional else ''}"
        )
