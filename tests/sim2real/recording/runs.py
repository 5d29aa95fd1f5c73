"""Runs to be written, and arms' memories to be recorded."""

from __future__ import annotations

import math
import time

import numpy as np

from dual_ur10.sim2real.recording.rows import BeginRow, StepRow
from dual_ur10.sim2real.recording.run import Header
from dual_ur10.sim2real.recording.schemas import EPISODE_TOPIC, SENT_COLUMNS, STATE_COLUMNS, STEP_TOPIC
from ur_core.links.arm_status import ROW_SIZE, ArmStatus

TICKS, ACTION, OBSERVATION = 5, 12, 30
SENT_SIZE = sum(size for _, size in SENT_COLUMNS)


def header(**changes):
    values = {
        "env_id": "DualUR10/SineTracking-v0",
        "kwargs": {"cell": "lab.toml", "policy_rate_hz": 25.0},
        "seed": 3,
        "source": "emulated",
        "family": "cb3",
        "tick_s": 0.008,
        "period_ticks": TICKS,
        "latency_ticks": 0,
        "speed_factor": 1.0,
        "mounts": [{"position_m": [0.0, 0.5, 0.0]}, {"position_m": [0.0, -0.5, 0.0]}],
        "servoj": [{"lookahead_s": 0.1, "gain": 300.0}] * 2,
        "versions": {"dual_ur10": "0"},
        "started_utc": "2026-01-31T12:00:00.250000Z",
        "policy": "größer",
        "policy_sha256": None,
        "cell_file": "kind = 'emulated'\n",
        "cell_sha256": "0" * 64,
        "extra": {},
    }
    return Header(**(values | changes))


def state_rows(rng, times):
    rows = rng.normal(size=(len(times), ROW_SIZE))
    rows[:, 0] = times
    rows[:, -10:] = math.nan  # what some controllers do not say
    return rows


def sent_rows(rng, times):
    rows = rng.normal(size=(len(times), SENT_SIZE))
    rows[:, 2] = times
    return rows


def begin_row(rng, **changes):
    values = {
        "seed": 2**70 + 1,
        "q_rad": rng.normal(size=(2, 6)),
        "flange_m": rng.normal(size=(2, 3)),
        "observation": rng.normal(size=OBSERVATION),
        "initial_state": bytes(range(256)),
    }
    return BeginRow(**(values | changes))


def step_row(rng, number, **changes):
    values = {
        "action": rng.normal(size=ACTION).astype(np.float32),
        "targets_rad": rng.normal(size=(TICKS, 2, 6)),
        "gripper_m": rng.normal(size=(TICKS, 2)),
        "gated": number % 3 == 2,
        "reward": float(rng.normal()),
        "terminated": False,
        "truncated": False,
        "success": None,
        "ended_by": "",
        "time_s": 0.04 * (number + 1),
        "q_rad": rng.normal(size=(2, 6)),
        "flange_m": rng.normal(size=(2, 3)),
        "observation": rng.normal(size=OBSERVATION),
        "first_target": TICKS * number,
    }
    return StepRow(**(values | changes))


def write(writer, rng, *, steps=6, episodes=2):
    """Write a run into a writer, and return all that was written."""
    given = {"begins": [], "steps": [], "states": ([], []), "sent": ([], [])}
    now = 0.0
    for episode in range(episodes):
        begin = begin_row(rng)
        writer.single(EPISODE_TOPIC, now, begin.encode(episode, now))
        given["begins"].append((now, begin))
        for number in range(steps):
            times = now + 0.008 * np.arange(1, TICKS + 1)
            for arm in range(2):
                states, sent = state_rows(rng, times), sent_rows(rng, times)
                writer.states(arm, states)
                writer.sent(arm, sent)
                given["states"][arm].append(states)
                given["sent"][arm].append(sent)
            now = float(times[-1])
            last = number == steps - 1
            row = step_row(rng, number, truncated=last, success=True if last else None, ended_by="so" if last else "")
            writer.single(STEP_TOPIC, now, row.encode(episode, number))
            given["steps"].append((episode, row))
            writer.flush()
    return given


def status(number, at_s):
    """The state number `number` of an arm: all its numbers say which it is."""
    values = {name: (float(number),) * 6 for name in _SIXES}
    others = {name: float(number) for name in _ONES}
    return ArmStatus(arrival_s=at_s, timestamp_s=number * 0.002, **values, **others)


_SIXES = [name for name, size in STATE_COLUMNS if size == 6 and name != "tcp_offset"]
_ONES = [name for name, size in STATE_COLUMNS if size == 1 and name not in ("arrival_s", "timestamp_s", "payload_kg")]


def feed(memories, first, count):
    """Put states and targets into memories, as an arm's process does."""
    for number in range(first, first + count):
        now = time.monotonic()
        for memory in memories:
            memory.note_state(status(number, now))
            memory.note_sent(number, float(number), now, 0.0, np.full(6, float(number)))
    return first + count
