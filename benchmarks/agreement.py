"""Success of policies of different quality in simulation and on virtual cells, and the agreement of the two.

Simulation has the randomization "mild", and the latency of two controllers. A virtual cell is new for each episode: its
arms deviate from the nominal model ("mild"), by an amount of its own. Seeds are 0, 1, ... on both sides. The table is
written after every part, so that the command can be stopped and continues where it was. `compare` reads it.

    python benchmarks/agreement.py --csv docs/reference/agreement.csv
    python benchmarks/agreement.py --csv FILE --task Handover --policy script --simulation 20 --cell 1

Policies:
    script, learned: as they come with the package.
    ... noise S: Gaussian noise with this standard deviation on every number of each action, of -1 to 1.
    ... late N: the policy sees the observation of N periods ago, 40 ms each.
    follower: the script with steps of the tools.
    cloning N: behaviour cloning of N episodes of the script, with a quarter of the usual gradient steps.
    chunks S s late: the motion of the script in a nominal simulation of its own, as chunks of 25 actions at 10 Hz that
        come so late; it never looks at what happens.
"""

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import argparse
import csv
import dataclasses
import json
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent))

from dual_ur10.envs.core.setup import EnvSetup
from dual_ur10.errors import CellFaulted, LostError
from dual_ur10.ids import env_id_of
from dual_ur10.policies import evaluate, load
from dual_ur10.policies.chunks.executor import executor_for
from dual_ur10.policies.evaluation.agreement import COLUMNS, MeasuredPolicy, SuccessCount, agreements, read_policies
from dual_ur10.policies.policy import Policy
from dual_ur10.policies.registry import keywords_for
from dual_ur10.policies.scripted.sine_tracking import SineTrackingPolicy
from dual_ur10.policies.training.settings import LATENCY_TICKS, defaults
from dual_ur10.policies.training.train import resume, train
from dual_ur10.testing import VirtualCell
from tests.policies.chunks.planned import Planned

ROOT = Path(__file__).parents[1]
KEYWORDS: dict[str, dict[str, Any]] = {"DualUR10/SineTracking-v0": {"duration_s": 10.0}}
SIMULATED = {"randomization": "mild", "action_latency_ticks": LATENCY_TICKS}
FIT_STEPS = 2000
"""Gradient steps of cloning: few, as of a training that was stopped early."""

PART = 20
"""Simulated episodes after which results are written; those on cells are written one by one."""

Given = dict[str, Any]
"""Keywords of an environment."""


class Worse:
    """Policy that acts as another one on an earlier observation, with noise on its actions.

    A script that has lost the object does nothing for the rest of the episode.

    Args:
        inner: The other policy.
        noise: Standard deviation of the noise.
        late: Periods by which the observation is late.
        seed: Seed of the noise of the first episode.
    """

    def __init__(self, inner: Policy, noise: float, late: int, seed: int) -> None:
        self._inner, self._noise, self._late, self._seed = inner, noise, late, seed
        self._lost = False
        self.reset()

    def reset(self) -> None:
        """Begin an episode."""
        self._inner.reset()
        if isinstance(self._inner, SineTrackingPolicy):  # otherwise noise looks to it like the begin of an episode
            self._inner.teach()
        self._rng, self._seen, self._lost = np.random.default_rng(self._seed), [], False
        self._seed += 1

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Return the action for an observation, or one for each row."""
        self._seen = [*self._seen, observation][-self._late - 1 :]
        try:
            action = self._inner(self._seen[0])
        except LostError:
            self._lost = True
        if self._lost:
            return np.zeros(self._shape, np.float32)
        self._shape = action.shape
        noise = self._rng.normal(0.0, self._noise, action.shape)
        return np.clip(action + noise, -1.0, 1.0).astype(np.float32)


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """Policy that is measured.

    Attributes:
        make: Function from the environment's id, its keywords and the first seed to a policy or its name.
        keywords: Further keywords of the environment.
        batched: It takes the observations of several episodes.
    """

    make: Callable[[str, Given, int], Any]
    keywords: Given = dataclasses.field(default_factory=dict)
    batched: bool = True


def named(name: str, **keywords: Any) -> Candidate:
    """Return a policy of the package."""
    return Candidate(make=lambda env_id, given, seed: name, keywords=keywords)


def worse(name: str, noise: float = 0.0, late: int = 0) -> Candidate:
    """Return a policy of the package with noise on its actions, or on late observations."""

    def made(env_id: str, given: Given, seed: int) -> Policy:
        return Worse(load(name, env_id, **keywords_for(name, env_id, given)), noise, late, seed)

    return Candidate(make=made, batched=name != "scripted")  # of several, one that is lost would end all


def cloning(demonstrations: int) -> Candidate:
    """Return a network that clones so many episodes of the script; it is trained once."""

    def made(env_id: str, given: Given, seed: int) -> str:
        path = ROOT / "out" / "agreement" / f"{env_id.partition('/')[2]}-{demonstrations}"
        if not (path / "policy").exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            changes = {"demonstrations": demonstrations, "fit_steps": FIT_STEPS}
            asked = defaults(env_id, "bc", envs=demonstrations, changes=changes)
            resume(path) if path.exists() else train(asked, path)
        return str(path / "policy")

    return Candidate(make=made)


def chunks(latency_s: float) -> Candidate:
    """Return the script's own motion in chunks."""

    def made(env_id: str, given: Given, seed: int) -> Policy:
        source = Planned(env_id, seed=seed, **KEYWORDS.get(env_id, {}), action_latency_ticks=LATENCY_TICKS)
        return executor_for(source, EnvSetup.resolve(env_id, given), latency_s=latency_s)

    return Candidate(make=made, batched=False)


