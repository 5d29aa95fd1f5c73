"""Cameras of a cell: late periods beside three that record, errors of frame times, emulated and simulated images.

late: Periods of a scripted policy on two emulated controllers in real time, interleaved: stretches without cameras,
and with three of 640 × 480 at 30 Hz that write H.264.
times: Times in the videos of such cameras against the clock in their images.
images: A scripted Handover on a virtual cell. Each observed image is compared with one drawn of the measured state.
export: Processor time of an export of two arms and three cameras, 640 × 480. Their images are drawn, with noise.

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
from dual_ur10.lerobot.lerobot_export import runs_of, to_lerobot
from dual_ur10.sim2real.cameras.camera_record import CameraRecord
from dual_ur10.sim2real.cameras.camera_source import Exposure
from dual_ur10.sim2real.cameras.pattern_camera import pattern_time_s
from dual_ur10.sim2real.cameras.video_record import VideoRecord, read_video, video_name
from dual_ur10.sim2real.cell_file.cell_file import load_cell_file
from dual_ur10.sim2real.cell_file.tables import PatternCameraEntry
from dual_ur10.testing import CellForTests, VirtualCell
from ur_core.processes.system import LOCAL

CAMERAS = tuple(PatternCameraEntry(name=name, rate_hz=30.0) for name in ("front", "side", "overhead"))
SIZE = 96, 128  # height and width of compared images
FULL = {"height": 480, "width": 640}
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
    """Return late and all periods without and with cameras, the ratio of images written, and stretches given up.

    A pair of which one was given up, because the machine was too busy to move arms at all, is repeated on a new cell.
    """
    found, given_up, written = {False: [], True: []}, {False: 0, True: 0}, []
    while len(found[True]) < stretches and sum(given_up.values()) < stretches:
        with tempfile.TemporaryDirectory() as folder, CellForTests(Path(folder), task="SineTracking") as cell:
            file = load_cell_file(cell.path)
            env, policy = make("SineTracking", "scripted", {"cell": str(cell.path)}, 0)
            recorded = False
            try:
                first = True
                while len(found[True]) < stretches:
                    recorded = False
                    without = live_page.stretch(env, policy, seconds, first=first)
                    first, recorded = False, True
                    with recording(file, Path(folder)):
                        begun = time.monotonic()
                        beside = live_page.stretch(env, policy, seconds, first=False)
                        wanted = CAMERAS[0].rate_hz * (time.monotonic() - begun) * len(CAMERAS)
                    found[False].append(without)
                    found[True].append(beside)
                    written.append(min(1.0, frames_in(Path(folder)) / wanted))
                    print(f"late without {without}, with {beside}, {live_page.load()}", flush=True)
            except CellFaulted as error:
                given_up[recorded] += 1
                print(f"given up {'with' if recorded else 'without'} cameras, {live_page.load()}: {error}", flush=True)
            finally:
                env.close()
    if not found[True]:
        raise SystemExit("the machine is too busy for two streaming arms")
    (count, periods), (beside, all_beside) = (np.sum(found[each], axis=0).tolist() for each in (False, True))
    return {
        "late": [count, beside],
        "periods": [periods, all_beside],
        "late_extra": round(beside / max(1, all_beside) - count / max(1, periods), 5),
        "written": round(float(np.mean(written)), 3),
        "given_up": [given_up[False], given_up[True]],
        "load": live_page.load(),
    }


def frames_in(folder):
    """Return the number of images in the videos of the cameras."""
    return sum(1 for each in CAMERAS for _ in read_video(folder / video_name(each.name)))


def times(seconds):
    """Return the largest error of a time in the videos of three cameras, ms, and the number of images."""
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


def drawn_video(path, steps=50):
    """Write images of a scripted Handover at 30 Hz, with noise of a standard deviation of 3."""
    env, policy = policies.make("scripted", "DualUR10/Handover-v0", observation="both", cameras="front", **FULL)
    observation, _ = env.reset(seed=0)
    policy.reset()
    generator = np.random.default_rng(0)
    video = VideoRecord(path, (FULL["height"], FULL["width"]), 0.0)
    for number in range(steps):
        image = observation["pixels"]["front"] + generator.normal(0.0, 3.0, (*observation["pixels"]["front"].shape,))
        video.add(Exposure(image.round().clip(0, 255).astype(np.uint8), number / 30))
        observation = env.step(policy(observation["state"]))[0]
    video.close()
    env.close()


def export(seconds):
    """Return the processor time of an export in a second of the run."""
    names = [each.name for each in CAMERAS]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        drawn_video(folder / "drawn.mp4")
        played = {"kind": "file", "file": str(folder / "drawn.mp4"), "repeat": True}
        with VirtualCell(task="SineTracking", file={"camera": [{"name": each, **played} for each in names]}) as cell:
            keywords = {"cell": cell, "record": folder / "runs", "confirm": lambda _: True}
            env, policy = policies.make("scripted", "DualUR10/SineTracking-v0", **keywords)
            observation, _ = env.reset(seed=0)
            policy.reset()
            for _ in range(round(seconds / env.unwrapped.core.timing.period_s)):
                observation, _, terminated, truncated, _ = env.step(policy(observation))
                if terminated or truncated:
                    observation, _ = env.reset()
                    policy.reset()
            env.close()
        begin_s = time.process_time()
        made = to_lerobot(runs_of([folder / "runs"]), folder / "set", cameras=names, size=(480, 640))
        spent_s = time.process_time() - begin_s
    return {"export_s_per_s": round(spent_s * made.fps / made.frames, 3), "frames_exported": made.frames}


def main():
    """Measure, print and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", default="late,times,images,export")
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
        elif part == "export":
            figures |= export(6.0 * options.seconds)
        else:
            raise SystemExit(f"there is no part {part!r}: name some of late, times, images, export")
    for name, value in figures.items():
        print(f"{name:20} {value}")
    if options.json:
        options.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
