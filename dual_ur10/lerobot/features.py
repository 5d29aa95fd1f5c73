"""Features of a LeRobot dataset of two arms: their names, types and shapes."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from math import prod
from typing import Any, Final

from dual_ur10.envs.tasks.observation_layout import ObservationLayout
from dual_ur10.policies.learned.lerobot_files import image_keys
from dual_ur10.sim2real.control.adapter import ActionMode
from ur_core.kinematics.ur10 import ARMS, JOINTS

STATE: Final = "observation.state"
ENVIRONMENT_STATE: Final = "observation.environment_state"
ACTION: Final = "action"
ENV_ACTION: Final = "env_action"
"""Actions as the environment takes them. The name begins neither with "action" nor with "observation", which LeRobot
would give to a policy."""

POSITIONS: Final = tuple(f"{joint.removesuffix('_joint')}.pos" for joint in JOINTS)
GRIPPER: Final = "gripper.pos"

_STEPS: Final[dict[ActionMode, tuple[str, ...]]] = {
    "joint_delta": tuple(each.replace(".pos", ".step") for each in POSITIONS),
    "joint_position": POSITIONS,
    "tcp_delta": ("x.step", "y.step", "z.step", "rx.step", "ry.step", "rz.step"),
    "tcp_translation": ("x.step", "y.step", "z.step"),
}


@dataclass(frozen=True)
class DatasetFeature:
    """One feature of a dataset.

    Attributes:
        dtype: "float32", "float64", "int64", "bool", "string" or "video", ...
        shape: Shape of a frame's value; (h, w, 3) of an image.
        names: Names of the values; None: they have none.
        info: Properties of a video.
    """

    dtype: str
    shape: tuple[int, ...]
    names: Any = None
    info: dict[str, Any] | None = None

    @property
    def size(self) -> int:
        """Number of values of a frame."""
        return prod(self.shape)

    @property
    def is_image(self) -> bool:
        """True if its frames are not in the tables."""
        return self.dtype in ("video", "image")

    def to_json(self) -> dict[str, Any]:
        """Return it as `meta/info.json` has it."""
        names = list(self.names) if isinstance(self.names, tuple) else self.names
        return {
            "dtype": self.dtype,
            "shape": list(self.shape),
            "names": names,
            **({} if self.info is None else {"info": self.info}),
        }


DEFAULTS: Final = {
    "timestamp": DatasetFeature("float32", (1,)),
    "frame_index": DatasetFeature("int64", (1,)),
    "episode_index": DatasetFeature("int64", (1,)),
    "index": DatasetFeature("int64", (1,)),
    "task_index": DatasetFeature("int64", (1,)),
}
"""Features that every dataset has."""


def position_names(*, grippers: bool) -> tuple[str, ...]:
    """Return the names of the joints of both arms, in rad, and of the grippers, from 0, closed, to 1, open."""
    own = (*POSITIONS, *([GRIPPER] if grippers else []))
    return tuple(f"{arm}_{name}" for arm in ARMS for name in own)


def env_action_names(mode: ActionMode, *, grippers: bool) -> tuple[str, ...]:
    """Return the names of the numbers of an environment's action."""
    own = (*_STEPS[mode], *([GRIPPER] if grippers else []))
    return tuple(f"{arm}_{name}" for arm in ARMS for name in own)


def observation_names(layout: ObservationLayout) -> tuple[str, ...]:
    """Return the names of the numbers of an environment's observation, such as "left_q_rad.0"."""
    own = [f"{field.name}.{k}" if field.size > 1 else field.name for field in layout.fields for k in range(field.size)]
    return tuple(f"{arm}_{name}" for arm in ARMS for name in own)


def of_arms(
    mode: ActionMode, layout: ObservationLayout, *, grippers: bool, cameras: Sequence[str], size: tuple[int, int]
) -> dict[str, DatasetFeature]:
    """Return the features of a dataset of recorded runs.

    Args:
        mode: Meaning of the environment's actions.
        layout: Layout of the environment's observations.
        grippers: The arms have grippers.
        cameras: Names of the cameras whose images it has.
        size: Height and width of an image.

    Raises:
        DatasetError: Two cameras would have one feature.
    """

    def vector(names: Sequence[str], dtype: str = "float32") -> DatasetFeature:
        return DatasetFeature(dtype, (len(names),), tuple(names))

    positions = position_names(grippers=grippers)
    return {
        STATE: vector(positions),
        ENVIRONMENT_STATE: vector(observation_names(layout)),
        ACTION: vector(positions),
        ENV_ACTION: vector(env_action_names(mode, grippers=grippers)),
        **{key: DatasetFeature("video", (*size, 3), ("height", "width", "channels")) for key in image_keys(cameras)},
        "next.reward": DatasetFeature("float32", (1,)),
        "next.done": DatasetFeature("bool", (1,)),
        "next.success": DatasetFeature("bool", (1,)),
        "commander": vector(ARMS, "int64"),
        "intervention": DatasetFeature("bool", (1,)),
        **DEFAULTS,
    }


def words_of(env_id: str) -> str:
    """Return an environment's name in words, such as "Sync carry"."""
    name = env_id.split("/")[-1].rsplit("-v", 1)[0]
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", " ", name).capitalize()
