"""Export of runs to Minari datasets, with one key per agent."""

from __future__ import annotations

import contextlib
import copy
import shutil
import warnings
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from dual_ur10.errors import MissingExtraError, RecordingError
from dual_ur10.sim2real.cell.cell_config import CellConfig
from dual_ur10.sim2real.recording.header import mounts_of
from dual_ur10.sim2real.recording.run import Episode, Header, Run
from ur_core.kinematics.ur10 import ARMS
from ur_core.servoj import ServojProfile

if TYPE_CHECKING:
    from dual_ur10.envs.core.core import Core

_MOST_SEED: Final = 2**63 - 1
_DIFFER: Final = ("env_id", "kwargs", "family", "period_ticks", "mounts")


def to_minari(
    runs: Run | Iterable[Run],
    dataset_id: str,
    *,
    author: str | None = None,
    author_email: str | None = None,
    code_permalink: str | None = None,
    description: str | None = None,
) -> Any:
    """Make a Minari dataset of the episodes of runs.

    Observations and actions are dicts with the keys "left" and "right", as of `dual_ur10.envs.api.parallel_env`.
    Rewards are those of both together. `infos` hold `is_success`, `gated` and `time_s`; `commander` of the left and the
    right arm, 0 the policy and 1 a person; and LeRobot's `intervention`, true while a person commands an arm. An
    episode's metadata hold `ended_by` and its place in the run. `recover_environment` gives an environment with the
    same spaces, see `dual_ur10.envs.api.agent_dict.AgentDictWrapper`.

    Args:
        runs: One or several, of the same environment.
        dataset_id: Name in Minari's form, such as "ur10/carry/scripted-v0"; it must not exist.
        author: Author of the dataset.
        author_email: Author's address.
        code_permalink: Link to the code that made it.
        description: Description of the dataset.

    Returns:
        The `minari.MinariDataset`.

    Raises:
        MissingExtraError: Minari is not installed.
        RecordingError: No steps, no observations, runs of different environments, or a refusal by Minari.
    """
    try:
        import h5py  # type: ignore[import-untyped]  # noqa: F401  # Minari writes with it
        import minari  # type: ignore[import-untyped]
    except ImportError:
        raise MissingExtraError("Minari", "data", "making a dataset") from None
    from gymnasium import spaces

    from dual_ur10.envs.api.two_agents import agent_spaces

    found = [runs] if isinstance(runs, Run) else list(runs)
    if not found or not any(len(episode.reward) for run in found for episode in run.episodes):
        raise RecordingError("the runs have no steps: a dataset needs one or more")
    header = found[0].header
    for run in found[1:]:
        for name in _DIFFER:
            if getattr(run.header, name) != getattr(header, name):
                raise RecordingError(
                    f"runs of one dataset must be of one environment: {name} is {getattr(header, name)!r:.200} in the "
                    f"first and {getattr(run.header, name)!r:.200} in another"
                )
    core = _core(header)
    try:
        observation, action = agent_spaces(core)
        members = [(run, episode) for run in found for episode in run.episodes if len(episode.reward)]
        buffers = [_buffer(minari, core, number, each) for number, (_, each) in enumerate(members)]
    finally:
        core.close()
    try:
        with _whole_or_none(minari, dataset_id), warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # about optional metadata
            dataset = minari.create_dataset_from_buffers(
                dataset_id,
                buffers,
                env=None,
                observation_space=spaces.Dict(dict(zip(ARMS, observation, strict=True))),
                action_space=spaces.Dict(dict(zip(ARMS, action, strict=True))),
                algorithm_name=header.policy or None,
                author=author,
                author_email=author_email,
                code_permalink=code_permalink,
                description=description,
                requirements=[f"dual-ur10=={header.versions.get('dual_ur10', '')}"],
                data_format="hdf5",
            )
            dataset.storage.update_metadata({"env_spec": _spec(header).to_json(), "dual_ur10_versions": _line(header)})
            dataset.storage.update_episode_metadata(_metadata(run, episode) for run, episode in members)
            return minari.load_dataset(dataset_id)
    except (ValueError, OSError, AssertionError) as error:
        raise RecordingError(f"Minari does not take the dataset {dataset_id!r}: {error}") from error


