"""The commands `export` and `import`: datasets of other formats."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape
from rich.table import Table

from dual_ur10.cli.options import (
    RUNS,
    NoRecord,
    Partial,
    Record,
    Settings,
    check_extras,
    console,
    example_of,
    keywords_of,
    print_whole,
    progress_of,
)
from dual_ur10.cli.records import DIFFERENT
from dual_ur10.errors import SettingsError, UnknownNameError

if TYPE_CHECKING:
    from dual_ur10.lerobot.dataset_reader import Dataset
    from dual_ur10.lerobot.resimulation import JointColumns, Resimulated

exporter = typer.Typer(help="Export recorded runs to other formats.", no_args_is_help=True)
importer = typer.Typer(help="Inspect datasets of other formats, and simulate them.", no_args_is_help=True)

_NEEDS = ("lerobot", "a LeRobot dataset")


@exporter.command("lerobot", epilog=example_of("export lerobot runs/RUN --out carry --cameras front,left/wrist"))
def export_lerobot(
    runs: Annotated[list[Path], typer.Argument(metavar="RUNS...", help="Recorded runs, or folders of runs.")],
    out: Annotated[Path, typer.Option("--out", "-o", metavar="DIR", help="Folder to create.")],
    task: Annotated[
        str | None, typer.Option("--task", metavar="TEXT", help="The task in words. Default: the environment's name.")
    ] = None,
    cameras: Annotated[
        str | None,
        typer.Option(
            "--cameras", metavar="NAMES", help="Cameras, such as front,left/wrist: rendered of simulated runs."
        ),
    ] = None,
    size: Annotated[str, typer.Option("--size", metavar="WxH", help="Size of an image in pixels.")] = "640x480",
    successful: Annotated[
        bool,
        typer.Option(
            "--successful", help="Only episodes that succeeded and, of demonstrations, that were kept. Default: all."
        ),
    ] = False,
    form: Annotated[
        str, typer.Option("--format", metavar="VERSION", help="v3.0, or v2.1 with modality.json for GR00T.")
    ] = "v3.0",
    allow_partial: Partial = False,
) -> None:
    """Make a LeRobot dataset of recorded runs of one environment: commanded targets, steps, states, and images."""
    check_extras(_NEEDS)
    from dual_ur10.lerobot.dataset_writer import DatasetWriter
    from dual_ur10.lerobot.dataset_writer_v21 import DatasetWriterV21
    from dual_ur10.lerobot.lerobot_export import runs_of, to_lerobot

    writers = {each.version: each for each in (DatasetWriter, DatasetWriterV21)}
    if form not in writers:
        raise UnknownNameError("format", form, list(writers))
    with progress_of(console) as progress:
        bar = progress.add_task("exporting")
        found = to_lerobot(
            runs_of(runs),
            out,
            task=task,
            cameras=tuple(each.strip() for each in cameras.split(",")) if cameras else (),
            size=_size(size),
            successful=successful,
            allow_partial=allow_partial,
            writer=writers[form],
            on_run=lambda done, total: progress.update(bar, completed=done, total=total),
        )
    console.print(
        f"{out}: {found.episodes} episodes, {found.frames} frames at {found.fps} per second",
        highlight=False,
        soft_wrap=True,
        markup=False,
    )


def _size(text: str) -> tuple[int, int]:
    """Return height and width of "WxH"."""
    width, _, height = text.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal() and 16 <= int(width) <= 4096 and 16 <= int(height) <= 4096):
        raise SettingsError(f"--size is {text!r:.40}: write it as WxH, such as 640x480, of 16 to 4096 pixels each")
    return int(height), int(width)


@importer.command("lerobot", epilog=example_of("import lerobot ur5e_pick --left 0:6 --set robot=ur5e"))
def import_lerobot(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of a dataset, of format v3 or v2.1.")],
    inspect: Annotated[bool, typer.Option("--inspect", help="Print what it holds, and simulate nothing.")] = False,
    episode: Annotated[
        int | None, typer.Option("--episode", "-e", min=0, help="Number of an episode. Default: all.")
    ] = None,
    feature: Annotated[
        str | None,
        typer.Option("--feature", metavar="NAME", help="Feature with the joints of other people's arms: action."),
    ] = None,
    left: Annotated[
        str | None,
        typer.Option("--left", metavar="A:B", help="Places of the left arm's joints in it. Default: by name."),
    ] = None,
    right: Annotated[
        str | None, typer.Option("--right", metavar="A:B", help="Places of the right arm's joints in it.")
    ] = None,
    degrees: Annotated[bool, typer.Option("--degrees", help="Its joints are in degrees.")] = False,
    settings: Settings = None,
    record: Record = RUNS,
    no_record: NoRecord = False,
) -> None:
    """Simulate the episodes of a LeRobot dataset, and record them as runs.

    A dataset that `export` made is simulated from the same starts with the same actions: commanded joints that differ
    end in exit code 1. Of other people's UR arms, DualUR10/Free follows the joint positions, through adapter and gate.
    """
    check_extras(_NEEDS)
    from dual_ur10.lerobot.dataset_reader import read_dataset
    from dual_ur10.lerobot.resimulation import follow_motions, simulate_again

    dataset = read_dataset(folder)
    _print(dataset)
    if inspect:
        return
    keywords = keywords_of(settings, False)
    chosen = None if episode is None else [episode]
    kept = None if no_record else record
    if dataset.own is not None and feature is left is right is None:
        if keywords:
            raise SettingsError("--set is for datasets of others: this one states its environment")
        found = simulate_again(dataset, chosen, record=kept, on_episode=_print_episode)
        if any(each.difference for each in found):
            raise typer.Exit(DIFFERENT)
        return
    columns = _columns(dataset, feature or "action", left, right, degrees)
    follow_motions(dataset, columns, chosen, keywords=keywords, record=kept, on_episode=_print_episode)


def _print(dataset: Dataset) -> None:
    origin = "of this package" if dataset.own is not None else f"robot {dataset.robot_type or 'not stated'}"
    console.print(
        f"{dataset.folder}: {dataset.version}, {len(dataset.lengths)} episodes, {sum(dataset.lengths)} frames at "
        f"{dataset.fps:g} per second, {origin}",
        highlight=False,
        soft_wrap=True,
        markup=False,
    )
    table = Table("feature", "type", "shape", "names", header_style="bold")
    for name, each in dataset.features.items():
        table.add_row(escape(name), escape(each.dtype), "x".join(map(str, each.shape)), escape(_names(each.names)))
    print_whole(table)


def _names(names: Any) -> str:
    texts = list(map(str, names)) if isinstance(names, list | tuple) else [str(names)] if names else []
    return ", ".join(texts[:8]) + (f", ... ({len(texts)})" if len(texts) > 8 else "")


def _print_episode(found: Resimulated) -> None:
    end = f", ended by {found.ended_by}" if found.ended_by else ""
    state = found.difference or f"commanded joints as in the dataset (at most {1e3 * found.largest_rad:.3g} mrad apart)"
    console.print(
        f"episode {found.episode}: {found.steps} of {found.frames} steps{end}; {state}",
        highlight=False,
        soft_wrap=True,
        markup=False,
    )


def _columns(dataset: Dataset, feature: str, left: str | None, right: str | None, degrees: bool) -> JointColumns:
    """Return the places of the joints that the options name, or else the names of the feature."""
    from dual_ur10.lerobot.dataset_reader import vector_of
    from dual_ur10.lerobot.resimulation import JointColumns, joints_in

    if left is not None or right is not None:
        return JointColumns(feature, (_places("--left", left), _places("--right", right)), degrees)
    values, names = vector_of(dataset, feature)
    return JointColumns(feature, joints_in(names, values.shape[1], f"{feature} of {dataset.folder}"), degrees)


def _places(option: str, text: str | None) -> tuple[int, ...] | None:
    if text is None:
        return None
    begin, _, end = text.partition(":")
    if not (begin.isdecimal() and end.isdecimal() and len(end) < 5 and int(end) - int(begin) == 6):
        raise SettingsError(f"{option} is {text!r:.40}: write it as A:B, such as 0:6, for the six numbers A to B - 1")
    return tuple(range(int(begin), int(end)))