CANDIDATES: dict[str, dict[str, Candidate]] = {
    "DualUR10/SineTracking-v0": {
        "script": named("scripted"),
        "learned": named("learned"),
        "script, noise 0.02": worse("scripted", noise=0.02),
        "script, noise 0.025": worse("scripted", noise=0.025),
        "script, noise 0.04": worse("scripted", noise=0.04),
        "learned, noise 0.02": worse("learned", noise=0.02),
        "learned, noise 0.025": worse("learned", noise=0.025),
        "learned, late 1": worse("learned", late=1),
        "chunks, 0.08 s late": chunks(0.08),
        "cloning 10": cloning(10),
    },
    "DualUR10/Handover-v0": {
        "script": named("scripted"),
        "learned": named("learned"),
        "follower": named("scripted", action_mode="tcp_delta"),
        "script, noise 0.06": worse("scripted", noise=0.06),
        "script, noise 0.1": worse("scripted", noise=0.1),
        "script, late 2": worse("scripted", late=2),
        "learned, noise 0.03": worse("learned", noise=0.03),
        "learned, noise 0.06": worse("learned", noise=0.06),
        "chunks, 0.08 s late": chunks(0.08),
        "cloning 10": cloning(10),
    },
}


def simulated(env_id: str, candidate: Candidate, seed: int, count: int) -> int:
    """Return the number of successes in so many simulated episodes."""
    given = {**KEYWORDS.get(env_id, {}), **SIMULATED, **candidate.keywords}
    policy, envs = candidate.make(env_id, given, seed), count if candidate.batched else 1
    return evaluate(env_id, policy, episodes=count, seed=seed, num_envs=envs, env_kwargs=given).successes


def on_cell(env_id: str, candidate: Candidate, seed: int) -> int:
    """Return 1 for success in an episode on a virtual cell, else 0; a stop of the arms is a failure."""
    task = env_id.partition("/")[2].partition("-v")[0]
    with VirtualCell(task=task, plant="mild", seed=seed) as cell:
        given = {**KEYWORDS.get(env_id, {}), **candidate.keywords, "cell": cell}
        policy = candidate.make(env_id, given, seed)
        try:
            return evaluate(env_id, policy, episodes=1, seed=seed, num_envs=1, env_kwargs=given).successes
        except CellFaulted as error:
            print(f"{env_id}, seed {seed}: {error}", file=sys.stderr)
            return 0


def added(count: SuccessCount | None, successes: int, episodes: int) -> SuccessCount:
    """Return a count with further episodes."""
    return SuccessCount(successes + (count.successes if count else 0), episodes + (count.episodes if count else 0))


def write(path: Path, rows: dict[tuple[str, str], MeasuredPolicy]) -> None:
    """Write the table."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        for each in rows.values():
            counts = (each.simulation, each.cell)
            writer.writerow([each.task, each.policy, *(k for one in counts for k in (one.successes, one.episodes))])


def main() -> None:
    """Run the measurement from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", action="append", help="Handover or SineTracking; may be repeated")
    parser.add_argument("--policy", action="append", help="one of the policies; may be repeated")
    parser.add_argument("--simulation", type=int, default=40, help="episodes of each policy in simulation")
    parser.add_argument("--cell", type=int, default=8, help="episodes of each policy on virtual cells")
    parser.add_argument("--csv", type=Path, required=True, help="the table, continued if it exists")
    parser.add_argument("--json", type=Path, help="its figures, as `compare` writes them")
    asked = parser.parse_args()
    measured = read_policies(asked.csv) if asked.csv.exists() else []
    rows = {(each.task, each.policy): each for each in measured}
    env_ids = [env_id_of(each) for each in asked.task or CANDIDATES]
    for ratio in (0.5, 1.0):  # all policies with few episodes first
        for env_id in env_ids:
            for name in asked.policy or CANDIDATES[env_id]:
                measure(env_id, name, rows, asked, ratio)
    if asked.json:
        found = [each.as_dict() for each in agreements(list(rows.values()))]
        asked.json.write_text(json.dumps(found, indent=1) + "\n")


def measure(env_id: str, name: str, rows: dict[tuple[str, str], MeasuredPolicy], asked: Any, ratio: float) -> None:
    """Add episodes of a policy to the table, until it has this ratio of those asked for."""
    candidate, task = CANDIDATES[env_id][name], env_id.partition("/")[2].partition("-v")[0]
    row = rows.get((task, name))
    simulation, cell = (row.simulation, row.cell) if row else (None, None)
    while row is None or simulation.episodes < ratio * asked.simulation or cell.episodes < ratio * asked.cell:
        if simulation is None or simulation.episodes < ratio * asked.simulation:
            seed = simulation.episodes if simulation else 0
            count = min(PART, asked.simulation - seed)
            simulation = added(simulation, simulated(env_id, candidate, seed, count), count)
        if cell is None or cell.episodes < ratio * asked.cell:
            cell = added(cell, on_cell(env_id, candidate, cell.episodes if cell else 0), 1)
        row = rows[task, name] = MeasuredPolicy(task, name, simulation, cell)
        write(asked.csv, rows)
    print(f"{task}, {name}: {simulation.successes}/{simulation.episodes}, {cell.successes}/{cell.episodes}", flush=True)


if __name__ == "__main__":
    main()
