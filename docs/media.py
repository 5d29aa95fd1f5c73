"""Make docs/media, the moving picture of the README and the picture of all arms: make media (needs the extra `plot`).

Each video is what its command makes, which the page of its task states; docs/media/media.json says what it shows. Names
restrict it to files that begin with one of them: `python docs/media.py handover tasks`.
"""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import sys
import time
from pathlib import Path

import mujoco
import numpy as np
from imageio_ffmpeg import count_frames_and_secs, read_frames
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from dual_ur10.assets.scene import build_model
from dual_ur10.assets.settings import SceneSettings
from dual_ur10.ids import env_id_of
from dual_ur10.policies import make
from ur_core.kinematics.frames import ArmMount
from ur_core.kinematics.robots import ROBOTS

DOCS = Path(__file__).parent
MEDIA = DOCS / "media"

VIDEOS = {
    "sine-tracking-scripted": (
        "SineTracking --policy scripted --set random_path=True --seed 2 --seconds 8",
        "Scripted policy",
        "A sine of random direction, amplitude and frequency. Lines are the last path of each flange.",
    ),
    "sine-tracking-learned": (
        "SineTracking --policy learned --seconds 8",
        "Learned policy",
        "One network, by imitation learning.",
    ),
    "sine-tracking-from-scratch": (
        "SineTracking --policy sine_ppo --seconds 8",
        "PPO from scratch",
        "Stock Stable-Baselines3 with the README's settings: <code>python examples/train_with_sb3.py PPO --seed 2 "
        "--out sine_ppo</code>",
    ),
    "sine-tracking-random": (
        "SineTracking --policy scripted --randomization mild --seed 1 --seconds 8",
        "Random plant",
        "Bases, masses, friction, lag and delays differ from the model as in a well-maintained cell.",
    ),
    "sine-tracking-failure": (
        "SineTracking --policy learned --randomization wide --seed 0 --seconds 8",
        "Typical failure",
        "Misplaced bases and old observations, as on this wide plant, show in no sensor: the error is above 3 mm RMS.",
    ),
    "sync-carry-scripted": (
        "SyncCarry --policy scripted --speed 4",
        "Scripted policy",
        "Both arms take a bar of 4 kg, carry it along its path and put it down.",
    ),
    "sync-carry-learned": (
        "SyncCarry --policy learned --speed 3",
        "Learned policy",
        "One network, by imitation learning.",
    ),
    "sync-carry-random": (
        "SyncCarry --policy learned --randomization wide --seed 1 --speed 4",
        "Random plant",
        "Masses, friction, lag, bases and the measured pose of the bar are wrong, several times as much as in a "
        "well-maintained cell.",
    ),
    "sync-carry-failure": (
        "SyncCarry --policy learned --set object_range_m=0.1 --set object_turn_rad=0.05 --seed 3 --speed 4",
        "Typical failure",
        "The bar lies up to 100 mm away, and the policy was trained for 20 mm: it grips where the path begins, and "
        "carries the bar beside it.",
    ),
    "handover-scripted": (
        "Handover --policy scripted --speed 1.5",
        "Scripted policy",
        "One arm picks up the block and hands it to the other, which places it on its target.",
    ),
    "handover-learned": (
        "Handover --policy learned",
        "Learned policy",
        "One network, by imitation learning.",
    ),
    "handover-from-scratch": (
        "Handover --policy handover_ppo/policy --speed 2",
        "PPO from scratch",
        "From rewards alone, and slower than the others: <code>dual-ur10 train Handover --algo ppo --seed 2 "
        "--out handover_ppo</code>",
    ),
    "handover-random": (
        "Handover --policy learned --randomization wide --seed 1 --speed 1.5",
        "Random plant",
        "Masses, friction, lag, bases and the measured pose of the block are wrong, several times as much as in a "
        "well-maintained cell.",
    ),
    "handover-failure": (
        "Handover --policy learned --set object_range_m=0.12 --set object_turn_rad=1.57 --seed 1 --speed 2",
        "Typical failure",
        "The block lies up to 120 mm and 90° away, and the policy was trained for 30 mm and 45°: it grips late, and "
        "puts the block down beside its target.",
    ),
    "peg-insertion-scripted": (
        "PegInsertion --policy scripted --set clearance_m=0.0005 --randomization mild --speed 3 --cameras near",
        "Scripted policy",
        "The left arm searches the hole by the forces on the peg. There are 0.25 mm on each side.",
    ),
    "tray-balance-scripted": (
        "TrayBalance --policy scripted --randomization mild --speed 2 --cameras near",
        "Scripted policy",
        "Both arms tilt the tray until the ball rests in its middle, and carry it to its goal.",
    ),
    "tray-balance-learned": (
        "TrayBalance --policy learned --randomization mild --speed 2 --cameras near",
        "Learned policy",
        "One network for both arms, which sees their goals alone.",
    ),
    "box-lift-scripted": (
        "BoxLift --policy scripted --randomization mild --speed 4 --cameras near",
        "Scripted policy",
        "Closed grippers press the box with a force that both arms regulate by what they measure.",
    ),
    "lid-and-place-scripted": (
        "LidAndPlace --policy scripted --randomization mild --speed 5 --cameras near",
        "Scripted policy",
        "The left arm holds the sprung lid open, and yields to the errors of the arc.",
    ),
    "lid-and-place-learned": (
        "LidAndPlace --policy learned --randomization mild --speed 5 --cameras near",
        "Learned policy",
        "One network for both arms, which sees their goals alone.",
    ),
}
"""Videos: the command that makes each, its title, and what it shows. Those of trained policies need their folders."""

