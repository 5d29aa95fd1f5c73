"""Synthetic runs of known content."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dual_ur10.sim2real.recording.run import ArmLog, Episode, Header, Run
from ur_core.kinematics.ur10 import NOMINAL_DH
from ur_core.servoj import ServojLaw

Array = NDArray[np.float64]

START = np.array([0.1, -1.7, 2.0, -1.9, -1.5, 0.2])
DH = {name: list(getattr(NOMINAL_DH, name)) for name in ("a_m", "d_m", "alpha_rad", "theta_rad")}
PARTS = 8  # of a tick, in which the law is simulated


def header(**values: Any) -> Header:
    given: dict[str, Any] = {
        "env_id": "DualUR10/SineTracking-v0",
        "kwargs": {},
        "seed": 3,
        "source": "mujoco",
        "family": "cb3",
        "tick_s": 0.008,
        "period_ticks": 5,
        "latency_ticks": 0,
        "speed_factor": 1.0,
        "mounts": [{"position_m": [-0.75, y, 0.0], "yaw_rad": 0.0, "dh": DH} for y in (0.6, -0.6)],
        "servoj": [{"lookahead_s": 0.03, "gain": 2000.0}] * 2,
        "versions": {"dual_ur10": "0.1.0"},
        "started_utc": "2026-11-21T10:00:00Z",
        "policy": "scripted",
        "policy_sha256": None,
        "cell_file": None,
        "cell_sha256": None,
        "extra": {},
    }
    return Header(**{**given, **values})


def motion(count: int, tick_s: float, size: float = 0.1) -> Array:
    """(count, 2, 6) targets from rest: sines that differ from joint to joint."""
    times = np.arange(count)[:, None] * tick_s
    phase = np.arange(12) * 0.7
    fade = np.minimum(times / 1.5, 1.0)
    soft = fade**3 * (10 - 15 * fade + 6 * fade**2)
    moves = size * soft * (np.sin(np.pi * times + phase) - np.sin(phase))
    return np.tile(START, 2).reshape(1, 2, 6) + moves.reshape(count, 2, 6)


def response(targets: Array, lookahead_s: float, gain: float, tick_s: float, delay_parts: int) -> Array:
    """(ticks + 1, 6) joints that follow the law; each target acts `delay_parts` parts of a tick late."""
    law = ServojLaw(lookahead_s, gain)
    ticks, parts = divmod(delay_parts, PARTS)
    before, after = (law.transition(tick_s * each / PARTS) for each in (parts, PARTS - parts))
    held = np.zeros((len(targets) + 1, 2, 6))
    held[:, 0] = np.concatenate([np.repeat(targets[:1], ticks + 1, axis=0), targets])[: len(held)]
    rows = [held[0]]
    for old, new in itertools.pairwise(held):  # in each tick, the old target acts for some parts
        rows.append(after @ (before @ (rows[-1] - old) + old - new) + new)
    return np.array(rows)[:, 0]


def run(
    seconds: float = 6.0,
    *,
    episodes: int = 1,
    lookahead_s: tuple[float, float] = (0.03, 0.03),
    delay_parts: tuple[int, int] = (0, 0),
    noise_rad: float = 0.0,
    size: float = 0.1,
    first_index: int = 0,
    slower: float = 1.0,
    seed: int = 0,
    offset_rad: float = 0.0,
    **values: Any,
) -> Run:
    """A run that repeats one motion `episodes` times.

    Args:
        slower: Factor by which the cell is slower than the task; targets then lie between two ticks.
    """
    head, rng = header(**values), np.random.default_rng(seed)
    tick_s, ticks, late = head.tick_s, head.period_ticks, head.latency_ticks
    steps = round(seconds / tick_s / ticks)
    count = steps * ticks
    out = motion(count, tick_s, size)
    wire = np.concatenate([np.repeat(out[:1], late, axis=0), out])[:count]
    sends = int((count - 1) / slower) + 1
    index = np.arange(sends) * slower
    targets = wire[:, :, :]
    if slower != 1.0:
        flat = wire.reshape(count, 12)
        targets = np.stack([np.interp(index, np.arange(count), each) for each in flat.T], 1).reshape(-1, 2, 6)
    length_s = (sends + 50) * tick_s
    arms = []
    for arm in range(2):
        state: dict[str, list[Array]] = {name: [] for name in ("arrival_s", "timestamp_s", "q_rad", "target_q_rad")}
        sent: dict[str, list[Array]] = {name: [] for name in ("period", "index", "sent_s", "late_s", "target_rad")}
        path = response(targets[:, arm], lookahead_s[arm], head.servoj[arm]["gain"], tick_s, delay_parts[arm])
        for number in range(episodes):
            begin = 1.0 + number * length_s
            state["arrival_s"].append(begin + np.arange(sends + 1) * tick_s)
            state["timestamp_s"].append(500.0 + begin + np.arange(sends + 1) * tick_s)
            state["q_rad"].append(path + offset_rad + noise_rad * rng.standard_normal(path.shape))
            state["target_q_rad"].append(path)
            sent["period"].append(np.arange(sends) + 0.0)
            sent["index"].append(first_index + index)
            sent["sent_s"].append(begin + np.arange(sends) * tick_s)
            sent["late_s"].append(np.zeros(sends))
            sent["target_rad"].append(targets[:, arm])
        arms.append(ArmLog(*({name: np.concatenate(each) for name, each in log.items()} for log in (state, sent))))
    every = np.concatenate([np.arange(0, sends, max(1, round(ticks / slower))), [sends]])[: steps + 1]
    made = [
        Episode(
            seed=3 if number == 0 else None,
            number=number,
            begin_s=1.0 + number * length_s,
            action=np.zeros((steps, 12), dtype=np.float32),
            targets_rad=out.reshape(steps, ticks, 2, 6),
            gripper_m=None,
            gated=np.zeros(steps, dtype=bool),
            reward=np.zeros(steps),
            terminated=np.zeros(steps, dtype=bool),
            truncated=np.arange(steps) == steps - 1,
            success=True,
            ended_by="",
            observation=None,
            time_s=np.arange(1, steps + 1) * ticks * tick_s,
            q_rad=np.stack([each.state["q_rad"][number * (sends + 1) + every] for each in arms], axis=1),
            flange_m=np.zeros((steps + 1, 2, 3)),
            initial_state=None,
            first_target=first_index + late + ticks * np.arange(steps),
        )
        for number in range(episodes)
    ]
    return Run(head, (arms[0], arms[1]), made, [], True)


def with_arm(made: Run, arm: int, **logs: dict[str, Array]) -> Run:
    """The same run with values of an arm's logs replaced: `state={"q_rad": ...}`, `sent={...}`."""
    arms = list(made.arms)
    arms[arm] = ArmLog(
        {**arms[arm].state, **logs.get("state", {})},
        {**arms[arm].sent, **logs.get("sent", {})},
    )
    return replace(made, arms=(arms[0], arms[1]))


