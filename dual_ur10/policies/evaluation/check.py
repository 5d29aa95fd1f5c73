"""Check of a policy before it moves anything: in simulation, and then on two controllers if there is a cell file.

No wall time fails a check: the report holds the time of an action, with a note if it is too long for two controllers.
"""

from __future__ import annotations

import dataclasses
import logging
import os
import time
from collections.abc import Callable, Mapping
from typing import Any, Final

import gymnasium as gym
import numpy as np

from dual_ur10.envs.core.options import AS_ON_CONTROLLERS
from dual_ur10.errors import PolicyError, SettingsError
from dual_ur10.policies.evaluation.rollout import offer_time
from dual_ur10.policies.policy import Policy, as_policy
from dual_ur10.policies.registry import env_id_beside
from dual_ur10.sim2real.cell.cell_config import LATENCY_S, HostedCell
from ur_core.kinematics.ur10 import ARMS
from ur_core.types import Array

log = logging.getLogger(__name__)

MOST_STEPS: Final = 10_000
"""Default number of steps after which the check of an episode ends."""

_AGAIN: Final = 200  # observations that are repeated after a reset
_OVER: Final = 1e-6  # tolerance of an action's bounds: rounding to single precision
_SAME: Final = 1e-4  # tolerance between actions in a batch and alone: order of additions
_TAKEN_TICKS, _TAKEN_S = 3, 0.02  # part of the action's latency that passes before and after the policy acts


@dataclasses.dataclass(frozen=True, kw_only=True)
class PolicyReport:
    """Report on a policy that passed the check.

    Attributes:
        env_id: Id of the environment.
        steps: Steps of the simulated episode.
        success: True if the task reports success in that episode.
        total_reward: Sum of its rewards.
        batched: True if the policy also takes batches of observations.
        median_s, worst_s: Time of an action, on this machine under its present load.
        budget_s: Time that an action may take on two controllers.
        cell_steps: Steps on two controllers; None: there was no cell file.
        cell_success: True if the task reports success there.
        late: Actions that missed their deadline there.
        notes: Remarks that are no errors.
    """

    env_id: str
    steps: int
    success: bool
    total_reward: float
    batched: bool
    median_s: float
    worst_s: float
    budget_s: float
    cell_steps: int | None = None
    cell_success: bool | None = None
    late: int = 0
    notes: tuple[str, ...] = ()

    def __str__(self) -> str:
        lines = [
            f"{self.env_id}: {self.steps} steps, success {'yes' if self.success else 'no'}, "
            f"return {self.total_reward:.2f}, {'batches and ' if self.batched else ''}single observations, "
            f"{1e3 * self.median_s:.2f} ms an action, at worst {1e3 * self.worst_s:.2f} ms",
        ]
        if self.cell_steps is not None:
            success = "yes" if self.cell_success else "no"
            lines.append(f"on two controllers: {self.cell_steps} steps, success {success}, {self.late} late actions")
        return "\n".join([*lines, *(f"note: {each}" for each in self.notes)])


def check_policy(
    policy: Policy | Callable[[Any], Any],
    env_id: str,
    *,
    cell: str | os.PathLike[str] | HostedCell | None = None,
    steps: int | None = None,
    seed: int = 0,
    **env_kwargs: Any,
) -> PolicyReport:
    """Check a policy over one episode in simulation, and over one on two controllers if there is a cell file.

    The policy must have `reset`, or be a plain function, and act on single observations. Its actions must be finite
    numbers of the action space's shape and within its bounds. It must not change observations. After `reset` the same
    observations must give the same actions. If it takes a batch of observations, each row must give the same action as
    alone. The safety gate must not refuse any of its targets.

    Args:
        policy: Policy to check.
        env_id: Id of the environment, or a part of it such as "Handover".
        cell: A cell file, or a `VirtualCell`. The simulated cell then has its mounts, limits and latency, and a second
            episode follows on its controllers. Real arms need operator confirmation first, at the terminal or by
            `confirm`.
        steps: Steps after which the check of an episode ends; None: its own end, or `MOST_STEPS`.
        seed: Seed of both episodes.
        **env_kwargs: Keywords of the environment.

    Returns:
        Report on a policy without errors.

    Raises:
        PolicyError: The policy breaks a rule above. Arms that it was moving have a latched stop.
        SettingsError: `steps` is not a positive number, or `cell` is no path.
        TaskError: An observation of the task is outside its bounds.
        DualUR10Error: The environment failed.
    """
    name = env_id_beside(policy, env_id)
    most = _most_steps(steps)
    if cell is not None and not isinstance(cell, str | os.PathLike | HostedCell):
        raise SettingsError(
            f"cell is {type(cell).__name__}: it must be the path of a cell file, a VirtualCell, or None"
        )
    policy = as_policy(policy)
    env = gym.make(name, disable_env_checker=True, **_simulated(cell, env_kwargs))
    try:
        episode = _CheckedEpisode(policy, env)
        episode.run(seed, most)
        _check_again(policy, episode)
        batched = _check_batch(policy, env, episode, seed)
        budget_s = _budget_s(env)
    finally:
        env.close()
    notes = []
    typical_s, worst_s = float(np.median(episode.taken_s)), max(episode.taken_s)
    if typical_s > budget_s:
        notes.append(
            f"an action takes {1e3 * typical_s:.1f} ms, and on two controllers there are {1e3 * budget_s:.1f} ms: make "
            "the policy faster, or raise action_latency_ticks"
        )
    report = PolicyReport(
        env_id=name,
        steps=len(episode.actions),
        success=episode.success,
        total_reward=episode.total_reward,
        batched=batched,
        median_s=typical_s,
        worst_s=worst_s,
        budget_s=budget_s,
    )
    if cell is not None:
        env = gym.make(name, disable_env_checker=True, **{**env_kwargs, "cell": cell})
        try:
            there = _CheckedEpisode(policy, env)
            there.run(seed, most)
            late = env.unwrapped.core.late_actions  # type: ignore[attr-defined]  # Gymnasium knows only Env
        finally:
            env.close()
        if late:
            notes.append(f"{late} actions missed their deadline on two controllers: both arms stopped each time")
        report = dataclasses.replace(report, cell_steps=len(there.actions), cell_success=there.success, late=int(late))
    for note in notes:
        log.warning("%s", note)
    return dataclasses.replace(report, notes=tuple(notes))


