"""Chunks of actions: splices under delays and losses, and the error that chunks add to a policy.

python benchmarks/chunks.py [--splices 1000000] [--processes 1] [--episodes 5] [--virtual 3] [--controllers 3,5]
    [--json FILE]

splices: Chunk policies change their mind with each chunk, by up to 50 mrad and 0.1 rad/s in every joint. Their chunks
    are of 10 to 40 actions, 20 to 200 ms apart, as steps or positions. They come 0 to 0.7 s late, one in twenty is
    lost, and some are too late for all of their actions. Every episode of 60 s begins with a first chunk 0.7 s late.
    The targets of adapter and gate, at the limits of SineTracking, are compared with the limits in every period. Ten
    chunks in a row that are too late stop both arms (`given_up`), which then begin again from there.
virtual: The same delays on virtual cells, whose arms lag behind; the chunks are those of the scripted SineTracking.
added_rms_mm: Error of the flanges in SineTracking beyond that of the scripted policy, from its own motion in chunks of
    25 actions at 10 Hz that come 80 to 180 ms late; the largest of the episodes, the wait for the first chunk included.
outsider_rms_mm: The same, but a policy server in another process answers after 80 ms, and the measured time counts.
controllers: The shipped policies of SineTracking and Handover, played by such servers in chunks of 25 actions at 25 Hz,
    on emulated cells in real time.
"""

from __future__ import annotations

import os

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")

import argparse
import contextlib
import json
import multiprocessing
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent))

from dual_ur10.assets.settings import SceneSettings, home_q_rad
from dual_ur10.envs.core.setup import EnvSetup
from dual_ur10.errors import ChunkError
from dual_ur10.policies import make, rollout
from dual_ur10.policies.chunks.executor import ChunkExecutor, executor_for
from dual_ur10.policies.policy import close_policy
from dual_ur10.sim2real.control.gate import SafetyGate
from dual_ur10.sim2real.control.pipeline import ServojPipeline
from dual_ur10.testing import CellForTests, VirtualCell
from tests.policies.chunks.planned import Planned
from ur_core.kinematics.forward import elbow_flange_and_tcp

ENV_ID = "DualUR10/SineTracking-v0"
ROWS, EPISODE_S, LATEST_S, LOST = 16, 60.0, 0.7, 0.05
ROUNDING = 1.0 + 1e-6
LONGER_S = 35.0  # of planned motions, so that the last chunks are whole
WORKER = Path(__file__).parent / "workers" / "chunk_server.py"


class Fickle:
    """Chunk policy that changes its mind with each chunk."""

    def __init__(self, rng: np.random.Generator, home: np.ndarray, speed_rad_s: float) -> None:
        self._rng, self._home, self._speed_rad_s = rng, home, speed_rad_s
        self.reset()

    def reset(self) -> None:
        """Sample the motion, and the form of the chunks."""
        rng = self._rng
        self.dt_s, self.action_mode = float(rng.choice([0.02, 0.05, 0.1, 0.2])), "joint_position"
        if rng.random() < 0.5:
            self.action_mode = "joint_delta"
        self._rate, self._phase = rng.uniform(0.5, 3.0, 12), rng.uniform(0.0, 6.0, 12)

    def chunk(self, observation: np.ndarray, time_s: float) -> np.ndarray:
        """Return a chunk of the motion, away from it by what is sampled."""
        rng = self._rng
        after = self.dt_s * np.arange(int(rng.integers(10, 41)) + 1)[:, None]
        joints = self._home + 0.08 * np.sin(self._rate * (time_s + after) + self._phase)
        joints = joints + rng.uniform(-0.05, 0.05, 12) + rng.uniform(-0.1, 0.1, 12) * np.sin(after)
        if self.action_mode == "joint_position":
            return joints[1:]
        commanded = observation.reshape(2, -1)[:, 12:18].reshape(12)
        return np.diff(np.vstack([commanded, joints[1:]]), axis=0) / (self._speed_rad_s * self.dt_s)


