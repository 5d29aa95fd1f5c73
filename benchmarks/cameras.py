"""Cameras of a cell: late periods beside three that record, errors of frame times, emulated and simulated images.

late: Periods of a scripted policy on two emulated controllers in real time, interleaved: stretches without cameras,
and with three of 640 × 480 at 30 Hz that write H.264.
times: Times in the videos of such cameras against the clock in their images.
images: A scripted Handover on a virtual cell. Each observed image is compared with one drawn of the measured state.

    python benchmarks/cameras.py --json out/cameras.json
    python benchmarks/cameras.py --parts times,images
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path

import mujoco
import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import live_page

from dual_ur10 import policies
from dual_ur10.assets.scene import build_model
from dual_ur10.cli.session import make
from dual_ur10.envs.rendering.images import Canvas
from dual_ur10.errors import CellFaulted
from dual_ur10.sim2real.cameras.camera_record import CameraRecord
from dual_ur10.sim2real.cameras.pattern_camera import pattern_time_s
from dual_ur10.sim2real.cameras.video_record import read_video, video_name
from dual_ur10.sim2real.cell_file.cell_file import load_cell_file
from dual_ur10.sim2real.cell_file.tables import PatternCameraEntry
from dual_ur10.testing import CellForTests, VirtualCell
from ur_core.processes.system import LOCAL

CAMERAS = tuple(PatternCameraEntry(name=name, rate_hz=30.0) for name in ("front", "side", "overhead"))
SIZE = 96, 128  # height and width of compared images
START_S = 30.0


def recording(file, folder):
    """Return the record of three cameras, once all of them write."""
    record = CameraRecord(file.replace(camera=CAMERAS), None, folder, LOCAL.clock.now_s(), lambda *_: None)
    end_s = LOCAL.clock.now_s() + START_S
    while not all((folder / video_name(each.name)).is_file() for each in CAMERAS):
        if LOCAL.clock.now_s() > end_s:
            raise SystemExit("the cameras did not start")
        time.sleep(0.05)
    return record


def late(seconds, stretches):
    """Return late and all periods without and with cameras, and the number of pairs that were given up."""
    found, given_up = {False: [], True: []}, 0
    while len(found[True]) < stretches and given_up < stretches:
        with tempfile.TemporaryDirectory() as folder, CellForTests(Path(folder), task="SineTracking") as cell:
            file = load_cell_file(cell.path)
            env, policy = make("SineTracking", "scripted", {"cell": str(cell.path)}, 0)
            try:
                first = True
                while len(found[True]) < stretches:
                    without = live_page.stretch(env, policy, seconds, first=first)
                    first = False
                    with recording(file, Path(folder)):
                        beside = live_page.stretch(env, policy, seconds, first=False)
                    found[False].append(without)
                    found[True].append(beside)
                    print(f"late without {without}, with {beside}, {live_page.load()}", flush=True)
            except CellFaulted as error:
                given_up += 1
                print(f"{live_page.load()}: {error}", flush=True)
            finally:
                env.close()
    if not found[True]:
        raise SystemExit("the machine is too busy for two streaming arms")
    (count, periods), (beside, all_beside) = (np.sum(found[each], axis=0).tolist() for each in (False, True))
    return {
        "late": [count, beside],
        "periods": [periods, all_beside],
        "late_extra": round(beside / max(1, all_beside) - count / max(1, periods), 5),
        "given_up": given_up,
        "load": live_page.load(),
    }


def times(seconds):
    """Return the largest error of a time in the videos of three cameras, ms."""
    with tempfile.TemporaryDirectory() as folder, VirtualCell() as cell:
        begin_s = LOCAL.clock.now_s()
        with CameraRecord(cell.file.replace(camera=CAMERAS), None, Path(folder), begin_s, lambda *_: None):
            time.sleep(seconds)
        errors, count = [0.0], 0
        for entry in CAMERAS:
            for time_s, image in read_video(Path(folder) / video_name(entry.name)):
                errors.append(abs(pattern_time_s(image) - begin_s - time_s))
                count += 1
    return {"frame_time_error_ms": round(1e3 * max(errors), 4), "frames": count}


def images():
    """Return the mean difference of observed images from those drawn of the measured state, by camera."""
    cameras = ("front", "left/wrist")
    keywords = {"observation": "both", "cameras": cameras, "height": SIZE[0], "width": SIZE[1]}
    with VirtualCell(task="Handover", plant="nominal") as cell:
        env, policy = policies.make("scripted", "DualUR10/Handover-v0", cell=cell, **keywords)
        core = env.unwrapped.core
        model = build_model(core.config.scene)
        data, canvas = mujoco.MjData(model), Canvas(model, SIZE[1], SIZE[0])
        differences = {name: [] for name in cameras}
        observation, info = env.reset(seed=0)
        policy.reset()
        over = False
        while not over:
            core.copy_state(0, model, data)
            mujoco.mj_kinematics(model, data)
            mujoco.mj_camlight(model, data)
            for name, found in differences.items():
                image = observation["pixels"][name].astype(int)
                found.append(float(np.abs(image - canvas.image(data, name)).mean()))
            observation, _, terminated, truncated, info = env.step(policy(observation["state"]))
            over = terminated or truncated
        canvas.close()
        env.close()
    means = {name: round(float(np.mean(found)), 3) for name, found in differences.items()}
    return {
        "sim_emulated_diff": max(means.values()),
        "diff_by_camera": means,
        "steps": len(differences["front"]),
        "success": bool(info["is_success"]),
    }


def main():
    """Measure, print and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", default="late,times,images")
    parser.add_argument("--seconds", type=float, default=10.0, help="length of a stretch")
    parser.add_argument("--stretches", type=int, default=6, help="stretches with cameras, and as many without")
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    options = parser.parse_args()
    figures = {}
    for part in options.parts.split(","):
        if part == "late":
            figures |= late(options.seconds, options.stretches)
        elif part == "times":
            figures |= times(min(options.seconds, 10.0))
        elif part == "images":
            figures |= images()
        else:
            raise SystemExit(f"there is no part {part!r}: name some of late, times, images")
    for name, value in figures.items():
        print(f"{name:20} {value}")
    if options.json:
        options.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
