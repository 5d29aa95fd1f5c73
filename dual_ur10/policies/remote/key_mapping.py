"""Mapping files: under which keys a server wants the observation, and what its actions mean."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pydantic

from dual_ur10.envs.tasks.observation_layout import ObservationLayout
from dual_ur10.errors import PolicyServerError, SettingsError
from ur_core.kinematics.ur10 import ARMS
from ur_core.types import Array

_STRICT = pydantic.ConfigDict(strict=True, extra="forbid", frozen=True)


class ImageKey(pydantic.BaseModel):
    """Image under a key.

    Attributes:
        camera: Name of an observed camera.
        layout: "HWC" or "CHW".
    """

    model_config = _STRICT
    camera: str
    layout: Literal["HWC", "CHW"] = "HWC"


class WireMapping(pydantic.BaseModel):
    """Keys of a server's observations, and the meaning of its actions.

    Attributes:
        dt_s: Time between two actions of a chunk; None: as the server states.
        action_mode: "joint_position" or "joint_delta"; None: as the server states.
        actions: Parts of an action in their order: "left.joints", "left.gripper", "right.joints", "right.gripper", and
            "skip:N" for N numbers that mean nothing here. An arm that is left out stays where it is commanded.
        action_key: Key of the actions in an answer.
        gripper: Numbers of the server for a closed and an open gripper, in actions and in the state.
        state: Parts of each array of numbers, by key: fields of the observation such as "left.q_rad", or
            "left.gripper". A dot in a key begins a dict within the dict.
        images: Images, by key.
        constants: Texts and numbers that are sent as they are, by key, such as a prompt.
        endpoint: The server wants `"endpoint": "infer"` in requests, and takes "reset".
        timeout_s: Time without an answer after which the server is given up.
    """

    model_config = _STRICT
    dt_s: float | None = pydantic.Field(default=None, ge=1e-3, le=10.0)
    action_mode: Literal["joint_position", "joint_delta"] | None = None
    actions: tuple[str, ...] = pydantic.Field(default=(), strict=False)
    action_key: str = "actions"
    gripper: tuple[float, float] = pydantic.Field(default=(-1.0, 1.0), strict=False)
    state: dict[str, Annotated[list[str], pydantic.Field(min_length=1)]] = {}
    images: dict[str, ImageKey] = {}
    constants: dict[str, str | int | float | bool] = {}
    endpoint: bool = False
    timeout_s: float = pydantic.Field(default=10.0, gt=0.0, le=600.0)

    @pydantic.model_validator(mode="after")
    def _check(self) -> WireMapping:
        if self.gripper[0] == self.gripper[1]:
            raise ValueError(f"gripper is {self.gripper}: the numbers for closed and open must differ")
        named = [part for part in self.actions if not part.startswith("skip:")]
        for part in self.actions:
            if part.startswith("skip:") and not (part[5:].isdigit() and 0 < int(part[5:]) <= 1000):
                raise ValueError(f"{part!r} in actions: write skip: and a number from 1 to 1000")
        allowed = [f"{arm}.{what}" for arm in ARMS for what in ("joints", "gripper")]
        unknown = [part for part in named if part not in allowed]
        if unknown or len(set(named)) < len(named):
            raise ValueError(f"actions are {list(self.actions)}: write some of {', '.join(allowed)}, each once")
        own = ["observation"] * self.is_own + ["endpoint"] * self.endpoint
        keys = [*own, *self.state, *self.images, *self.constants]
        for key in keys:
            if keys.count(key) > 1 or any(each.startswith(f"{key}.") for each in keys):
                raise ValueError(f"{key!r} is a key twice, or also a dict of others: give each value a key of its own")
        return self

    @classmethod
    def read(cls, path: Path) -> WireMapping:
        """Return the mapping in a file.

        Raises:
            SettingsError: It cannot be read, or holds a value that is not legal.
        """
        try:
            return cls.model_validate(tomllib.loads(path.read_text(encoding="utf-8")))
        except OSError as error:
            raise SettingsError(f"the mapping {path} cannot be read: {error.strerror}") from error
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise SettingsError(f"the mapping {path} is no TOML: {error}") from error
        except pydantic.ValidationError as error:
            found = "; ".join(f"{'.'.join(map(str, each['loc'])) or 'file'}: {each['msg']}" for each in error.errors())
            raise SettingsError(f"the mapping {path} is not legal: {found}") from error

    @property
    def is_own(self) -> bool:
        """True if the observation is sent as it is, to a server of this package."""
        return not (self.state or self.images)


class Mapped:
    """Observations and actions of an environment in the form of a server.

    Args:
        mapping: The mapping.
        layout: Fields of an observation.
        strokes_m: (2,) largest widths of the grippers.
        grippers: An action has an opening for each gripper.

    Raises:
        SettingsError: The mapping names a field that there is not, or the grippers are not moved.
    """

    def __init__(
        self, mapping: WireMapping, layout: ObservationLayout, strokes_m: Sequence[float], *, grippers: bool
    ) -> None:
        self.mapping, self._layout, self._strokes_m, self._grippers = mapping, layout, strokes_m, grippers
        for parts in mapping.state.values():
            for part in parts:
                arm, _, name = part.partition(".")
                field = "gripper_m" if name == "gripper" else name
                if arm not in ARMS or field not in layout.names:
                    known = ", ".join((*layout.names, *(["gripper"] if "gripper_m" in layout.names else [])))
                    raise SettingsError(
                        f"{part!r} in the state of the mapping: write left. or right. and one of {known}"
                    )
        if not grippers and any(part.endswith("gripper") for part in mapping.actions):
            raise SettingsError("the actions of the mapping have grippers, and this environment's have none: skip:1")

    def request(self, observation: Any) -> dict[str, Any]:
        """Return the request for an observation of one cell.

        Raises:
            PolicyServerError: The observation lacks an image.
        """
        found: dict[str, Any] = {}
        if self.mapping.is_own:
            found["observation"] = observation
        fields = self._fields(observation)
        for key, parts in self.mapping.state.items():
            _put(found, key, np.concatenate([self._part(fields, part) for part in parts]).astype(np.float32))
        for key, image in self.mapping.images.items():
            pixels = self._image(observation, image.camera)
            _put(found, key, np.ascontiguousarray(pixels.transpose(2, 0, 1) if image.layout == "CHW" else pixels))
        for key, value in self.mapping.constants.items():
            _put(found, key, value)
        if self.mapping.endpoint:
            found["endpoint"] = "infer"
        return found

    def chunk(self, actions: Array, observation: Any, action_mode: str) -> Array:
        """Return the chunk, (H, D) as of `ChunkPolicy`, of the actions of an answer, (H, numbers).

        Raises:
            PolicyServerError: The actions have fewer numbers than the mapping has parts.
        """
        parts = self.mapping.actions
        if not parts:
            return actions
        sizes = [6 if part.endswith("joints") else int(part[5:]) if part.startswith("skip:") else 1 for part in parts]
        if actions.shape[1] != sum(sizes):
            raise PolicyServerError(
                f"the server's actions have {actions.shape[1]} numbers, and those of the mapping {sum(sizes)}: "
                f"{', '.join(parts)}"
            )
        fields = self._fields(observation)
        joints = np.zeros((len(actions), 2, 6))
        if action_mode == "joint_position" and sum("joints" in part for part in parts) < 2:
            joints[:] = self._part(fields, "left.commanded_q_rad"), self._part(fields, "right.commanded_q_rad")
        openings = np.ones((len(actions), 2))
        if "gripper_m" in fields:
            openings[:] = self._openings(fields)
        for part, end, size in zip(parts, np.cumsum(sizes).tolist(), sizes, strict=True):
            arm, _, what = part.partition(".")
            numbers = actions[:, end - size : end]
            if what == "joints":
                joints[:, ARMS.index(arm)] = numbers
            elif what == "gripper":
                closed, opened = self.mapping.gripper
                openings[:, ARMS.index(arm)] = np.clip(2.0 * (numbers[:, 0] - closed) / (opened - closed) - 1.0, -1, 1)
        if not self._grippers:
            return joints.reshape(len(actions), 12)
        return np.concatenate([joints, openings[..., None]], axis=2).reshape(len(actions), 14)

    def _image(self, observation: Any, camera: str) -> Any:
        """Return the image of a camera, (height, width, 3) uint8.

        Raises:
            PolicyServerError: The observation has none.
        """
        images = observation if isinstance(observation, Mapping) else {}
        images = images.get("pixels", images)
        if camera not in images:
            shown = ", ".join(sorted(set(images) - {"state"})) or "no camera"
            wanted = tuple(dict.fromkeys(each.camera for each in self.mapping.images.values()))
            raise PolicyServerError(
                f"the mapping has an image of the camera {camera!r}, and the observation one of {shown}: use "
                f"observation='both' and cameras={wanted!r}"
            )
        return np.asarray(images[camera])

    def _fields(self, observation: Any) -> dict[str, Array]:
        state = observation.get("state") if isinstance(observation, Mapping) else observation
        if state is None or np.size(state) != 2 * self._layout.size:
            return {}
        return dict(self._layout.split(np.asarray(state, dtype=np.float64)))

    def _openings(self, fields: Mapping[str, Array]) -> Array:
        """Return the measured openings of the grippers, (2,), -1 closed to 1 open."""
        widths_m = fields["gripper_m"].reshape(2)
        openings: Array = np.clip(2.0 * widths_m / np.asarray(self._strokes_m) - 1.0, -1.0, 1.0)
        return openings

    def _part(self, fields: Mapping[str, Array], part: str) -> Array:
        """Return the numbers of a part of the state."""
        if not fields:
            raise PolicyServerError("the mapping has a state, and this observation has none: use observation='both'")
        arm, _, name = part.partition(".")
        side = ARMS.index(arm)
        if name != "gripper":
            return np.asarray(fields[name][side], dtype=np.float64)
        closed, opened = self.mapping.gripper
        return np.array([closed + (self._openings(fields)[side] + 1.0) / 2.0 * (opened - closed)])


def _put(target: dict[str, Any], key: str, value: Any) -> None:
    """Put a value under a key, of which each dot begins a dict within the dict."""
    *outer, last = key.split(".")
    for name in outer:
        target = target.setdefault(name, {})
    target[last] = value