def latency_of(rng: np.random.Generator) -> Any:
    """Return a function that samples delays, the first of which is the largest."""
    first = [LATEST_S]
    return lambda: first.pop() if first else np.inf if rng.random() < LOST else float(rng.uniform(0.0, LATEST_S))


def splice(count: int, seed: int) -> dict[str, int]:
    """Follow so many chunks, and compare all targets with the limits."""
    setup = EnvSetup.resolve(ENV_ID, {})
    gate = SafetyGate(setup.limits, setup.config.servoj.tick_s, setup.ticks, setup.make_clearance(), n=ROWS, threads=1)
    pipeline = ServojPipeline(setup.make_adapter(ROWS, 1), gate, held=None)
    home = home_q_rad(SceneSettings().mounts)
    limits, period_s, tick_s = setup.limits, setup.timing.period_s, setup.config.servoj.tick_s
    caps = np.array([*limits.speed_rad_s, limits.acceleration_rad_s2, limits.jerk_rad_s3])
    found = dict.fromkeys(("splices", "late", "given_up", "periods", "above_caps", "refused", "led"), 0)

    def acted(executor: ChunkExecutor, observation: np.ndarray) -> np.ndarray:
        try:
            return executor(observation)
        except ChunkError:  # both arms have come to rest
            executor.reset()
            found["given_up"] += 1
            return np.zeros(12, dtype=np.float32)

    episode = 0
    while found["splices"] < count:
        rngs = [np.random.default_rng([seed, episode, row]) for row in range(ROWS)]
        executors = [
            ChunkExecutor(
                Fickle(rng, home.reshape(12), limits.speed_rad_s[0]),
                timing=setup.timing,
                limits=setup.step_limits,
                latency_s=latency_of(rng),
                replan_s=0.0,
            )
            for rng in rngs
        ]
        pipeline.reset(np.tile(home, (ROWS, 1, 1)))
        window = np.tile(home, (ROWS, 3, 1, 1))
        for step in range(round(EPISODE_S / period_s)):
            commanded = pipeline.adapter.commanded_q_rad
            observations = np.concatenate([np.zeros((ROWS, 2, 12)), commanded, np.zeros((ROWS, 2, 7))], axis=2)
            for executor in executors:
                executor.observed_at(np.array([step * period_s]))
            actions = [acted(each, one.reshape(-1)) for each, one in zip(executors, observations, strict=True)]
            command, verdicts = pipeline(np.array(actions))
            window = np.concatenate([window, command.targets_rad], axis=1)
            rates = [np.abs(np.diff(window, k, axis=1)[:, 3 - k :]) / tick_s**k for k in (1, 2, 3)]
            fast = (rates[0] > caps[:6] * ROUNDING).any(axis=(1, 2, 3))
            for rate, cap in zip(rates[1:], caps[6:], strict=True):
                fast |= (rate > cap * ROUNDING).any(axis=(1, 2, 3))
            points = elbow_flange_and_tcp(window[:, 2:], limits.tcp_m, limits.robots)
            speed = np.linalg.norm(np.diff(points, axis=1), axis=-1) / tick_s
            fast |= (speed > limits.tcp_speed_m_s * ROUNDING).any(axis=(1, 2, 3))
            window = window[:, -3:]
            found["periods"] += ROWS
            found["above_caps"] += int(fast.sum())
            found["refused"] += len(verdicts)
            found["led"] += int(pipeline.led.sum())
        found["splices"] += sum(each.splices for each in executors)
        found["late"] += sum(each.late for each in executors)
        episode += 1
    return found


def virtual(episodes: int) -> dict[str, int]:
    """Run SineTracking with chunks under the same delays on virtual cells."""
    found = dict.fromkeys(("episodes", "splices", "refused", "late_actions"), 0)
    for seed in range(episodes):
        with VirtualCell(task="SineTracking") as cell:
            env = cell.make(ENV_ID)
            source = Planned(ENV_ID, seed=seed, duration_s=LONGER_S)
            rng = np.random.default_rng(seed)
            executor = executor_for(source, env.unwrapped.core.setup, latency_s=latency_of(rng), replan_s=0.0)
            record = rollout(env, executor, seed=seed)
            found["episodes"] += 1
            found["splices"] += executor.splices
            found["refused"] += bool(record.ended_by)
            found["late_actions"] += env.unwrapped.core.late_actions
    return found