POLICIES = ("", "scripted", "learned")
"""Policies that need no training before a video, or none at all."""

SMALL = " --width 400 --height 300"
"""Size of the videos of which the README's picture needs nothing."""

HERO = ("sine-tracking-learned", "sync-carry-learned", "handover-learned")
HERO_FRAMES, HERO_MS, SHOWN = 56, 120, slice(66, 438)
"""Frames of the README's picture, their time, and the rows of a video that it shows: no line at the foot."""

POSTER = 0.45  # part of a video after which its poster is taken


def video(name: str) -> dict[str, str]:
    """Make a video and its poster, and return its entry of the record."""
    options, title, text = VIDEOS[name]
    options += "" if name in HERO else SMALL
    command, path = f"dual-ur10 video {options}", MEDIA / f"{name}.mp4"
    done = subprocess.run(
        [sys.executable, "-m", "dual_ur10", "video", *shlex.split(options), "--out", str(path)],
        capture_output=True,
        text=True,
        check=True,
    )
    frames = frames_of(path, 20)
    Image.fromarray(frames[int(POSTER * len(frames))]).save(path.with_suffix(".webp"), quality=75, method=6)
    end = re.search(r"\(([^()]*)\)\s*$", done.stdout)
    return {
        "name": name,
        "env_id": env_id_of(options.split()[0]),
        "title": title,
        "caption": text,
        "end": f"{end[1].capitalize()}." if end and "--seconds" not in options else "",
        "command": f"{command} -o {name}.mp4",
    }


def frames_of(path: Path, count: int) -> list[NDArray[np.uint8]]:
    """Return frames of a video, evenly spaced in time, without its last second, which is still."""
    total = count_frames_and_secs(str(path))[0] - 25
    wanted = {int(number * total / count) for number in range(count)}
    reader = read_frames(str(path))
    width, height = next(reader)["size"]
    return [
        np.frombuffer(frame, np.uint8).reshape(height, width, 3)
        for number, frame in enumerate(reader)
        if number in wanted
    ]


def hero() -> Path:
    """Draw the README's moving picture: three tasks side by side, each as long as its episode."""
    columns = [frames_of(MEDIA / f"{name}.mp4", HERO_FRAMES) for name in HERO]
    labels = [VIDEOS[name][0].split()[0] for name in HERO]
    pictures = []
    for frames in zip(*columns, strict=True):
        row = Image.fromarray(np.hstack([frame[SHOWN] for frame in frames]))
        draw = ImageDraw.Draw(row)
        for number, label in enumerate(labels):
            corner = number * row.width // len(labels) + 18, 14
            draw.text(
                corner,
                label,
                fill=(255, 255, 255),
                font=ImageFont.load_default(34),
                stroke_width=2,
                stroke_fill=(38, 50, 56),
            )
        pictures.append(row)
    path = DOCS / "images" / "tasks.webp"
    pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=HERO_MS, loop=0, quality=60, method=4)
    return path


def free() -> dict[str, str]:
    """Draw the scene of Free, and return its entry of the record."""
    env, _ = make("zero", "Free", render_mode="rgb_array", camera="front", objects=("block", "bar"))
    with env:
        env.reset(seed=0)
        Image.fromarray(env.render()).save(MEDIA / "free.webp", quality=80, method=6)
    caption = "Both arms with open grippers, a block, and on demand a bar."
    return {"name": "free", "env_id": "DualUR10/Free-v0", "title": "The scene", "caption": caption, "end": ""}


