"""How far nominal arms run past, or stay beside, commands of several kinds, and the adapter's time.

python benchmarks/adapter.py [--rate 25] [--json FILE]

One joint is commanded positions, at the hard limits of a UR10, for CB3 and e-Series controllers with the default
settings of servoj. The arm is the law's response to the targets. All cases are seeded. The time is that of one action
of both arms, in the kernel, for random steps of all joints.

Commands at constant speed that then stop, halve their speed or reverse it are measured at several rates, after motions
of several durations, each beside the least that legal targets allow. That is the optimum of a linear program: the
targets' speed, acceleration and jerk are bounded, the arm is on its command and at its speed when the command changes,
and on the command again at the end, and its largest excursion is minimized. In MuJoCo, a flange is moved by `tcp_delta`
and let go.
"""

import argparse
import json
import os
import time
from functools import cache
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from scipy.optimize import linprog

import dual_ur10  # noqa: F401  # registers the ids
from dual_ur10.assets.settings import HOME_Q_RAD
from dual_ur10.sim2real.control.adapter import TCP_STEP_M_S, ServojAdapter
from dual_ur10.sim2real.control.limits import MotionLimits
from ur_core.kinematics import flange_pose
from ur_core.kinematics.ur10 import NOMINAL_DH
from ur_core.servoj import ServojLaw, ServojProfile

JOINT = 5  # of the left arm: no Cartesian limit binds
RATES_HZ = (12.5, 25.0, 62.5, 125.0)
SPEEDS_RAD_S = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
DURATIONS_S = (0.2, 0.28, 0.4, 0.52, 0.72, 1.0, 1.4)  # at the speed, once the arm is on its command
CHANGES = {"stop": 0.0, "half the speed": 0.5, "reversal": -1.0}


