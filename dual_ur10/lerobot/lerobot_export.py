"""Export of recorded runs as a LeRobot dataset."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from dual_ur10.errors import DatasetError, RecordingError
from dual_ur10.lerobot.column_statistics import ImageStatistics, Statistics, sampled, small
from dual_ur10.lerobot.dataset_writer import OWN, DatasetWriter
from dual_ur10.lerobot.episode_frames import RecordedView, view_of_run
from dual_ur10.lerobot.features import DatasetFeature, of_arms, words_of
from dual_ur10.lerobot.image_video import ImageVideo, video_info
from dual_ur10.policies.learned.lerobot_files import image_key
from dual_ur10.policies.training.demonstrations import KEPT, kept_of, runs_in
from dual_ur10.sim2real.analysis.reconstruction import generator_text
from dual_ur10.sim2real.analysis.replay import replay
from dual_ur10.sim2real.recording.header import to_metadata
from dual_ur10.sim2real.recording.reader import file_of, read_run
from dual_ur10.sim2real.recording.recorded_images import RecordedImages
from dual_ur10.sim2real.recording.run import Episode, Header, Run
from dual_ur10.sim2real.recording.run_folder import RUN_FILE

FORMAT: Final = "1"

_SAME: Final = ("env_id", "family", "tick_s", "period_ticks", "mounts")


@dataclass(frozen=True)
class Exported:
    """Result of an export.

    Attributes:
        folder: Folder of the dataset.
        episodes: Number of its episodes.
        frames: Number of its frames.
        fps: Frames per second.
    """

    folder: Path
    episodes: int
    frames: int
    fps: int


def runs_of(paths: Iterable[Path]) -> list[Path]:
    """Return the runs that paths name: runs, their files, and folders of runs."""
    found: list[Path] = []
    for path in paths:
        inside = runs_in(path) if path.is_dir() and not (path / RUN_FILE).exists() else []
        found += inside or [path]
    return found


def to_lerobot(
    runs: Sequence[Path],
    folder: Path,
    *,
    task: str | None = None,
    cameras: Sequence[str] = (),
    size: tuple[int, int] = (480, 640),
    successful: bool = False,
    allow_partial: bool = False,
    writer: type[DatasetWriter] = DatasetWriter,
    on_run: Callable[[int, int], None] = lambda done, runs: None,
) -> Exported:
    """Make a LeRobot dataset of the episodes of recorded runs.

    Args:
        runs: Runs of the same environment: their folders or files, see `runs_of`.
        folder: Folder to create.
        task: Description of the task in words; None: that of the environment's id.
        cameras: Cameras whose images the dataset has. Simulated runs are simulated again for them; those of
            controllers have the videos that their cameras recorded.
        size: Height and width of an image.
        successful: Take only episodes that succeeded and, of a person's demonstrations, those that were kept.
        allow_partial: Also read what a kill or a fault left of a run.
        writer: Format of the dataset.
        on_run: Called after each run with the numbers of runs that are done and of all.

    Raises:
        RecordingError: A run cannot be read, is of another environment, or cannot be simulated again.
        DatasetError: The folder exists or cannot be written, or the rate is no whole number of frames per second.
        MissingExtraError: A package is not installed.
    """
    if not runs:
        raise DatasetError("there is no run: name one or more")
    if folder.exists() or folder.is_symlink():
        raise DatasetError(f"{folder} exists, and nothing is overwritten: name a new folder")
    first = [read_run(runs[0], allow_partial=allow_partial)]
    header = first[0].header
    view = view_of_run(header)
    shared = _shared(header, view)
    words = task or words_of(view.env_id)
    headers: list[dict[str, str]] = []
    episodes: list[dict[str, Any]] = []
    with writer(folder, view.fps, _features(view, cameras, size), _robot(view)) as made:
        for done, path in enumerate(runs):
            run = first.pop() if first else read_run(path, allow_partial=allow_partial)  # one is held at a time
            _check_same(shared, _shared(run.header, view_of_run(run.header)), path)
            headers.append(to_metadata(replace(run.header, cell_file=None, cell_sha256=None, extra={})))
            recorded = None
            if cameras and run.header.source != "mujoco":
                recorded = RecordedImages(file_of(path).parent, cameras, size)
            for place, success in _chosen(run, successful=successful).items():
                episode = replace(run.episodes[place], success=success)
                columns = view.columns(episode, f"episode {episode.number} of {path}")
                images = _images(run, place, recorded, cameras, size, made) if cameras else {}
                made.add(columns, words, images)
                episodes.append(_about(run, place, done, episode))
            on_run(done + 1, len(runs))
        if not episodes:
            raise DatasetError("the runs have no episode to export: record some, or leave --successful out")
        described = {"gripper_stroke_m": shared["gripper_stroke_m"], "runs": headers, "episodes": episodes}
        made.write_json(OWN, {"format": FORMAT, **described})
    return Exported(folder, len(episodes), sum(made.lengths), view.fps)


def _chosen(run: Run, *, successful: bool) -> dict[int, bool | None]:
    """Return the success of those episodes to export that have steps, by their place in the run."""
    success = {each.number: each.success for each in run.episodes}
    if successful:
        kept = kept_of(run).episodes if any(event.kind == KEPT for event in run.events) else run.episodes
        success = {each.number: True for each in kept if each.success}
    return {
        place: success[each.number]
        for place, each in enumerate(run.episodes)
        if each.number in success and len(each.reward)
    }


def _check_same(first: Mapping[str, Any], found: Mapping[str, Any], path: Path) -> None:
    """Make sure that two runs fit into one dataset.

    Raises:
        RecordingError: They are of different environments.
    """
    for name, expected in first.items():
        if found[name] != expected:
            raise RecordingError(
                f"{path} is of another environment: {name} is {found[name]!r:.200}, and {expected!r:.200} in the first "
                "run. Export it as a dataset of its own"
            )


def _shared(header: Header, view: RecordedView) -> dict[str, Any]:
    """Return the properties, by name, that are the same in all runs of a dataset."""
    options, stroke_m = view.view.setup.options, view.positions.stroke_m
    return {
        **{name: getattr(header, name) for name in _SAME},
        "action_mode": options.action_mode,
        "action_scale": options.action_scale,
        "observation": view.view.signature.view,
        "gripper_stroke_m": None if stroke_m is None else stroke_m.tolist(),
    }


def _features(view: RecordedView, cameras: Sequence[str], size: tuple[int, int]) -> dict[str, DatasetFeature]:
    actions = view.view.signature.actions
    found = of_arms(actions.mode, view.view.layout, grippers=actions.gripper, cameras=cameras, size=size)
    return {
        name: replace(each, info=video_info(view.fps, size)) if each.is_image else each for name, each in found.items()
    }


def _robot(view: RecordedView) -> str:
    """Return the name of the robot, such as "dual_ur10"."""
    return "dual_" + view.view.signature.robot.model.lower().replace(" + ", "_")


def _about(run: Run, place: int, number: int, episode: Episode) -> dict[str, Any]:
    return {
        "run": number,
        "number": episode.number,
        "seed": episode.seed,
        "generator": generator_text(run, place),
        "success": episode.success,
        "ended_by": episode.ended_by,
    }


def _images(
    run: Run,
    place: int,
    recorded: RecordedImages | None,
    cameras: Sequence[str],
    size: tuple[int, int],
    made: DatasetWriter,
) -> dict[str, Statistics]:
    """Write the videos of an episode's cameras, and return the statistics of their images.

    Raises:
        RecordingError: The simulation of the episode differs from it, or it was recorded without images.
        DatasetError: A video cannot be written.
    """
    count = len(run.episodes[place].reward)
    wanted = set(sampled(count).tolist())
    statistics = {each: ImageStatistics() for each in cameras}
    with ExitStack() as stack:
        videos = {
            each: stack.enter_context(ImageVideo(made.video_of(image_key(each)), made.fps, size)) for each in cameras
        }
        seen = 0

        def draw(images: Any) -> None:
            nonlocal seen
            if seen < count:  # the last observation belongs to no action
                for camera, video in videos.items():
                    video.add(images[camera])
                    if seen in wanted:
                        statistics[camera].add(small(images[camera]))
            seen += 1

        if recorded is None:
            _simulate(run, place, cameras, size, draw)
        else:
            for images in recorded.images(run, run.episodes[place]):
                draw(images)
    return {image_key(each): found.result() for each, found in statistics.items()}


def _simulate(run: Run, place: int, cameras: Sequence[str], size: tuple[int, int], draw: Callable[[Any], None]) -> None:
    """Simulate an episode again, and pass its images on.

    Raises:
        RecordingError: This simulation differs from it.
    """
    shown = {"observation": "pixels", "cameras": tuple(cameras), "height": size[0], "width": size[1]}
    found = replay(run, episode=place, keywords=shown, on_observation=draw)
    if not found.is_exact:
        raise RecordingError(
            f"episode {place} cannot be rendered: simulated again, {found.difference}. Use the versions that recorded "
            "it, or leave --cameras out"
        )
