"""Measure accuracy and success of the scripted policies in the three tasks, and the computing time of a control cycle.

Sine: 0.1 m at 0.5 Hz for 30 s at 25 Hz, on bases that are not symmetric, with action latency L = 0 unless a row says
otherwise. Flange poses are computed from the joint positions by the package's kinematics. Figures of `nominal` and
`perturbed` are the worst over the axes x, y and z, except for distance and vector, which are those of the run along y,
the line between the flanges, where the distance is most sensitive. `single_arm` is the left arm alone along y, nominal.
Nominal figures are an artefact of an exact model; only perturbed ones mean something. No real arm is in this.

Cycle: inverse kinematics of both arms, adapter and safety gate for one tick of 8 ms, joint_position at 125 Hz.

Carry and handover: see carry.py and handover.py beside this file, which also run alone.
"""

from __future__ import annotations

import os

os.environ["OMP_NUM_THREADS"] = "1"  # before numpy reads it
os.environ["OPENBLAS_NUM_THREADS"] = "1"

import argparse
import json
import time
from dataclasses import asdict, replace
from pathlib import Path

import carry
import handover
import numpy as np

from demo.case import Case, speed_ratio
from demo.sine import ASYMMETRIC_CELL, PERTURBED_CELL, TASK, sine_case
from dual_ur10.assets.settings import HOME_Q_RAD
from dual_ur10.envs.tasks.sine_tracking.settings import SineSettings
from dual_ur10.envs.tasks.sine_tracking.task import SineTracking
from dual_ur10.policies.evaluation.accuracy import accuracy
from dual_ur10.sim2real.control.adapter import ServojAdapter
from dual_ur10.sim2real.control.clearance import Clearance
from dual_ur10.sim2real.control.gate import SafetyGate
from dual_ur10.sim2real.control.pipeline import ServojPipeline
from ur_core import kinematics
from ur_core.kinematics.frames import to_base
from ur_core.kinematics.ur10 import NOMINAL_DH

AXES = ("x", "y", "z")
DURATION_S = 30.0
CALLS = 20_000
WARM_UP = 500
RATE_HZ = 125.0
ALONG_THE_LINE = ("distance_max_mm", "vector_max_mm")


def accuracy_of(case: Case, after_s: float = 0.0) -> dict[str, float]:
    """Return the accuracy of a case."""
    (result,) = TASK.measure(case)
    return asdict(accuracy(result.record, after_s=after_s))


def over_axes(case: Case, after_s: float = 0.0) -> dict[str, float]:
    """Return the figures of a case, worst over the axes; distance and vector along y alone. See the module."""
    figures = {axis: accuracy_of(case.given(axis=axis), after_s) for axis in AXES}
    worst = {name: max(figures[axis][name] for axis in AXES) for name in figures["y"]}
    return {**worst, **{name: figures["y"][name] for name in ALONG_THE_LINE}}


def cycle(calls: int) -> dict[str, float]:
    """Return the time of one control cycle in µs: all of it, and its two parts."""
    config, limits = ASYMMETRIC_CELL, SineTracking.limits
    mounts = (config.left, config.right)
    ticks = config.servoj.ticks_per_action(RATE_HZ)
    adapter = ServojAdapter(config.servoj, limits, ticks, mode="joint_position", dh=[mount.dh for mount in mounts])
    gate = SafetyGate(
        limits, config.servoj.tick_s, ticks, Clearance(config.scene, minimum_m=config.minimum_clearance_m)
    )
    pipeline = ServojPipeline(adapter, gate, held=None)

    settings = SineSettings()
    base_m, from_cell = to_base(mounts)
    times = np.arange(WARM_UP + calls) / RATE_HZ
    along = settings.displacement_m(times, np.zeros(1))[:, None, None] * settings.direction
    world = np.asarray(settings.center_m) + along
    positions = np.einsum("aij,kaj->kai", from_cell, world - base_m)
    down = np.broadcast_to(np.diag([1.0, -1.0, -1.0]), (2, 3, 3)).copy()
    q = kinematics.nearest(positions[0], down, HOME_Q_RAD, NOMINAL_DH)
    pipeline.reset(q[None])

    spent = np.empty((calls, 2))
    for call, position in enumerate(positions):
        begun = time.perf_counter()
        q = kinematics.nearest(position, down, q, NOMINAL_DH)
        solved = time.perf_counter()
        _, refused = pipeline(q)
        done = time.perf_counter()
        if refused:
            raise SystemExit(f"the gate refused the sine: {refused[0]}")
        if call >= WARM_UP:
            spent[call - WARM_UP] = solved - begun, done - solved
    total = 1e6 * spent.sum(axis=1)
    return {
        "p50_us": float(np.percentile(total, 50)),
        "p99_us": float(np.percentile(total, 99)),
        "max_us": float(total.max()),
        "inverse_kinematics_p50_us": 1e6 * float(np.median(spent[:, 0])),
        "adapter_and_gate_p50_us": 1e6 * float(np.median(spent[:, 1])),
        "calls": calls,
    }


