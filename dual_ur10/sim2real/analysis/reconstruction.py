"""Reconstruction of the environment of a recorded run, and checks that a cell can replay it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError

from dual_ur10.envs.core.options import EnvOptions
from dual_ur10.envs.core.setup import load_task
from dual_ur10.errors import CellFileError, DualUR10Error, RecordingError, SettingsError, UnknownNameError
from dual_ur10.ids import TASKS, is_registered, received
from dual_ur10.sim2real.cell.cell_config import CellConfig
from dual_ur10.sim2real.cell.named_cell import resolve_cell
from dual_ur10.sim2real.cell_file.cell_file import examine_text
from dual_ur10.sim2real.recording.header import built, field_types, findings, mounts_of
from dual_ur10.sim2real.recording.run import Episode, Header, Run
from ur_core.kinematics.rotations import quat_conjugate, quat_multiply, quat_to_rotvec
from ur_core.kinematics.ur10 import ARMS, TICK_S
from ur_core.mjcf.camera import Camera
from ur_core.servoj import ServojProfile

BASE_M: Final = 0.05
BASE_RAD: Final = 0.1
"""Largest change of a base pose since the recording, such as between a planned and a measured one."""

_VISUAL: Final = (
    "render_mode",
    "camera",
    "width",
    "height",
    "shadows",
    "confirm",
    "record",
    "record_failure",
    "record_about",
)
"""Keywords that change no motion."""

_CAMERAS: Final = "cameras"

_SIMULATED: Final = ("randomization", "observation", _CAMERAS, "pixels_rate_hz", *_VISUAL)
"""Keywords without meaning for real arms."""


_LATENCY: Final = "action_latency_ticks"


def keywords_of(header: Header, cell: str | Path | CellConfig | None = None) -> dict[str, Any]:
    """Return the keywords of `gym.make` for the environment of a recorded run.

    The action latency is the recorded one, or that of the cell if it is longer. A recorded `CellConfig` of any kind is
    simulated with MuJoCo: no record makes another cell than the one that the caller names.

    Args:
        header: Header of the run.
        cell: Cell of the replay; None: a simulation of the recorded cell.

    Raises:
        RecordingError: The recording lacks an entry, or holds an illegal one.
    """
    needed = 0 if cell is None else resolve_cell(cell).latency_ticks
    with received("the recording"):
        return _keywords_of(header, cell, needed)


def _keywords_of(header: Header, cell: str | Path | CellConfig | None, needed: int) -> dict[str, Any]:
    _check_registered(header)
    left_out = _VISUAL if cell is None and header.source == "mujoco" else _SIMULATED
    keywords = _typed({name: each for name, each in header.kwargs.items() if name not in (*left_out, "task")}, header)
    keywords[_LATENCY] = header.latency_ticks
    if cell is not None:
        return {**keywords, "cell": cell, _LATENCY: max(header.latency_ticks, needed)}
    try:
        if header.cell_file is None and isinstance(keywords.get("cell"), Mapping):
            keywords["cell"] = built(CellConfig, {**keywords["cell"], "kind": "mujoco"})
        elif header.source != "mujoco":
            keywords["cell"] = _simulated(header)
        elif keywords.get("cell", "mujoco") != "mujoco":
            # A path would name real arms, which nobody asked to move.
            raise SettingsError(f"it is {keywords['cell']!r:.80}, and a simulated run's is not a file")
    except (SettingsError, UnknownNameError, LookupError, TypeError, ValueError) as error:
        raise RecordingError(
            f"the cell of the recording is not legal: {error}. It is damaged, or of another version"
        ) from error
    return keywords


def task_keywords(header: Header) -> dict[str, Any]:
    """Return the keywords of a run's task, as values of the types that its settings state.

    Raises:
        RecordingError: The task is not registered, or a value is not legal.
    """
    with received("the recording"):
        _check_registered(header)
        own = field_types(load_task(header.env_id).settings_type)
        return _typed({name: each for name, each in header.kwargs.items() if name in own}, header)


def _check_registered(header: Header) -> None:
    if not is_registered(header.env_id):
        raise RecordingError(
            f"the recording is of {header.env_id!r}: this version has {', '.join(TASKS)}. Use the version that "
            "recorded it, or install the package that brings the task"
        )


def _typed(keywords: dict[str, Any], header: Header) -> dict[str, Any]:
    """Return keywords, with those of the task, and cameras, as values of the types that their dataclasses state."""
    settings_type = load_task(header.env_id).settings_type
    own = keywords.keys() & field_types(settings_type).keys()
    cameras = keywords.keys() & {_CAMERAS}
    types = {**field_types(settings_type), _CAMERAS: tuple[str | Camera, ...]}
    for name in own | cameras:
        try:
            value = keywords[name]
            keywords[name] = built(types[name], [value] if name == _CAMERAS and isinstance(value, Mapping) else value)
        except (DualUR10Error, LookupError, OverflowError, TypeError, ValueError) as error:
            raise RecordingError(
                f"the keyword {name} of the recording is not legal: {error}. It is damaged, or of another version"
            ) from error
    try:
        settings_type(**{name: keywords[name] for name in own})  # names are resolved here, where nothing is imported
        EnvOptions(**{name: keywords[name] for name in cameras})
    except (DualUR10Error, LookupError, OverflowError, TypeError, ValueError) as error:
        raise RecordingError(f"the keywords of the recording are not legal: {error}") from error
    return keywords


def replayed_keywords(header: Header) -> dict[str, Any]:
    """Return the keywords of a run's environment that a replay passes on to any cell."""
    return {name: value for name, value in header.kwargs.items() if name not in (*_SIMULATED, "task", "cell", _LATENCY)}


