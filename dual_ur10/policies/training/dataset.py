"""Minari datasets: collection by running a policy, and reading for training."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from dual_ur10.envs.api.vector_env import DualArmVectorEnv
from dual_ur10.envs.core.ends import details_of, early_end
from dual_ur10.envs.core.options import AS_ON_CONTROLLERS
from dual_ur10.errors import DatasetError, DualUR10Error, MissingExtraError
from dual_ur10.ids import env_id_of, received
from dual_ur10.policies.evaluation.evaluate import actor_of
from dual_ur10.policies.evaluation.minari_export import to_minari
from dual_ur10.policies.learned.signature import EnvironmentView, view_of
from dual_ur10.policies.policy import EpisodeAware, is_alone
from dual_ur10.policies.registry import OF_INTERFACES, keywords_for, load_named
from dual_ur10.policies.training.gather import Samples
from dual_ur10.policies.training.settings import check_simulated
from dual_ur10.sim2real.recording.header import describe
from dual_ur10.sim2real.recording.run import ArmLog, Episode, Run
from ur_core.kinematics.ur10 import ARMS

_LOG: Final = logging.getLogger(__name__)

_SAME: Final = ("env_id", "observation", "action", "rate", "actions", "robot")


def collect(
    env_id: str,
    dataset_id: str,
    *,
    policy: str = "scripted",
    episodes: int = 100,
    seed: int = 0,
    envs: int = 16,
    env_kwargs: Mapping[str, Any] | None = None,
    author: str | None = None,
    author_email: str | None = None,
    code_permalink: str | None = None,
    threads: int | None = None,
    on_progress: Callable[[int, int], None] = lambda episodes, successes: None,
) -> Any:
    """Run episodes of a policy and make a Minari dataset of them.

    The format is that of `dual_ur10.policies.evaluation.minari_export.to_minari`. If Ctrl-C or an error ends it early,
    the dataset has the episodes that had ended.

    Args:
        env_id: Id of the environment, or its short name.
        dataset_id: Name in Minari's form, such as "ur10/carry/scripted-v0"; it must not exist.
        policy: A name as for `dual_ur10.policies.evaluate`, or the folder of a checkpoint.
        episodes: Number of episodes.
        seed: Seed of the first episode; the others count on.
        envs: Number of cells that are stepped together; one where `evaluate` runs one.
        env_kwargs: Keywords of the environment, and `max_episode_steps` of its vector form.
        author: Author of the dataset.
        author_email: Author's address.
        code_permalink: Link to the code that made it.
        threads: Threads that step the cells.
        on_progress: Callback with the numbers of ended and of successful episodes.

    Returns:
        The `minari.MinariDataset`.

    Raises:
        DatasetError: It exists, or Minari refuses it.
        MissingExtraError: Minari is not installed.
        DualUR10Error: A name or a value is not legal.
    """
    check_new(dataset_id)
    env_id, keywords = env_id_of(env_id), dict(env_kwargs or {})
    check_simulated(keywords, "collecting from a policy", "record a rollout with --cell, or collect with an operator")
    keywords = keywords_for(policy, env_id, keywords)
    loaded = load_named(policy, env_id, keywords)
    env = DualArmVectorEnv(
        1 if is_alone(loaded) else min(envs, episodes),
        env_id,
        autoreset_mode="Disabled",
        **{"threads": threads, **AS_ON_CONTROLLERS, **keywords},
    )
    try:
        actor, core = actor_of(policy, env) if loaded is None else loaded, env.core
        header = describe(
            env_id,
            {name: value for name, value in keywords.items() if name not in OF_INTERFACES},
            core.config,
            period_ticks=core.pipeline.adapter.ticks,
            latency_ticks=int(core.options.latency_ticks(core.config)),
            seed=seed,
            policy=str(policy),
        )

        def write() -> Any:
            run = Run(header, (ArmLog({}, {}), ArmLog({}, {})), found, [], True)
            try:
                return to_minari(
                    run, dataset_id, author=author, author_email=author_email, code_permalink=code_permalink
                )
            except DualUR10Error as error:
                raise DatasetError(str(error)) from error

        found: list[Episode] = []
        try:
            while len(found) < episodes:
                count = min(env.num_envs, episodes - len(found))
                _batch(env, actor, range(seed + len(found), seed + len(found) + env.num_envs), count, found)
                on_progress(len(found), sum(bool(each.success) for each in found))
        except BaseException:
            if found:
                write()
                _LOG.warning("collecting ended early: %s has the %d episodes that had ended", dataset_id, len(found))
            raise
    finally:
        env.close()
    return write()


def check_new(dataset_id: str) -> None:
    """Make sure that a dataset can be made with this name.

    Raises:
        DatasetError: It exists, or Minari refuses its name.
        MissingExtraError: Minari is not installed.
    """
    minari = _minari()
    try:
        minari.dataset.minari_dataset.parse_dataset_id(dataset_id)
    except (TypeError, ValueError) as error:
        reason = "it has no version, such as -v0" if isinstance(error, TypeError) else error  # Minari's own accident
        raise DatasetError(f"{dataset_id!r:.80} is no name of a dataset: {reason}") from None
    if dataset_id in minari.list_local_datasets():
        raise DatasetError(f"the dataset {dataset_id} exists, and nothing is overwritten: choose another name")


def _batch(env: Any, actor: Any, seeds: range, count: int, found: list[Episode]) -> None:
    """Run an episode in every row, and add those of the first `count` rows to `found`, as far as they have ended."""
    n, number = env.num_envs, len(found)
    rows: list[dict[str, list[Any]]] = [
        {name: [] for name in ("observation", "action", "reward", "terminated", "truncated", "gated", "time_s")}
        for _ in range(n)
    ]
    success = np.zeros(n, dtype=bool)
    actor.reset()
    observation, _ = env.reset(seed=list(seeds))
    if isinstance(actor, EpisodeAware):
        actor.begin(np.arange(n), list(seeds))
    live = np.arange(n) < count
    ended_by = [""] * n
    for row in range(count):
        rows[row]["observation"].append(observation[row].copy())
    period_s = env.core.timing.period_s
    try:
        while live.any():
            action = np.asarray(actor(observation), dtype=env.single_action_space.dtype)
            observation, reward, terminated, truncated, info = env.step(action)
            over = terminated | truncated
            for row in np.flatnonzero(live).tolist():
                own = rows[row]
                own["observation"].append(observation[row].copy())
                own["action"].append(action[row].copy())
                own["reward"].append(float(reward[row]))
                own["terminated"].append(bool(terminated[row]))
                own["truncated"].append(bool(truncated[row]))
                own["gated"].append("safety" in info and bool(info["_safety"][row]))
                own["time_s"].append(period_s * len(own["reward"]))
                if over[row]:
                    success[row] = bool(info["is_success"][row])
                    ended_by[row] = early_end(details_of(info, row))
            live &= ~over
            if over.any() and live.any():
                observation, _ = env.reset(options={"reset_mask": over})
                if isinstance(actor, EpisodeAware):
                    actor.begin(np.flatnonzero(over), [seeds[row] for row in np.flatnonzero(over).tolist()])
    finally:
        found += [
            _episode(rows[row], seeds[row], number + row, bool(success[row]), ended_by[row])
            for row in np.flatnonzero(~live[:count]).tolist()
        ]


def _episode(own: dict[str, list[Any]], seed: int, number: int, success: bool, ended_by: str) -> Episode:
    count = len(own["reward"])
    return Episode(
        seed=seed,
        number=number,
        begin_s=0.0,
        action=np.array(own["action"]),
        targets_rad=np.empty((count, 0, 2, 6)),
        gripper_m=None,
        gated=np.array(own["gated"], dtype=bool),
        reward=np.array(own["reward"]),
        terminated=np.array(own["terminated"], dtype=bool),
        truncated=np.array(own["truncated"], dtype=bool),
        success=success,
        ended_by=ended_by,
        observation=np.array(own["observation"]),
        time_s=np.array(own["time_s"]),
        q_rad=np.empty((0, 2, 6)),
        flange_m=np.empty((0, 2, 3)),
        initial_state=None,
        first_target=np.zeros(count, dtype=np.int64),
    )


def read_dataset(dataset_id: str, view: EnvironmentView) -> Samples:
    """Read observations, (k, O), and actions, (k, A), of the successful episodes of a dataset.

    All episodes count if none states its success.

    Args:
        dataset_id: Name of a Minari dataset on this machine.
        view: Environment to learn.

    Raises:
        DatasetError: No such dataset, or it is of another environment, rate, latency or kind of action.
        MissingExtraError: Minari is not installed.
    """
    minari = _minari()
    try:
        _check_spaces(minari, dataset_id)
        dataset = minari.load_dataset(dataset_id)
        spec = dataset.storage.metadata.get("env_spec")
    except FileNotFoundError as error:
        raise DatasetError(
            f"there is no whole dataset {dataset_id!r:.120} on this machine: make one with `collect`, or fetch a "
            "published one with `minari download`"
        ) from error
    except Exception as error:  # Minari raises what its storage does
        raise DatasetError(f"the dataset {dataset_id!r:.120} cannot be read: {error!s:.200}") from error
    _check(dataset_id, spec, view)
    observations, actions = [], []
    try:
        for episode in dataset.iterate_episodes(_chosen(dataset_id, dataset)):
            arms = np.stack([episode.observations[arm] for arm in ARMS], axis=1)[:-1]
            observations.append(arms.reshape(len(arms), -1).astype(np.float32))
            actions.append(np.concatenate([episode.actions[arm] for arm in ARMS], axis=1).astype(np.float32))
    except (KeyError, TypeError, ValueError, IndexError, OSError) as error:
        if isinstance(error, DatasetError):
            raise
        raise DatasetError(f"{dataset_id} has an episode that cannot be read: {error!s:.200}") from error
    if not observations:
        raise DatasetError(f"{dataset_id} has no episodes")
    observation, action = np.concatenate(observations), np.concatenate(actions)
    found, expected = [observation.shape[1], action.shape[1]], view.signature
    if found != [expected.observation.shape[0], expected.action.shape[0]] or not (
        np.isfinite(observation).all() and np.isfinite(action).all()
    ):
        raise DatasetError(f"{dataset_id} has observations or actions of another size, or numbers that are not finite")
    lengths = [len(each) for each in actions]
    return Samples(observation, action, np.repeat(np.arange(len(lengths)), lengths))


def _check_spaces(minari: Any, dataset_id: str) -> None:
    """Refuse a dataset without its spaces: Minari would import what its environment names, to make it for them.

    Raises:
        DatasetError: It does not state both spaces.
        FileNotFoundError: There is no such dataset.
    """
    path = Path(minari.storage.datasets_root_dir.get_dataset_path(dataset_id)) / "data" / "metadata.json"
    stated = json.loads(path.read_text())
    if not all(isinstance(stated.get(name), str) for name in ("observation_space", "action_space")):
        raise DatasetError("it does not state its spaces of observations and actions: export it anew")


def _chosen(dataset_id: str, dataset: Any) -> list[int]:
    """Return the indices of successful episodes; of all, if none states its success.

    Raises:
        DatasetError: They state it, and none succeeded.
    """
    every = [int(each) for each in dataset.episode_indices]
    stated = [str(each.get("success", "unknown")) for each in dataset.storage.get_episode_metadata(every)]
    chosen = [each for each, text in zip(every, stated, strict=True) if text == "true"]
    if chosen or all(text == "unknown" for text in stated):
        return chosen or every
    raise DatasetError(f"{dataset_id} has {len(every)} episodes, of which none succeeded: there is nothing to learn")


def _check(dataset_id: str, spec: Any, view: EnvironmentView) -> None:
    import gymnasium as gym

    try:
        found = gym.envs.registration.EnvSpec.from_json(spec)
        keywords = {name: value for name, value in found.kwargs.items() if name != "task"}  # the id names it
        with received(f"the dataset {dataset_id}"):
            signature = view_of(str(found.id), keywords).signature
    except Exception as error:  # a malformed spec raises many kinds
        raise DatasetError(f"{dataset_id} does not specify its environment: {error!s:.200}") from error
    for name in _SAME:
        theirs, ours = getattr(signature, name), getattr(view.signature, name)
        if theirs != ours:
            raise DatasetError(
                f"{dataset_id} is of an environment with {name} {theirs!r:.200}, this one has {ours!r:.200}: collect "
                "one with the same keywords"
            )


def _minari() -> Any:
    try:
        import h5py  # type: ignore[import-untyped]  # noqa: F401  # what Minari reads and writes with
        import minari  # type: ignore[import-untyped]
    except ImportError:
        raise MissingExtraError("Minari", "data", "a dataset") from None
    return minari