def with_stops(
    seconds: float = 6.0,
    *,
    at: tuple[int, ...] = (40,),
    pause: int = 60,
    sent_later_s: float = 0.0,
    first_index: int = 4711,
    **values: Any,
) -> Run:
    """The motion of `run` where some actions missed their deadline: both arms then stand for `pause` targets.

    Args:
        at: These steps.
        sent_later_s: Delay of the right arm's targets.
    """
    head = header(source="emulated", **values)
    tick_s, ticks, late = head.tick_s, head.period_ticks, head.latency_ticks
    steps = round(seconds / tick_s / ticks)
    out = motion(steps * ticks, tick_s).reshape(steps, ticks, 2, 6)
    wire, begins = [out[0, :1][:0], *[out[0, :1]] * late], []
    for step in range(steps):
        begins.append(-1 if step in at else first_index + sum(map(len, wire)))
        last = np.concatenate([out[0, :1], *wire])[-1:]
        wire.append(np.repeat(last, pause, axis=0) if step in at else out[step])
    targets = np.concatenate(wire)
    sends = len(targets)
    arms = []
    for arm in range(2):
        path = response(targets[:, arm], 0.03, head.servoj[arm]["gain"], tick_s, 0)
        times = 1.0 + np.arange(sends) * tick_s
        state = {"arrival_s": np.append(times, times[-1] + tick_s), "q_rad": path, "target_q_rad": path}
        sent = {
            "period": np.arange(sends) + 0.0,
            "index": first_index + np.arange(sends) + 0.0,
            "sent_s": times + arm * sent_later_s,
            "late_s": np.zeros(sends),
            "target_rad": targets[:, arm],
        }
        arms.append(ArmLog({**state, "timestamp_s": 500.0 + state["arrival_s"]}, sent))
    plain = run(seconds, **values).episodes[0]
    episode = replace(plain, first_target=np.array(begins))
    return Run(head, (arms[0], arms[1]), [episode], [], True)