WIDTH, HEIGHT, COLUMNS = 200, 230, 7
POSE_RAD = (0.0, -1.75, 1.6, -1.42, -1.57, 0.0)
BACKGROUND = (255, 255, 255)


def tile(robot: str) -> Image.Image:
    """Return the picture of one arm in a bent pose, seen from the side."""
    mounts = ArmMount((0.0, 0.0, 0.0), 0.0, robot=robot), ArmMount((0.0, -3.0, 0.0), 0.0, robot=robot)
    settings = SceneSettings(left=mounts[0], right=mounts[1], table_center_m=(2.9, 2.9), table_size_m=(0.1, 0.1))
    model = build_model(settings)
    model.geom_rgba[model.geom("floor").id, 3] = 0.0
    model.vis.global_.offwidth, model.vis.global_.offheight = 2 * WIDTH, 2 * HEIGHT
    data = mujoco.MjData(model)
    data.qpos[:6] = POSE_RAD
    mujoco.mj_forward(model, data)
    camera = mujoco.MjvCamera()
    camera.lookat[:], camera.distance, camera.azimuth, camera.elevation = (0.36, 0.0, 0.66), 2.15, 115.0, -8.0
    with mujoco.Renderer(model, 2 * HEIGHT, 2 * WIDTH) as renderer:
        renderer.update_scene(data, camera)
        picture = Image.fromarray(renderer.render())
        renderer.enable_segmentation_rendering()
        renderer.update_scene(data, camera)
        geoms = renderer.render()[..., 0]
    arm = np.array([model.geom_bodyid[geom] > 0 and geom >= 0 for geom in range(model.ngeom)])
    mask = np.where(geoms >= 0, arm[np.maximum(geoms, 0)], False)
    cut = Image.composite(picture, Image.new("RGB", picture.size, BACKGROUND), Image.fromarray(mask))
    return cut.resize((WIDTH, HEIGHT), Image.Resampling.LANCZOS)


def robots() -> Path:
    """Draw all models of arms at one scale."""
    rows = -(-len(ROBOTS) // COLUMNS)
    sheet = Image.new("RGB", (COLUMNS * WIDTH, rows * HEIGHT), BACKGROUND)
    draw = ImageDraw.Draw(sheet)
    for index, (name, facts) in enumerate(ROBOTS.items()):
        corner = index % COLUMNS * WIDTH, index // COLUMNS * HEIGHT
        sheet.paste(tile(name), corner)
        draw.text((corner[0] + 8, corner[1] + 6), facts.title, fill=(40, 40, 40), font=ImageFont.load_default(18))
    path = DOCS / "images" / "robots.png"
    sheet.quantize(128).save(path, optimize=True)
    return path


def main(names: list[str]) -> None:
    """Make all, or what begins with one of the names, and print what was made."""
    MEDIA.mkdir(exist_ok=True)
    record = MEDIA / "media.json"
    entries = {each["name"]: each for each in (json.loads(record.read_text()) if record.exists() else [])}

    def wanted(name: str) -> bool:
        return not names or any(name.startswith(each) for each in names)

    for name in (*VIDEOS, "free"):
        if wanted(name):
            begun = time.monotonic()
            options = VIDEOS[name][0].split() if name in VIDEOS else []
            policy = options[options.index("--policy") + 1] if options else ""
            if policy not in POLICIES and not Path(policy).exists():
                print(f"{name}: kept as it is: train {policy} first, as its caption says")
                continue
            entries[name] = free() if name == "free" else video(name)
            print(f"{name}: {time.monotonic() - begun:.0f} s. {entries[name]['end']}", flush=True)
            ordered = [entries[each] for each in (*VIDEOS, "free") if each in entries]
            record.write_text(json.dumps(ordered, indent=1, ensure_ascii=False) + "\n")
    for name, drawn in (("tasks", hero), ("robots", robots)):
        if wanted(name):
            path = drawn()
            print(f"{path.name}: {path.stat().st_size / 1e6:.2f} MB", flush=True)
    sizes = [path.stat().st_size for path in MEDIA.iterdir()]
    print(f"media: {sum(sizes) / 1e6:.1f} MB in {len(sizes)} files, the largest {max(sizes) / 1e6:.2f} MB")


if __name__ == "__main__":
    main(sys.argv[1:])
