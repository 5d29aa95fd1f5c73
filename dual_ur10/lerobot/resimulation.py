"""Datasets in simulation: our own again, and joint motions of other people's UR arms."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from dual_ur10.envs.core.ends import early_end
from dual_ur10.errors import DatasetError
from dual_ur10.lerobot.dataset_reader import Dataset, vector_of
from dual_ur10.lerobot.dataset_writer import OWN
from dual_ur10.lerobot.features import ACTION, ENV_ACTION
from dual_ur10.lerobot.lerobot_export import FORMAT
from dual_ur10.sim2real.analysis.reconstruction import generator_of, keywords_of
from dual_ur10.sim2real.analysis.replay import AWAY_RAD
from dual_ur10.sim2real.recording.header import findings, from_metadata
from dual_ur10.sim2real.recording.run import Header
from ur_core.kinematics.ur10 import ARMS, JOINTS
from ur_core.types import Array

_APPROACH_RAD_S: Final = 0.4
_GOALS_RAD: Final = 1e-4  # the concise view shows commanded joints in single precision, scaled
_MOST_RAD: Final = 2 * math.pi + 0.1
_FREE: Final = "DualUR10/Free-v0"


@dataclass(frozen=True)
class Resimulated:
    """Result of simulating an episode of a dataset.

    Attributes:
        episode: Its number.
        steps: Number of steps made.
        frames: Number of frames in the dataset.
        difference: First difference of the commanded joints from those in the dataset; "": none.
        largest_rad: Largest difference of a commanded joint.
        ended_by: Reason of an early end; "": none.
    """

    episode: int
    steps: int
    frames: int
    difference: str
    largest_rad: float
    ended_by: str


class _OwnEpisode(BaseModel):
    """An episode of a recorded run."""

    model_config = ConfigDict(strict=True, extra="forbid")
    run: Annotated[int, Field(ge=0)]
    number: Annotated[int, Field(ge=0)]
    seed: Annotated[int, Field(ge=0)] | None
    generator: Annotated[str, Field(max_length=1000)] | None
    success: bool | None
    ended_by: Annotated[str, Field(max_length=2000)]


class _OwnContent(BaseModel):
    """Content of `OWN`."""

    model_config = ConfigDict(strict=True, extra="forbid")
    format: Literal["1"]
    gripper_stroke_m: list[float] | None
    runs: list[dict[str, str]]
    episodes: list[_OwnEpisode]


def _own(dataset: Dataset) -> tuple[list[Header], list[_OwnEpisode]]:
    """Return the runs of a dataset of ours, and its episodes.

    Raises:
        DatasetError: What describes them is not legal, or is of another dataset.
        RecordingError: A run is not legal.
    """
    path = dataset.folder / OWN
    try:
        own = _OwnContent.model_validate(dataset.own)
    except ValidationError as error:
        raise DatasetError(f"{path} is not legal, or not of format {FORMAT}: {findings(error)}") from None
    headers = [from_metadata(each) for each in own.runs]
    if len(own.episodes) != len(dataset.lengths) or any(each.run >= len(headers) for each in own.episodes):
        raise DatasetError(
            f"{path} describes {len(own.episodes)} episodes of {len(headers)} runs, and the dataset has "
            f"{len(dataset.lengths)}: delete the file to read the dataset as that of others"
        )
    return headers, own.episodes


def simulate_again(
    dataset: Dataset,
    episodes: Sequence[int] | None = None,
    *,
    record: Path | None = None,
    on_episode: Callable[[Resimulated], None] = lambda found: None,
) -> list[Resimulated]:
    """Simulate episodes of a dataset that this package exported, from the same starts with the same actions.

    Args:
        dataset: The dataset.
        episodes: Their numbers; None: all.
        record: Folder for the records of the runs, one for each run of the dataset; None: no record.
        on_episode: Called after each.

    Raises:
        DatasetError: What describes its runs is not legal, or an episode does not exist.
        RecordingError: A run cannot be simulated, or not be recorded.
        DualUR10Error: The environment failed.
    """
    headers, about = _own(dataset)
    wanted = range(len(about)) if episodes is None else episodes
    found: list[Resimulated] = []
    for number, header in enumerate(headers):
        members = [each for each in wanted if _episode(dataset, each) and about[each].run == number]
        if not members:
            continue
        env = _made(header.env_id, keywords_of(header), record, f"import of {dataset.folder.name}")
        try:
            for each in members:
                generator = generator_of(about[each].generator, each)
                if generator is not None:
                    env.unwrapped.np_random = generator
                env.reset(seed=None if generator is not None else about[each].seed)
                columns = dataset.episode(each)
                values = [_of(columns, name, dataset) for name in (ENV_ACTION, ACTION, "commander")]
                found.append(_play(env, each, header, *values))
                on_episode(found[-1])
        finally:
            env.close()
    return found


def _episode(dataset: Dataset, number: int) -> bool:
    return bool(dataset.episode(number))


def _of(columns: Mapping[str, NDArray[Any]], name: str, dataset: Dataset) -> NDArray[Any]:
    if name not in columns or columns[name].ndim != 2:
        raise DatasetError(f"{dataset.folder} has no vectors {name!r}: export it anew")
    return columns[name]


def _made(env_id: str, keywords: Mapping[str, Any], record: Path | None, about: str) -> Any:
    shown = {"observation": "state"} if keywords.get("observation") != "goals" else {}
    kept = {} if record is None else {"record": str(record), "record_about": {"policy": about}}
    return gym.make(env_id, disable_env_checker=True, **{**keywords, **shown, **kept})


def _play(
    env: Any, number: int, header: Header, actions: NDArray[Any], targets: NDArray[Any], commander: NDArray[Any]
) -> Resimulated:
    """Take the actions of an episode, and compare what is commanded with its targets in float32."""
    core = env.unwrapped.core
    exact = header.source == "mujoco"
    tolerance_rad = _GOALS_RAD if header.kwargs.get("observation") == "goals" else 0.0
    size = targets.shape[1] // 2
    if actions.shape[1:] != core.action_space.shape or size not in (6, 7) or commander.shape[1] != 2:
        raise DatasetError(
            f"episode {number} has actions of {actions.shape[1]} numbers and targets of {targets.shape[1]}: the "
            f"environment takes {core.action_space.shape[0]}, and 12 or 14. It is of another version"
        )
    joints = targets.reshape(len(targets), 2, size)[..., :6]
    difference, ended_by, largest, steps = "", "", 0.0, 0
    for step, action in enumerate(actions):
        core.commander = commander[step] != 0
        _, _, terminated, truncated, info = env.step(action)
        steps += 1
        commanded = core.pipeline.adapter.commanded_q_rad[0].astype(np.float32)
        away = np.abs(commanded.astype(np.float64) - joints[step])
        largest = max(largest, float(away.max()))
        if not difference and away.max() > tolerance_rad:
            arm, joint = np.unravel_index(int(away.argmax()), away.shape)
            difference = f"step {step}: {ARMS[arm]} {JOINTS[joint]} is {away.max():.2g} rad from the dataset's"
        if terminated or truncated:
            ended_by = early_end(info)
            if steps < len(actions):
                difference = difference or f"the episode ended after {steps} steps: {ended_by or 'its time is over'}"
            break
        if not exact and largest > AWAY_RAD:
            ended_by = f"the targets are {largest:.3f} rad apart, allowed are {AWAY_RAD} rad"
            break
    else:
        core.finish()
    return Resimulated(number, steps, len(actions), difference, largest, ended_by)


@dataclass(frozen=True)
class JointColumns:
    """Places of the joints of UR arms in a feature of a dataset.

    Attributes:
        feature: Name of the feature.
        places: For the left and the right arm, the places of its six joints from the base on; None: it has no such arm.
        degrees: The joints are in degrees.
    """

    feature: str
    places: tuple[tuple[int, ...] | None, tuple[int, ...] | None]
    degrees: bool = False


_JOINT_WORDS: Final = (
    r"shoulder_?pan|(^|[^a-z])base([^a-z]|$)",
    r"shoulder_?lift|(^|[^a-z])shoulder([^a-z]|$)",
    r"elbow",
    r"wrist_?1",
    r"wrist_?2",
    r"wrist_?3",
)
_NUMBERED: Final = re.compile(r"(?:^|[^a-z])(?:joint|motor|j|q)_?(\d)(?:\D|$)")
_SIZES: Final = {6: ((0, 6), None), 7: ((0, 6), None), 12: ((0, 6), (6, 12)), 14: ((0, 6), (7, 13))}


def joints_in(names: Sequence[str], size: int, what: str) -> tuple[tuple[int, ...] | None, tuple[int, ...] | None]:
    """Return the places of both arms' joints among named numbers; without names, by their number. One arm is the left.

    Raises:
        DatasetError: No arm of six joints was found.
    """
    if not names and size in _SIZES:
        left, right = (None if each is None else tuple(range(*each)) for each in _SIZES[size])
        return left, right
    arms: dict[str, dict[int, int]] = {}
    for place, name in enumerate(names):
        text = name.lower()
        arm = next((each for each in ARMS if each in text), "")
        text = text.replace(arm, "", 1) if arm else text
        joint = next((k for k, pattern in enumerate(_JOINT_WORDS) if re.search(pattern, text)), None)
        if joint is None and (match := _NUMBERED.search(text)):
            joint = int(match[1])
        if joint is not None:
            arms.setdefault(arm, {}).setdefault(joint, place)
    found = {arm: _six(places) for arm, places in arms.items()}
    left, right = found.get("left", found.get("")), found.get("right")
    if left is None and right is None:
        listed = ", ".join(names[:20]) or f"{size} numbers without names"
        raise DatasetError(
            f"{what} has no six joints of an arm that are known by their names: it has {listed}. Name their places, "
            "such as --left 0:6 --right 7:13"
        )
    return left, right


def _six(places: Mapping[int, int]) -> tuple[int, ...] | None:
    first = min(places)
    if first not in (0, 1) or {*places} != {*range(first, first + 6)}:  # with a seventh it is no UR arm
        return None
    return tuple(places[k] for k in range(first, first + 6))


def motions_of(dataset: Dataset, columns: JointColumns) -> Iterator[Array]:
    """Yield the joint positions of each episode, (frames, 2, 6) in rad; NaN of an arm that the dataset has not.

    Raises:
        DatasetError: There is no such feature or place, or the values are no joint positions in the stated unit.
    """
    values, _ = vector_of(dataset, columns.feature)
    joints = np.full((len(values), 2, 6), np.nan)
    for arm, places in enumerate(columns.places):
        if places is None:
            continue
        if len(places) != 6 or not all(0 <= each < values.shape[1] for each in places):
            raise DatasetError(f"{columns.feature} has {values.shape[1]} numbers: {places} are not six of them")
        joints[:, arm] = np.radians(values[:, places]) if columns.degrees else values[:, places]
    largest = float(np.nanmax(np.abs(joints))) if len(joints) else 0.0
    if largest > _MOST_RAD:
        raise DatasetError(
            f"{columns.feature} of {dataset.folder} has joints at {largest:.1f} rad, beyond 2π: its unit is another "
            f"one{'' if columns.degrees else ' (--degrees)'}, or these numbers are no joint positions"
        )
    yield from np.split(joints, np.cumsum(dataset.lengths)[:-1])


def follow_motions(
    dataset: Dataset,
    columns: JointColumns,
    episodes: Sequence[int] | None = None,
    *,
    keywords: Mapping[str, Any] | None = None,
    record: Path | None = None,
    on_episode: Callable[[Resimulated], None] = lambda found: None,
) -> list[Resimulated]:
    """Follow the joint positions of a dataset in simulation, through the same adapter and gate as on two controllers.

    Each episode begins with a motion from the start of the task to its first position. Frames of another rate are
    interpolated linearly; the grippers stay open.

    Args:
        dataset: The dataset.
        columns: Places of the joints.
        episodes: Their numbers; None: all.
        keywords: Keywords of `DualUR10/Free-v0`, such as `robot`.
        record: Folder for the record of the run; None: no record.
        on_episode: Called after each.

    Raises:
        DatasetError: The joints are not found, or an episode does not exist.
        DualUR10Error: The environment failed.
    """
    motions = list(motions_of(dataset, columns))
    wanted = list(range(len(motions)) if episodes is None else episodes)
    for each in wanted:
        dataset.episode(each)
    made = {**(keywords or {}), "action_mode": "joint_position"}
    env = _made(_FREE, made, record, f"import of {dataset.folder.name}")
    try:
        found = []
        for each in wanted:
            found.append(_follow(env, each, motions[each], dataset.fps))
            on_episode(found[-1])
        return found
    finally:
        env.close()


def _follow(env: Any, number: int, motion: Array, fps: float) -> Resimulated:
    env.reset(seed=0)
    core = env.unwrapped.core
    adapter, period_s = core.pipeline.adapter, core.timing.period_s
    start = adapter.commanded_q_rad[0]
    motion = np.where(np.isnan(motion), start, motion)
    steps = math.ceil(float(np.abs(motion[0] - start).max()) / _APPROACH_RAD_S / period_s)
    ratio = (0.5 - 0.5 * np.cos(np.pi * np.arange(1, steps + 1) / max(steps, 1)))[:, None, None]
    times, grid = np.arange(len(motion)) / fps, np.arange(0.0, (len(motion) - 1) / fps + 1e-9, period_s)
    flat = motion.reshape(len(motion), 12)
    resampled = np.stack([np.interp(grid, times, flat[:, k]) for k in range(12)], axis=1).reshape(-1, 2, 6)
    largest, made, difference, ended_by = 0.0, 0, "", ""
    for step, joints in enumerate([*(start + ratio * (motion[0] - start)), *resampled]):
        action = np.concatenate([joints, np.ones((2, adapter.action_size - 6))], axis=1).reshape(-1)
        _, _, terminated, truncated, info = env.step(action.astype(np.float32))
        if step >= steps:
            made += 1
            largest = max(largest, float(np.abs(adapter.commanded_q_rad[0] - joints).max()))
        if terminated or truncated:
            ended_by = early_end(info)
            break
    else:
        core.finish()
    if largest > AWAY_RAD:
        difference = f"limits or the gate kept the arms {largest:.3f} rad from the dataset's positions"
    return Resimulated(number, made, len(resampled), difference, largest, ended_by)