def runs(full: bool) -> dict[str, dict[str, float]]:
    """Return the figures of all rows."""
    nominal, perturbed = sine_case("nominal", "nominal"), sine_case("perturbed", "perturbed", PERTURBED_CELL)
    single = sine_case("single", "single", arms="left")
    rows = {"nominal": over_axes(nominal), "perturbed": over_axes(perturbed), "single_arm": accuracy_of(single)}
    if full:
        rows["single_arm_perturbed"] = accuracy_of(single.given(cell=PERTURBED_CELL))
        rows["perturbed_settled"] = over_axes(perturbed, after_s=10.0)
        rows["perturbed_not_learning"] = over_axes(replace(perturbed, learn=False))
        for ticks in (5, 10):
            rows[f"perturbed_latency_{ticks}_ticks"] = over_axes(perturbed.given(action_latency_ticks=ticks))
        rows["lag_not_compensated"] = over_axes(replace(nominal, learn=False).given(compensate_lag=False))
    return rows


def sine_speed_ratio() -> float:
    """Return the largest joint speed over the task's limit, over plants and axes."""
    cells, limits = (ASYMMETRIC_CELL, PERTURBED_CELL), SineTracking.limits
    cases = [sine_case("", "", cell, axis=axis) for cell in cells for axis in AXES]
    records = [TASK.measure(case)[0].record for case in cases]
    return max(speed_ratio(record.q_rad, record.period_s, limits) for record in records)


def main() -> None:
    """Run everything, print a table and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, help="write the figures here")
    parser.add_argument("--full", action="store_true", help="more rows: without learning, with latency, settled, ...")
    parser.add_argument("--calls", type=int, default=CALLS, help="control cycles to time")
    parser.add_argument("--episodes", type=int, default=300, help="episodes of each success rate")
    parser.add_argument("--seeds", type=int, default=carry.SEEDS, help="episodes of each row of the carried bar")
    arguments = parser.parse_args()

    before = os.getloadavg()
    rows = runs(arguments.full)
    timing = cycle(arguments.calls)
    sine_ratio = sine_speed_ratio()

    print("sine, 0.1 m, 0.5 Hz, 30 s, 25 Hz, asymmetric bases; x, y, z, worst (distance, vector: along y); L = 0")
    columns = ("flange max", "RMS mm", "angle °", "distance mm", "vector mm", "ripple mm/s")
    print(f"{'':27}" + "".join(f"{name:>13}" for name in columns))
    for name, row in rows.items():
        values = [*list(row.values())[:5], 1e3 * row["ripple_max_m_s"]]
        print(f"{name:27}" + "".join(f"{value:13.4f}" for value in values))
    print(
        f"cycle of 8 ms, both arms: p50 {timing['p50_us']:.0f} us, p99 {timing['p99_us']:.0f} us, max "
        f"{timing['max_us']:.0f} us (inverse kinematics {timing['inverse_kinematics_p50_us']:.0f} us, adapter and gate "
        f"{timing['adapter_and_gate_p50_us']:.0f} us); {timing['calls']} calls"
    )
    print(f"joint speed at most {100 * sine_ratio:.0f} % of the task's limit, over plants and axes", flush=True)
    carried = carry.run(arguments.seeds, arguments.episodes)
    handed = handover.run(arguments.episodes)
    after = os.getloadavg()
    print(f"load {before[0]:.2f} before, {after[0]:.2f} after, {os.cpu_count()} processors")
    if arguments.json:
        figures = {
            "sine": rows,
            "sine_speed_share": sine_ratio,
            "cycle": timing,
            "carry": carried,
            "handover": handed,
            "settings": {
                "action_latency_ticks": 0,
                "amplitude_m": 0.1,
                "axes": AXES,
                "bases_m": [ASYMMETRIC_CELL.left.position_m, ASYMMETRIC_CELL.right.position_m],
                "distance_and_vector_axis": "y",
                "duration_s": DURATION_S,
                "frequency_hz": 0.5,
                "perturbation": "masses +5 %, friction 5 5 3 1 1 1 N·m, lookahead +5 %, latency 2 ms",
                "policy_rate_hz": 25,
                "cycle_rate_hz": RATE_HZ,
            },
            "load": {"before": before, "after": after, "processors": os.cpu_count()},
        }
        arguments.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