@contextlib.contextmanager
def served(env_id: str, policy: str, seed: int, latency_s: float, rate_hz: float) -> Iterator[str]:
    """Serve a shipped policy's episodes in chunks from another process, and yield the name of the policy."""
    words = [sys.executable, str(WORKER), env_id, policy, str(seed), str(latency_s), "25", str(rate_hz)]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None  # noqa: S101  # it is a pipe
            yield f"remote:{process.stdout.readline().strip()}"
        finally:
            process.kill()


def rms_mm(policy: Any, seed: int, latency: Any = None) -> float:
    """Return the larger error of both flanges in an episode that succeeds; otherwise NaN."""
    env, actor = make(policy, ENV_ID)
    if latency is not None:
        actor.latency_s = latency
    record = rollout(env, actor, seed=seed)
    env.close()
    close_policy(actor)
    return float(1e3 * np.sqrt((record.flange_error_m**2).mean(axis=0)).max()) if record.success else float("nan")


def jitter_of(rng: np.random.Generator) -> Any:
    """Return a function that samples delays of 80 to 180 ms."""
    return lambda: float(rng.uniform(0.08, 0.18))


def added_rms_mm(episodes: int) -> tuple[float, float]:
    """Return the largest errors beyond those of the script, with jitter and from another process."""
    jittered, far = [], []
    for seed in range(episodes):
        own = rms_mm("scripted", seed)
        jittered.append(
            rms_mm(Planned(ENV_ID, seed=seed, duration_s=LONGER_S), seed, jitter_of(np.random.default_rng(seed))) - own
        )
        with served(ENV_ID, "scripted", seed, 0.08, 10.0) as name:
            far.append(rms_mm(name, seed) - own)
    return float(np.max(jittered)), float(np.max(far))


def controllers(counts: Sequence[int]) -> dict[str, Any]:
    """Run the shipped policies as chunk servers 80 ms away on emulated cells."""
    found: dict[str, Any] = {}
    for env_id, count in zip((ENV_ID, "DualUR10/Handover-v0"), counts, strict=True):
        successes, splices, late = 0, 0, 0
        for seed in range(count):
            with (
                tempfile.TemporaryDirectory() as folder,
                CellForTests(Path(folder), task=env_id) as cell,
                served(env_id, "learned", seed, 0.08, 25.0) as name,
            ):
                env, actor = make(name, env_id, cell=cell.path)
                try:
                    successes += rollout(env, actor, seed=seed).success
                    splices += actor.splices
                    late += env.unwrapped.core.late_actions
                finally:
                    env.close()
                    close_policy(actor)
        found[env_id] = {"successes": successes, "episodes": count, "splices": splices, "late_actions": late}
    return found


def main() -> None:
    """Measure, and print JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--splices", type=int, default=1_000_000)
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--episodes", type=int, default=5)
    parser.add_argument("--virtual", type=int, default=3)
    parser.add_argument("--controllers", default="3,5", help="episodes of SineTracking and Handover in real time")
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    found: dict[str, Any] = {}
    if asked.splices:
        began_s = time.perf_counter()
        shares = [(-(-asked.splices // asked.processes), seed) for seed in range(asked.processes)]
        with multiprocessing.get_context("spawn").Pool(asked.processes) as pool:
            parts = pool.starmap(splice, shares)
        found = {name: sum(part[name] for part in parts) for name in parts[0]}
        found["minutes"] = (time.perf_counter() - began_s) / 60.0
    if asked.virtual:
        found["virtual"] = virtual(asked.virtual)
    if asked.episodes:
        found["added_rms_mm"], found["outsider_rms_mm"] = added_rms_mm(asked.episodes)
    if any(counts := [int(each) for each in asked.controllers.split(",")]):
        found["controllers"] = controllers(counts)
    text = json.dumps(found, indent=1)
    print(text)
    if asked.json is not None:
        asked.json.write_text(text + "\n")


if __name__ == "__main__":
    main()