def _simulated(header: Header) -> CellConfig:
    """Return the simulated counterpart of a cell of two controllers."""
    if header.cell_file is not None:
        cell, findings = examine_text(header.cell_file, "the recording's cell file")
        if cell is None:
            raise CellFileError(findings[0])
        return cell.simulated()
    left, right = mounts_of(header)
    profile = header.servoj[0]
    servoj = ServojProfile(header.family, profile["lookahead_s"], profile["gain"])
    return CellConfig(left=left, right=right, servoj=servoj)


class _BitGenerator(BaseModel):
    """State of NumPy's default generator, as an event holds it."""

    model_config = ConfigDict(strict=True, extra="forbid")
    bit_generator: Literal["PCG64"]
    state: dict[Literal["state", "inc"], int]
    has_uint32: int
    uinteger: int


def generator_text(run: Run, number: int) -> str | None:
    """Return the state of the generator before an episode's reset, in JSON; None: it was not recorded."""
    texts = [each.text for each in run.events if each.kind == "generator"]
    number -= bool(run.episodes and run.episodes[0].first_step)  # a black box lacks the event of its first episode
    return texts[number] if 0 <= number < len(texts) else None


def generator_of(text: str | None, number: int) -> np.random.Generator | None:
    """Return the generator of an episode's reset as `generator_text` states it; None: it does not.

    Raises:
        RecordingError: It is no legal state of a generator.
    """
    if text is None:
        return None
    try:
        generator = np.random.default_rng(0)
        generator.bit_generator.state = _BitGenerator.model_validate_json(text).model_dump()
    except (ValueError, KeyError, TypeError, OverflowError) as error:
        reason = findings(error) if isinstance(error, ValidationError) else repr(error)
        raise RecordingError(
            f"the generator of episode {number} cannot be read: {reason:.200}. The recording is damaged; record it anew"
        ) from error
    return generator


def resets_of(run: Run, number: int) -> list[int | None]:
    """Return the seeds of the resets that lead to an episode, for a record without the state of the generator.

    They begin at the last episode that was given a seed.
    """
    first = number
    while first > 0 and run.episodes[first].seed is None:
        first -= 1
    seeds = [run.episodes[k].seed for k in range(first, number + 1)]
    if first == 0 and seeds[0] is None:
        seeds[0] = run.header.seed
    return seeds