@contextlib.contextmanager
def _whole_or_none(minari: Any, dataset_id: str) -> Iterator[None]:
    """Remove what was written of a new dataset that is not completed: it would take the name of the next try."""
    folder = Path(minari.storage.datasets_root_dir.get_dataset_path(dataset_id))
    is_new = not folder.exists()
    try:
        yield
    except BaseException:
        if is_new:
            shutil.rmtree(folder, ignore_errors=True)
        raise


def _core(header: Header) -> Core:
    """Make a simulation of the same task, for its spaces and observations of each agent."""
    from dual_ur10.envs.core.core import Core
    from dual_ur10.ids import TASKS, is_registered, received

    if not is_registered(header.env_id):
        raise RecordingError(f"it was recorded in {header.env_id!r:.80}: allowed are {', '.join(TASKS)}")
    left, right = mounts_of(header)
    profile = ServojProfile(family=header.family, **header.servoj[0])
    with received("the recording"):
        return Core(header.env_id, _of_task(header) | {"cell": CellConfig(left=left, right=right, servoj=profile)})


def _of_task(header: Header) -> dict[str, Any]:
    """Return the keywords of the run's environment that its task, its actions and its observations depend on."""
    found = {name: value for name, value in header.kwargs.items() if name not in _NOT_OF_TASK}
    if header.kwargs.get("observation") == "goals":
        found["observation"] = "goals"
    return found


_NOT_OF_TASK: Final = ("cell", "arm", "confirm", "observation", "cameras", "pixels_rate_hz", "render_mode", "task")


def _spec(header: Header) -> Any:
    import gymnasium as gym
    from gymnasium.envs.registration import WrapperSpec

    from dual_ur10.envs.api.agent_dict import AgentDictWrapper

    spec = copy.deepcopy(gym.spec(header.env_id))
    spec.kwargs.update(_of_task(header))
    if header.latency_ticks:  # that of two controllers is not in their keywords
        spec.kwargs["action_latency_ticks"] = header.latency_ticks
    wrapper = AgentDictWrapper
    spec.additional_wrappers = (WrapperSpec(wrapper.__name__, f"{wrapper.__module__}:{wrapper.__name__}", {}),)
    return spec


def _line(header: Header) -> str:
    return ", ".join(f"{name} {version}" for name, version in sorted(header.versions.items()))


def _buffer(minari: Any, core: Core, number: int, episode: Episode) -> Any:
    if episode.observation is None:
        raise RecordingError(f"episode {number} has no observations")
    count, size = len(episode.reward), core.action_space.shape[0]
    if episode.action.shape != (count, size):
        raise RecordingError(f"actions of episode {number} have shape {episode.action.shape}, expected {(count, size)}")
    if episode.observation.shape[1:] != core.observation_space.shape:
        found, expected = episode.observation.shape[1:], core.observation_space.shape
        raise RecordingError(f"observations of episode {number} have shape {found}, expected {expected}")
    own = episode.observation.reshape(count + 1, 2, -1).astype(core.observation_space.dtype)
    action = episode.action.astype(np.float32).reshape(count, 2, -1)
    truncated = episode.truncated.copy()
    truncated[-1] |= not episode.terminated[-1]  # an episode that was cut off is truncated
    success = np.zeros(count + 1, dtype=bool)
    success[-1] = bool(episode.success)
    commander = np.zeros((count + 1, 2), dtype=np.int64)
    commander[1:] = 0 if episode.commander is None else episode.commander
    return minari.data_collector.EpisodeBuffer(
        id=number,
        seed=episode.seed if episode.seed is not None and episode.seed <= _MOST_SEED else None,
        observations={arm: own[:, side] for side, arm in enumerate(ARMS)},
        actions={arm: action[:, side] for side, arm in enumerate(ARMS)},
        rewards=episode.reward.tolist(),
        terminations=episode.terminated.tolist(),
        truncations=truncated.tolist(),
        infos={
            "is_success": success,
            "gated": np.concatenate([[False], episode.gated]),
            "time_s": np.concatenate([[0.0], episode.time_s]),
            "commander": commander,
            "intervention": commander.any(axis=1),
        },
    )


def _metadata(run: Run, episode: Episode) -> dict[str, Any]:
    success = "unknown" if episode.success is None else str(episode.success).lower()
    header = run.header
    return {
        "success": success,
        "ended_by": episode.ended_by,
        "source": header.source,
        "run": header.started_utc,
        "number": episode.number,
    }