def _most_steps(steps: int | None) -> int:
    """Return the number of steps after which the check of an episode ends.

    Raises:
        SettingsError: It is not a positive number.
    """
    if steps is None:
        return MOST_STEPS
    if isinstance(steps, bool) or not isinstance(steps, int | np.integer) or steps < 1:
        raise SettingsError(f"steps is {steps!r}: it must be a whole number above 0, or None for a whole episode")
    return int(steps)


def _simulated(cell: str | os.PathLike[str] | HostedCell | None, env_kwargs: Mapping[str, Any]) -> dict[str, Any]:
    """Return the keywords of the simulated episode, which has mounts, limits and latency of a cell of controllers."""
    keywords = {**AS_ON_CONTROLLERS, **env_kwargs}
    if cell is None:
        return keywords
    from dual_ur10.sim2real.cell_file.cell_file import load_cell_file

    for controllers_only in ("confirm", "arm"):
        keywords.pop(controllers_only, None)
    file = cell.file if isinstance(cell, HostedCell) else load_cell_file(os.fspath(cell))
    keywords["cell"] = file.simulated()
    keywords.setdefault("action_latency_ticks", file.config().latency_ticks)
    return keywords


def _budget_s(env: Any) -> float:
    """Return the part of the action's latency that a policy may use on two controllers."""
    core = env.unwrapped.core
    tick_s: float = core.config.servoj.tick_s
    taken_s = max(_TAKEN_TICKS * tick_s, _TAKEN_S)
    latency_s: float = core.timing.ahead_s - core.timing.period_s
    # An ideal machine has no latency, unlike two controllers.
    return (LATENCY_S if latency_s <= taken_s else latency_s) - taken_s


class _CheckedEpisode:
    """One episode, in which every action is checked.

    Args:
        policy: Policy to check.
        env: A Gymnasium environment.

    Attributes:
        observations, actions: Input and output of the policy in every step.
        taken_s: Time of each action.
        success: True if the task reports success.
        total_reward: Sum of all rewards.
    """

    def __init__(self, policy: Policy, env: Any) -> None:
        self._policy, self._env = policy, env
        self.observations: list[Any] = []
        self.actions: list[Array] = []
        self.taken_s: list[float] = []
        self.success, self.total_reward = False, 0.0

    def run(self, seed: int, most: int) -> None:
        """Run it for at most `most` steps.

        Raises:
            PolicyError: See `check_policy`.
        """
        env = self._env
        check_observation = env.unwrapped.core.check_observation
        observation, _ = env.reset(seed=seed)
        try:
            _reset(self._policy)
            over = False
            while not over and len(self.actions) < most:
                action = self._act(observation)
                observation, reward, terminated, truncated, info = env.step(action)
                check_observation()
                self.total_reward += float(reward)
                for name, text in (("safety", "the safety gate refused it"), ("physics_error", "")):
                    if name in info:
                        raise PolicyError(f"step {len(self.actions) - 1}: {text}{': ' if text else ''}{info[name]}")
                over = terminated or truncated
        except PolicyError as error:
            # Two controllers must not keep moving with it.
            env.unwrapped.core.stop(f"the policy failed: {error}")
            raise
        self.success = bool(info.get("is_success", False))

    def _act(self, observation: Any) -> Array:
        step = len(self.actions)
        shown, kept = _copied(observation), _copied(observation)
        offer_time(self._policy, self._env)
        begin = time.perf_counter()
        given = _call(self._policy, shown, f"step {step}")
        self.taken_s.append(time.perf_counter() - begin)
        if not _equal(shown, kept):
            raise PolicyError(
                f"step {step}: it changed the observation that it received, which others may hold, too: copy it first"
            )
        action = _checked(given, self._env.action_space, f"step {step}")
        self.observations.append(kept)
        self.actions.append(action)
        return action


