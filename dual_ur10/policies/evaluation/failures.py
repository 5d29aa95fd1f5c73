"""Videos of the failed episodes of an evaluation: their actions, which are kept, are simulated again."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import gymnasium as gym

from dual_ur10.envs.core.options import AS_ON_CONTROLLERS
from dual_ur10.errors import SettingsError
from dual_ur10.policies.evaluation.film import Film, film, take
from dual_ur10.policies.evaluation.results import EpisodeResult, Evaluation
from ur_core.types import Array

MOST_FILMS: Final = 10
"""Failed episodes that are kept, the first ones to end."""

_SMALL: Final = {"width": 320, "height": 240}  # without a GPU, drawing takes as long as the number of pixels


class FailureKeeper:
    """Actions of the first failed episodes, for `on_episode` of `evaluate`.

    The same actions from the same seed give the same episode, whatever the policy is: one on a server that keeps a
    state, one whose latency is measured, or a person.

    Attributes:
        actions: (k, D) actions by the seed of the episode.
    """

    def __init__(self) -> None:
        self.actions: dict[int, Array] = {}

    def __call__(self, episode: EpisodeResult, actions: Array) -> None:
        """Keep the actions of a failed episode."""
        if not episode.success and len(self.actions) < MOST_FILMS:
            self.actions[episode.seed] = actions

    def film(
        self,
        folder: str | Path,
        found: Evaluation,
        on_ratio: Callable[[float], None] = lambda _: None,
        **view: Any,
    ) -> list[Film]:
        """Write the videos, `SineTracking-v0-17.mp4` of seed 17, in the order of seeds.

        Args:
            folder: Existing folder.
            found: The evaluation, in simulation.
            on_ratio: Callback with the ratio of the work that is done.
            **view: Further arguments of `dual_ur10.policies.evaluation.film.film`, such as `cameras`; the pictures are
                small unless it states their size.

        Raises:
            SettingsError: An episode did not fail again: the environment does not follow from seed and actions.
            DualUR10Error: As raised by `film`.
        """
        films = []
        for number, seed in enumerate(sorted(self.actions)):
            name = f"{found.env_id.partition('/')[2]}-{seed}.mp4"
            films.append(_film(Path(folder) / name, found, seed, self.actions[seed], view))
            on_ratio((number + 1) / len(self.actions))
        return films


def _film(path: Path, found: Evaluation, seed: int, actions: Array, view: Mapping[str, Any]) -> Film:
    keywords = {name: value for name, value in found.kwargs.items() if name != "threads"}
    env = gym.make(found.env_id, disable_env_checker=True, **{**AS_ON_CONTROLLERS, **keywords})
    try:
        shown = take(env, _Played(actions), seed=seed)
    finally:
        env.close()
    if shown.success or len(shown.infos) - 1 != len(actions):
        raise SettingsError(
            f"the episode of {found.env_id} with seed {seed} has not failed again with the same actions: an episode "
            "must follow from its seed alone. `audit` finds what else it depends on"
        )
    title = f"{found.env_id.partition('/')[2]}, {found.policy}, seed {seed}"
    return film(path, shown, title=title, **{**_SMALL, **view})


class _Played:
    """Policy that plays actions, whatever it observes."""

    def __init__(self, actions: Array) -> None:
        self._actions, self._next = actions, 0

    def reset(self) -> None:
        self._next = 0

    def __call__(self, observation: Any) -> Array:
        action: Array = self._actions[min(self._next, len(self._actions) - 1)]
        self._next += 1
        return action
