"""The command `video`."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from dual_ur10.cli.options import (
    EnvName,
    Perturbed,
    PolicyName,
    Randomization,
    Settings,
    console,
    keywords_of,
    progress_of,
    randomize,
)
from dual_ur10.cli.session import close, make
from dual_ur10.ids import env_id_of


def video(
    env: EnvName,
    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="FILE", help="The video: .mp4 or .gif. An old one is replaced.")
    ],
    policy: PolicyName = "scripted",
    seed: Annotated[int, typer.Option("--seed", "-s", min=0, help="Seed of the episode.")] = 0,
    cameras: Annotated[
        str,
        typer.Option(
            "--cameras",
            metavar="NAMES",
            help="front, side, overhead, perspective, left/wrist, right/wrist, or one of the task's own; several side "
            "by side, with commas between.",
        ),
    ] = "front",
    width: Annotated[int, typer.Option("--width", help="Width of each camera's picture in pixels.")] = 640,
    height: Annotated[int, typer.Option("--height", help="Its height.")] = 480,
    speed: Annotated[
        float, typer.Option("--speed", metavar="RATIO", help="0.25 is slow motion, 3 three times as fast as reality.")
    ] = 1.0,
    zoom: Annotated[
        float, typer.Option("--zoom", metavar="FACTOR", help="Enlarge the middle of each picture, such as 1.3.")
    ] = 1.0,
    seconds: Annotated[
        float | None, typer.Option("--seconds", min=0.1, help="Stop after this time of the episode.")
    ] = None,
    shadows: Annotated[bool, typer.Option("--shadows", help="Draw shadows: takes several times as long.")] = False,
    plain: Annotated[bool, typer.Option("--plain", help="No references and traces, and no names of the arms.")] = False,
    settings: Settings = None,
    perturbed: Perturbed = False,
    randomization: Randomization = None,
) -> None:
    """Write a video of one episode of a policy, with its stage, success, references and traces drawn."""
    from dual_ur10.assets.visuals import cameras as scene_cameras
    from dual_ur10.envs.rendering.video_file import check_video
    from dual_ur10.policies.evaluation.film import check_view, film, take

    check_video(out)
    keywords = keywords_of(settings, perturbed)
    randomize(keywords, randomization)
    made, actor = make(env, policy, keywords, seed)
    names = [each.strip() for each in cameras.split(",") if each.strip()]
    try:
        known = scene_cameras(made.unwrapped.core.config.scene)
        check_view(names, known, width=width, height=height, zoom=zoom, speed=speed)
        with progress_of(console) as progress:
            bar = progress.add_task("running", total=None)
            shown = take(made, actor, seed=seed, seconds=math.inf if seconds is None else seconds)
            progress.update(bar, description="drawing", total=1.0)
            found = film(
                out,
                shown,
                title=f"{env_id_of(env).partition('/')[2].rpartition('-')[0]}, {_short(policy)}, seed {seed}",
                cameras=names,
                width=width,
                height=height,
                speed=speed,
                zoom=zoom,
                shadows=shadows,
                marks=not plain,
                on_ratio=lambda ratio: progress.update(bar, completed=ratio),
            )
    finally:
        close(made, actor)
    end = "success" if shown.success else shown.ended_by or ("no success" if shown.over else "cut")
    console.print(
        f"wrote {out}: {found.duration_s:.1f} s, {found.size[0]} × {found.size[1]} pixels, "
        f"{out.stat().st_size / 1e6:.2f} MB ({end} after {shown.duration_s:.1f} s)",
        highlight=False,
        soft_wrap=True,
        markup=False,
    )


def _short(policy: str) -> str:
    """Return the name of a policy, or the last part of a path to one."""
    return policy.rstrip("/").rpartition("/")[2]
