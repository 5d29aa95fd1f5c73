"""Success rates of the learned policies that come with the package.

python benchmarks/learning.py [--episodes 300] [--randomization mild,none] [--tasks SineTracking] [--json FILE]

Seeds begin at 0; trainings use other seeds to learn and to check their progress. The intervals are
Wilson's, of 95 %. On the emulated cell: `python -m dual_ur10 evaluate ENV --policy learned --cell FILE`.
"""

import argparse
import json
import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import time
from pathlib import Path

import numpy as np

import dual_ur10
from dual_ur10.policies import evaluate
from dual_ur10.policies.evaluation.results import Evaluation
from dual_ur10.policies.learned.checkpoint import read_manifest
from dual_ur10.policies.registry import shipped_folder, shipped_names


def main() -> None:
    """Evaluate and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=300)
    parser.add_argument("--randomization", default="mild,none", help="presets, with commas between them")
    parser.add_argument("--tasks", default="", help="names, with commas between them; all without")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    print(f"load {os.getloadavg()[0]:.2f}")
    results: dict[str, dict[str, object]] = {}
    for env_id in dual_ur10.ENV_IDS:
        task = env_id.split("/")[1]
        if args.tasks and task.rsplit("-v", 1)[0] not in args.tasks.split(","):
            continue
        for name in shipped_names(env_id):
            folder = shipped_folder(name, env_id)
            signature = read_manifest(folder).signature
            for preset in args.randomization.split(","):
                own = {key: value for key, value in signature.kwargs.items() if key != "randomization"}
                begin = time.monotonic()
                found = evaluate(
                    env_id,
                    str(folder),
                    episodes=args.episodes,
                    num_envs=64,
                    env_kwargs={**own, "action_latency_ticks": signature.rate.latency_ticks, "randomization": preset},
                )
                low, high = found.interval
                row: dict[str, object] = {
                    "success": found.success_rate,
                    "low": low,
                    "high": high,
                    "episodes": args.episodes,
                    "median_time_s": found.median_time_s,
                }
                if found.episodes[0].last.get("flange_rms_m/left") is not None:
                    row["rms_mm"] = rms_mm(found)
                key = task if name == "learned" else f"{task}/{name}"
                results[key if preset == "mild" else f"{key}/{preset}"] = row
                text = f", flange RMS {row['rms_mm']:.2f} mm" if "rms_mm" in row else ""
                print(
                    f"{key:40} {preset:6} {found.successes:4} of {args.episodes} "
                    f"({100 * low:.1f} to {100 * high:.1f} %){text}, {time.monotonic() - begin:.0f} s"
                )
    if args.json is not None:
        args.json.write_text(json.dumps(results, indent=1) + "\n")


def rms_mm(found: Evaluation) -> float:
    """Return the RMS error of both flanges in mm, over all steps of all episodes."""
    values = [each.last[f"flange_rms_m/{arm}"] or 0.0 for each in found.episodes for arm in ("left", "right")]
    return 1e3 * float(np.sqrt(np.mean(np.square(values))))


if __name__ == "__main__":
    main()