def cases(period_s: float, fastest_rad_s: float) -> dict[str, np.ndarray]:
    """Return commands relative to the start, (n, periods), by kind."""
    rng, number = np.random.default_rng(0), np.arange(1 + round(4.0 / period_s))
    speed = np.concatenate([np.linspace(0.0, 0.1, 201)[1:], np.linspace(0.1, fastest_rad_s, 120)])[:, None]
    tremble = [np.zeros(60)]
    for _ in number[1:]:
        tremble.append(0.0006 * rng.standard_normal(60))
    steps = rng.uniform(-0.1, 0.1, (60, len(number))) * fastest_rad_s * period_s
    return {
        "constant speed from rest": speed * number * period_s,
        "trembling, 0.6 mrad": np.array(tremble).T,
        "random steps of a tenth of full speed": np.cumsum(steps, axis=1) - steps[:, :1],
        "steps of 0.1 to 400 mrad": np.where(number > 4, np.geomspace(1e-4, 0.4, 80)[:, None], 0.0),
        "stop": np.geomspace(1e-3, fastest_rad_s, 80)[:, None] * np.minimum(number, len(number) // 2) * period_s,
    }


def arms(profile: ServojProfile, limits: MotionLimits, ticks: int, commands: np.ndarray) -> np.ndarray:
    """Return the way of the arm at each tick, (n, periods - 1, ticks), relative to the start."""
    n = len(commands)
    adapter = ServojAdapter(profile, limits, ticks, n=n, mode="joint_position", dh=[NOMINAL_DH] * 2)
    start = np.tile(HOME_Q_RAD, (n, 1, 1))
    adapter.reset(start)
    transition = ServojLaw(profile.lookahead_s, profile.gain).transition(profile.tick_s)
    state, way = np.zeros((2, n)), []
    for command in commands[:, 1:].T:
        action = start.copy()
        action[:, 0, JOINT] -= command  # the longer side of its range
        for target in adapter(action).targets_rad[:, :, 0, JOINT].T:
            offset = np.stack([HOME_Q_RAD[0, JOINT] - target, np.zeros(n)])
            state = offset + transition @ (state - offset)
            way.append(state[0])
    return np.stack(way, axis=1).reshape(n, -1, ticks)


def measure(family: str, rate_hz: float) -> dict[str, dict[str, float]]:
    """Return the figures of each kind of commands, in mrad."""
    profile, limits = ServojProfile(family), MotionLimits()
    ticks = profile.ticks_per_action(rate_hz)
    figures = {}
    for kind, commands in cases(ticks * profile.tick_s, min(limits.speed_rad_s)).items():
        way = arms(profile, limits, ticks, commands)
        beside = np.abs(way[:, :, -1] - commands[:, 1:])
        ahead = way - commands[:, 1:, None]
        if kind.startswith(("stop", "steps")):
            beyond = (way - commands[:, -1, None, None]).reshape(len(commands), -1)
            back = [-row[row.argmax() :].min() for row in beyond]
            figures[kind] = {"past": beyond.max(), "back": max(0.0, *back)}
        else:
            figures[kind] = {"past": ahead.max(), "largest": beside.max(), "rms": np.sqrt((beside**2).mean())}
    return {kind: {name: 1e3 * float(value) for name, value in each.items()} for kind, each in figures.items()}


@cache
def least_rad(family: str, speed_rad_s: float, after: float) -> float:
    """Return the least excursion past a command whose speed changes to `after` times what it was.

    NaN: no motion within a second ends on the command.
    """
    profile, limits = ServojProfile(family), MotionLimits()
    tick_s, law = profile.tick_s, ServojLaw(profile.lookahead_s, profile.gain)
    change = speed_rad_s * (1.0 - after)
    n = round((0.3 + 0.45 * change) / tick_s)
    states = law.response(tick_s, n, 1)
    # On a line an arm is `lag_s` behind its targets, and at each tick as fast as `ripple` times the line.
    a = law.transition(tick_s)
    steady = np.array([[1.0 - a[0, 0], a[0, 1]], [-a[1, 0], a[1, 1] - 1.0]])
    lag_s, ripple = np.linalg.solve(steady, [tick_s, 0.0])
    begin = np.array([0.0, ripple * speed_rad_s])
    past = (np.arange(-3, 0) * tick_s + lag_s) * speed_rad_s
    line = after * speed_rad_s * tick_s * np.arange(1, n + 1)
    # Unknown are the targets and the excursion.
    rows, bounds = [], []
    difference = np.eye(3 + n)
    for order, limit in enumerate((min(limits.speed_rad_s), limits.acceleration_rad_s2, limits.jerk_rad_s3), start=1):
        difference = np.diff(difference, axis=0) / tick_s
        known, row = difference[3 - order :, :3] @ past, np.pad(difference[3 - order :, 3:], ((0, 0), (0, 1)))
        rows += [row, -row]
        bounds += [limit - known, limit + known]
    rows.append(np.pad(states[:, 0, 2:], ((0, 0), (0, 1)), constant_values=-1.0))
    bounds.append(line - states[:, 0, :2] @ begin)
    held = np.eye(n, n + 1)[n - 3 :]
    ends = np.vstack([np.pad(states[-1, :, 2:], ((0, 0), (0, 1))), held])
    at_end = np.array([line[-1], ripple * after * speed_rad_s]) - states[-1, :, :2] @ begin
    on_line = after * speed_rad_s * (np.arange(n - 3, n) * tick_s + lag_s)
    found = linprog(
        np.eye(n + 1)[-1],
        A_ub=np.vstack(rows),
        b_ub=np.concatenate(bounds),
        A_eq=ends,
        b_eq=np.concatenate([at_end, on_line]),
        bounds=[(None, None)] * n + [(0.0, None)],
    )
    return float(found.fun) if found.status == 0 else float("nan")


def turns(family: str, rate_hz: float, after: float) -> list[dict[str, float]]:
    """Return how far the arm goes past a command whose speed changes, and past it again, in mrad, for each speed."""
    profile, limits = ServojProfile(family), MotionLimits()
    ticks = profile.ticks_per_action(rate_hz)
    period_s = ticks * profile.tick_s
    number, phase = np.arange(1 + round(4.0 / period_s)), np.arange(1, ticks + 1) / ticks
    figures = []
    for speed in SPEEDS_RAD_S:
        last = [max(2, round((duration + 0.35 * speed) / period_s)) for duration in DURATIONS_S]
        commands = (
            np.array([np.minimum(number, k) + after * np.maximum(number - k, 0) for k in last]) * speed * period_s
        )
        between = commands[:, :-1, None] + np.diff(commands, axis=1)[:, :, None] * phase
        ahead = arms(profile, limits, ticks, commands) - between
        beyond = [row[k:].ravel() for row, k in zip(ahead, last, strict=True)]
        figures.append(
            {
                "speed_rad_s": speed,
                "past": 1e3 * max(float(row.max()) for row in beyond),
                "back": 1e3 * max(0.0, *(float(-row[row.argmax() :].min()) for row in beyond)),
                "least": 1e3 * least_rad(family, speed, after),
            }
        )
    return figures


def flange_past_mm(speed_m_s: float) -> dict[str, float]:
    """Return how far the left flange goes past its release in MuJoCo, in mm, and the least on its straight line."""
    env: Any = gym.make("DualUR10/Free-v0", action_mode="tcp_delta")
    env.reset(seed=0)
    core = env.unwrapped.core
    core.cell.record()
    action = np.zeros((1, 2, core.pipeline.adapter.action_size))
    joints = []
    for period in range(60):
        action[0, 0, 1] = speed_m_s / TCP_STEP_M_S if period < 25 else 0.0  # away from the other arm
        command, _ = core.pipeline(action)
        joints.append(core.cell.advance(command).trace.q_rad[:, 0])
    env.close()
    q_rad = np.concatenate(joints)
    positions = flange_pose(q_rad, NOMINAL_DH)[0]
    begin, end = 20 * len(joints[0]), 25 * len(joints[0]) - 1  # arms that move at constant speed
    along = positions[end] - positions[begin]
    beyond = (positions[end + 1 :] - positions[end]) @ (along / np.linalg.norm(along))
    fastest = float(np.abs(q_rad[end] - q_rad[end - 5]).max()) / (5 * ServojProfile().tick_s)
    return {
        "past": 1e3 * float(beyond.max()),
        "least": 1e3 * speed_m_s * least_rad("cb3", fastest, 0.0) / fastest,
        "back": 1e3 * max(0.0, -float(beyond.min())),
    }


def kernel_us(family: str, rate_hz: float, size: float, n: int = 200) -> float:
    """Return the least time of an action of a cell, µs, over 30 periods of random steps."""
    profile = ServojProfile(family)
    adapter = ServojAdapter(profile, MotionLimits(), profile.ticks_per_action(rate_hz), n=n, dh=[NOMINAL_DH] * 2)
    adapter.reset(np.tile(HOME_Q_RAD, (n, 1, 1)))
    rng, times = np.random.default_rng(0), []
    for _ in range(30):
        action = rng.uniform(-size, size, (n, 2, 6))
        begin = time.perf_counter()
        adapter(action)
        times.append(time.perf_counter() - begin)
    return 1e6 * min(times[6:]) / n


def main() -> None:
    """Measure, print and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rate", type=float, default=25.0, help="actions per second")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    result: dict[str, Any] = {}
    for family in ("cb3", "e-series"):
        figures = measure(family, options.rate)
        figures["time, us"] = {
            f"steps of {size:g}": kernel_us(family, options.rate, size) for size in (0.002, 0.1, 1.0)
        }
        result[family] = figures
        for kind, each in figures.items():
            print(f"{family:9}{kind:40}" + "  ".join(f"{name} {value:.3f}" for name, value in each.items()))
    speeds = ", ".join(f"{1e3 * speed:g}" for speed in SPEEDS_RAD_S)
    print(f"\npast the command / least that legal targets allow, at {speeds} mrad/s")
    stops: list[dict[str, float]] = []
    for change, after in CHANGES.items():
        for family in ("cb3", "e-series"):
            for rate_hz in RATES_HZ:
                rows = turns(family, rate_hz, after)
                result.setdefault("turns", {}).setdefault(change, {}).setdefault(family, {})[f"{rate_hz:g}"] = rows
                stops += rows if change == "stop" else []
                text = "  ".join(f"{row['past']:.2f}/{row['least']:.2f}" for row in rows)
                print(f"{change:16}{family:9}{rate_hz:5g} Hz  {text}  back {max(row['back'] for row in rows):.3f}")
    flange = {f"{1e3 * speed:g}": flange_past_mm(speed) for speed in (0.1, 0.25)}
    for speed, each in flange.items():
        text = "  ".join(f"{name} {value:.2f}" for name, value in each.items())
        print(f"flange let go at {speed} mm/s, mm: {text}")
    result["flange"] = flange
    # Below a tenth of a milliradian a ratio says little.
    result["stop"] = {
        "worst_ratio": max(row["past"] / row["least"] for row in stops if row["least"] > 0.1),
        "worst_extra_mrad": max(row["past"] - 1.3 * row["least"] for row in stops),
        "back_mrad": max(row["back"] for row in stops),
        "flange_past_mm_at_100": flange["100"]["past"],
    }
    print("stop: " + "  ".join(f"{name} {value:.3f}" for name, value in result["stop"].items()))
    print(f"mrad; load {os.getloadavg()[0]:.1f}")
    if options.json:
        options.json.write_text(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