def _check_again(policy: Policy, episode: _CheckedEpisode) -> None:
    _reset(policy)
    for step, (observation, before) in enumerate(zip(episode.observations, episode.actions, strict=True)):
        if step == _AGAIN:
            return
        again = np.asarray(_call(policy, _copied(observation), f"step {step} after a reset"))
        if again.shape != before.shape or not np.array_equal(again.astype(before.dtype), before):
            away = "of another shape"
            if again.shape == before.shape:
                away = f"other by up to {float(np.abs(again - before).max()):.3g}"
            raise PolicyError(
                f"step {step} after a reset: the action is {away} than before with the same observations: let reset() "
                "forget everything, and sample from a generator that reset() seeds again"
            )


def _check_batch(policy: Policy, env: Any, episode: _CheckedEpisode, seed: int) -> bool:
    """Return True if the policy takes batches, after a check that each row gives the same action as alone."""
    first = [episode.observations[0], env.reset(seed=seed + 1)[0]]
    alone = []
    for observation in first:
        _reset(policy)
        alone.append(_checked(_call(policy, _copied(observation), "a first step"), env.action_space, "a first step"))
    _reset(policy)
    try:
        both = np.asarray(policy(_stacked(first)))
    except Exception:  # a policy of single observations may fail in any way
        return False
    finally:
        _reset(policy)
    if both.shape != (len(first), *env.action_space.shape):
        return False
    away = float(np.abs(both.astype(np.float64) - np.array(alone, dtype=np.float64)).max())
    if not away <= _SAME:
        raise PolicyError(
            f"a row of a batch of observations gets another action than alone, by up to {away:.3g}: let each row's "
            "action follow from that row, or refuse batches with an exception"
        )
    return True


def _checked(given: Any, space: Any, where: str) -> Array:
    """Return a policy's output as an action, or raise PolicyError."""
    try:
        action = np.asarray(given)
    except (TypeError, ValueError) as error:
        raise PolicyError(f"{where}: the action is no array of numbers ({type(given).__name__}: {error})") from None
    if action.dtype.kind not in "fiu":
        raise PolicyError(f"{where}: the action is {action.dtype} from {type(given).__name__}: it must be numbers")
    if action.shape != space.shape:
        raise PolicyError(f"{where}: the action has shape {action.shape}, expected is {space.shape}")
    for text, wrong in (
        ("it must be finite", ~np.isfinite(action)),
        ("", (action < space.low - _OVER) | (action > space.high + _OVER)),
    ):
        if wrong.any():
            number = int(wrong.argmax())
            arm, place = divmod(number, action.size // len(ARMS))
            allowed = text or f"allowed are {space.low[number]:g} to {space.high[number]:g}; it would be clipped"
            raise PolicyError(
                f"{where}: number {number} of the action ({ARMS[arm]} arm, {place}) is {action[number]}: {allowed}"
            )
    result: Array = action.astype(space.dtype)
    return result


def _call(policy: Policy, observation: Any, where: str) -> Any:
    try:
        return policy(observation)
    except Exception as error:
        raise PolicyError(f"{where}: it raised {type(error).__name__}: {error}") from error


def _reset(policy: Policy) -> None:
    try:
        policy.reset()
    except Exception as error:
        raise PolicyError(f"reset() raised {type(error).__name__}: {error}") from error


def _copied(observation: Any) -> Any:
    if isinstance(observation, Mapping):
        return {name: _copied(value) for name, value in observation.items()}
    return np.array(observation)


def _equal(one: Any, other: Any) -> bool:
    if isinstance(other, Mapping):
        return isinstance(one, Mapping) and one.keys() == other.keys() and all(_equal(one[k], other[k]) for k in other)
    same: bool = one.shape == other.shape and one.dtype == other.dtype and one.tobytes() == other.tobytes()
    return same


def _stacked(observations: list[Any]) -> Any:
    if isinstance(observations[0], Mapping):
        return {name: _stacked([each[name] for each in observations]) for name in observations[0]}
    return np.stack(observations)
