"""Human-gated DAgger: a policy leads, a person takes over where it errs, and a network learns from what the person did.

HG-DAgger: M. Kelly et al., "HG-DAgger: Interactive Imitation Learning with Human Experts", ICRA 2019.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import gymnasium as gym
import numpy as np

from dual_ur10.envs.core.options import AS_ON_CONTROLLERS
from dual_ur10.envs.rendering.live.buttons import EPISODES, TAKES
from dual_ur10.errors import TrainingError
from dual_ur10.policies.learned.learned_policy import LearnedPolicy
from dual_ur10.policies.operators.catalog import load_operator
from dual_ur10.policies.operators.operator import Operator
from dual_ur10.policies.operators.takeover import Takeover
from dual_ur10.policies.policy import Policy
from dual_ur10.policies.training.dataset import read_dataset
from dual_ur10.policies.training.demonstrations import Demonstration, demonstrate, kept_of, runs_in
from dual_ur10.policies.training.folder import initial_policy
from dual_ur10.policies.training.gather import Samples
from dual_ur10.policies.training.imitation import Imitator
from dual_ur10.policies.training.settings import Training, first_seed_of
from dual_ur10.sim2real.recording.reader import read_run
from ur_core.types import Mask, Single

_RECORDS: Final = "episodes"  # folder of the runs
_WRONG_S: Final = 1.0  # time before a takeover in which the policy was wrong: as long as a person takes to see it


@dataclass(frozen=True)
class Person:
    """Person who corrects a policy.

    Attributes:
        operator: Operator with the person's device.
        shown: Function from an environment to the same one as the person sees it.
        tell: Function that is given what has changed, in words.
        on_end: Function that is given the end of each episode.
        wait: Sleep between two readings of the device, while nothing moves.
    """

    operator: Operator
    shown: Callable[[Any], Any] = lambda env: env
    tell: Callable[[str], None] = lambda text: None
    on_end: Callable[[Demonstration], None] = lambda demonstration: None
    wait: Callable[[float], None] = time.sleep


Meet = Callable[[Training], Person]


def meet(training: Training) -> Person:
    """Return the person with the device of a training, in the time of day.

    Raises:
        DualUR10Error: The device cannot be opened, or a value is not legal.
    """
    return Person(
        load_operator(
            training.operator,
            training.env_id,
            training.keywords,
            paced=True,
            keys=True,
            buttons=(*TAKES, *EPISODES),
        )
    )


class CorrectedImitator(Imitator):
    """Learner of a person's corrections.

    A policy leads episodes, of which the person takes one arm or both at any time, and keeps or discards them as
    `demonstrate` says. All are recorded in the folder of the training, so that whatever was kept is there after an
    interruption and after a crash. After some kept ones a network is fitted to the dataset, if there is one, and to
    those steps of kept episodes in which the person commanded an arm. Without a dataset, the steps that the person left
    to the policy count, too, with the actions that it took, but for the last second before a takeover: a network that
    sees corrections alone forgets the rest.

    Args:
        person: The person.
        *args: As for `Imitator`.
    """

    def __init__(self, person: Person, *args: Any) -> None:
        super().__init__(*args)
        self._person = person
        self._root = self._folder.path / _RECORDS
        rate = self._view.signature.rate
        self._wrong = round(_WRONG_S / (rate.tick_s * rate.period_ticks))
        self._begun = 0  # episodes so far, also discarded ones
        self._progress.steps = 0
        for folder in runs_in(self._root):
            self._take(folder)

    def run(self) -> Path:
        """Train, and return the folder of the resulting checkpoint.

        Raises:
            TrainingError: Something cannot be saved, or nothing was kept.
            DatasetError: The dataset cannot be read or is of another environment.
            DeviceError: One of its kinds: the device is gone, silent, or not understood.
            RecordingError: An episode cannot be recorded or read.
            KeyboardInterrupt: The training was interrupted. What was kept is recorded.
        """
        begun = time.monotonic() - self._folder.seconds
        if self._asked.dataset and not self._rounds:
            self._add(read_dataset(self._asked.dataset, self._view), begun)
        corrected = self._begun > 0 and bool(self._samples)
        first = self._asked.init and not corrected
        policy = initial_policy(self._asked, self._view) if first else self._fitted(begun)
        while not self._has_all:
            self._lead(policy)
            policy = self._fitted(begun)
        if self._folder.best is None:
            raise TrainingError(
                f"nothing was kept in {self._progress.steps} steps: there is nothing to learn from. Continue with "
                "--resume and more --steps"
            )
        return self._folder.finish()

    def _fitted(self, begun: float) -> LearnedPolicy:
        policy = self._fit(self._begun, begun)
        self._save(begun)
        return policy

    def _lead(self, policy: Policy) -> None:
        """Let the person correct a policy until some episodes are kept."""
        person, asked = self._person, self._asked
        self._progress.doing = "led by the policy and a person"
        self._on_progress(self._progress)
        about = {"policy": f"a training, takeover {asked.operator}"}
        before = runs_in(self._root)
        keywords = {**AS_ON_CONTROLLERS, **asked.keywords, "record": str(self._root), "record_about": about}
        env = gym.make(asked.env_id, **keywords)
        try:
            demonstrate(
                person.shown(env),
                Takeover(policy, person.operator, tell=person.tell),
                episodes=self._settings.corrected,
                seed=first_seed_of(asked.seed) + self._begun,
                on_end=person.on_end,
                wait=person.wait,
            )
        finally:
            env.close()
        for folder in sorted({*runs_in(self._root)} - {*before}):
            self._take(folder)

    def _take(self, folder: Path) -> None:
        """Take the samples of a run."""
        run = read_run(folder, allow_partial=True)
        self._begun += len(run.episodes)
        self._progress.steps += sum(len(each.reward) for each in run.episodes)
        for episode in kept_of(run).episodes:
            self._longest = max(self._longest, len(episode.reward))
            by_person: Mask = np.zeros(len(episode.reward), dtype=bool)
            if episode.commander is not None:
                by_person = episode.commander[:, 0] | episode.commander[:, 1]
            rows = by_person if self._asked.dataset else by_person | ~_before(by_person, self._wrong)
            if episode.observation is not None and rows.any():
                seen = episode.observation[:-1].reshape(len(rows), -1)
                number = np.full(int(rows.sum()), episode.number, dtype=np.int64)
                self._samples.append(Samples(_single(seen[rows]), _single(episode.action[rows]), number))


def _before(by_person: Mask, count: int) -> Mask:
    """Return a mask of the steps that are up to so many before one of the person."""
    padded = np.concatenate([by_person, np.zeros(count, dtype=bool)])
    windows = np.lib.stride_tricks.sliding_window_view(padded, count + 1)
    found: Mask = windows.sum(axis=1) > 0
    return found


def _single(values: Any) -> Single:
    return np.ascontiguousarray(values, dtype=np.float32)