def check_replayable(header: Header, config: CellConfig) -> None:
    """Make sure that a cell can replay a recorded run: the same robot at the same rate, with the bases where they were.

    Raises:
        RecordingError: It cannot. The message names what was found, what was expected and what to do.
    """
    for name, factor in (("recording", header.speed_factor), ("cell", config.speed_factor)):
        if not 0.0 < factor <= 1.0:
            raise RecordingError(
                f"the speed_factor of the {name} is {factor!r}: above 0 and at most 1 is expected, for nothing is "
                "replayed faster than in the time of its task. Correct the cell file, or record the run anew"
            )
    servoj = config.servoj
    if header.family not in TICK_S or abs(TICK_S[header.family] - header.tick_s) > 1e-9:
        raise RecordingError(
            f"the recording is of a controller {header.family!r} with a tick of {header.tick_s!r} s: expected is one "
            f"of {', '.join(f'{name} with {tick_s:g} s' for name, tick_s in TICK_S.items())}. It is of another robot"
        )
    if header.family != servoj.family:
        raise RecordingError(
            f"the recording is of {header.family} controllers ({1 / header.tick_s:g} Hz), the cell has {servoj.family} "
            f"({1 / servoj.tick_s:g} Hz): the same are expected. Replay it on the other cell, or record it anew"
        )
    for arm, there, here in zip(ARMS, mounts_of(header), (config.left, config.right), strict=True):
        if there.robot != here.robot:
            raise RecordingError(
                f"the recording's {arm} arm is a {there.robot!r}, that of the cell a {here.robot!r}: the same are "
                "expected. Replay it on the other cell, or record it anew"
            )
        away = float(np.linalg.norm(np.subtract(there.position_m, here.position_m)))
        turned = float(np.linalg.norm(quat_to_rotvec(quat_multiply(quat_conjugate(there.quat), here.quat))))
        if not (away <= BASE_M and turned <= BASE_RAD):
            raise RecordingError(
                f"{arm}: the base was at {tuple(there.position_m)} m, turned by {there.yaw_rad:g} rad and tilted by "
                f"{math.hypot(*there.tilt_rad):g} rad, and is at {tuple(here.position_m)} m, turned by "
                f"{here.yaw_rad:g} rad and tilted by {math.hypot(*here.tilt_rad):g} rad: {BASE_M} m and {BASE_RAD} rad "
                "apart are the most. Replay it on a cell like the recorded one, or record it anew"
            )


_KEPT: Final = ("action_scale", "at_limits")
"""Keywords on which the targets of an action depend."""


def check_same_actions(header: Header, episode: Episode, core: Any) -> None:
    """Make sure that an environment interprets the actions of an episode as the recorded one did.

    Args:
        header: Header of the run.
        episode: An episode of the run.
        core: Core of the environment, `env.unwrapped.core`.

    Raises:
        RecordingError: It does not. The message names what was found, what was expected and what to do.
    """
    adapter = core.pipeline.adapter
    size = 2 * adapter.action_size
    count, *shape = episode.action.shape
    for what, found, expected in (
        ("ticks per action", header.period_ticks, adapter.ticks),
        *(
            (name, header.kwargs.get(name, getattr(type(core.options), name)), getattr(core.options, name))
            for name in _KEPT
        ),
        ("action mode", header.kwargs.get("action_mode", adapter.mode), adapter.mode),
        ("numbers of an action", int(np.prod(shape)), size),
        ("targets of an episode", episode.targets_rad.shape, (count, adapter.ticks, 2, 6)),
        ("joints of an episode", episode.q_rad.shape, (count + 1, 2, 6)),
    ):
        if found != expected:
            raise RecordingError(
                f"{what}: {found} in the recording, {expected} in the environment: they have to be the same. Make the "
                "environment like the recorded one, or record the run anew"
            )
    latency = core.options.latency_ticks(core.config)
    if latency < header.latency_ticks:
        raise RecordingError(
            f"action latency in ticks: {header.latency_ticks} in the recording, {latency} in the environment: it must "
            "not be shorter. Make the environment like the recorded one, or record the run anew"
        )
