"""Recorded runs become a LeRobot dataset, and are the same after a round trip."""

from __future__ import annotations

import json
import resource
from pathlib import Path

import av
import gymnasium as gym
import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dual_ur10.errors import DatasetError, RecordingError
from dual_ur10.lerobot.column_statistics import QUANTILES, ImageStatistics, combined, statistics_of
from dual_ur10.lerobot.dataset_reader import read_dataset
from dual_ur10.lerobot.features import ACTION, ENV_ACTION, ENVIRONMENT_STATE, STATE
from dual_ur10.lerobot.lerobot_export import runs_of, to_lerobot
from dual_ur10.lerobot.resimulation import simulate_again
from dual_ur10.policies.learned.lerobot_files import image_keys
from dual_ur10.policies.training.demonstrations import KEPT
from dual_ur10.sim2real.cameras.pattern_camera import pattern_time_s
from dual_ur10.sim2real.cell.cell_config import CellConfig
from dual_ur10.sim2real.recording.reader import read_run
from dual_ur10.sim2real.recording.recorded_images import observed_s
from dual_ur10.testing import VirtualCell
from tests.cli.command import run as command
from tests.lerobot.conftest import STEPS, recorded

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3", "gripper")
NAMES = [f"{arm}_{joint}.pos" for arm in ("left", "right") for joint in JOINTS]


def test_targets_and_steps_are_equal_in_every_bit(made):
    runs, folder, commanded = made
    dataset = read_dataset(folder)
    run = read_run(next(runs.iterdir()))
    assert dataset.lengths == list(STEPS)
    assert list(dataset.features[ACTION].names) == list(dataset.features[STATE].names) == NAMES
    for number, episode in enumerate(run.episodes):
        found = dataset.episode(number)
        action, state = (found[name].reshape(-1, 2, 7) for name in (ACTION, STATE))
        assert np.array_equal(action[..., :6], commanded[number].astype(np.float32))
        assert np.array_equal(found[ENV_ACTION], episode.action.astype(np.float32))
        assert found[ENV_ACTION].astype(np.float64).tobytes() == episode.action.tobytes()  # float32 as it was given
        assert np.array_equal(found[ENVIRONMENT_STATE], episode.observation[:-1].astype(np.float32))
        # A frame's state is what was commanded before: LeRobot's pairs of an observation and the action that follows.
        assert np.array_equal(state[1:, :, :6], action[:-1, :, :6])
        assert np.array_equal(action[..., 6], (episode.gripper_m[:, -1] / 0.085).astype(np.float32))
        assert found["next.done"].tolist() == [False] * (STEPS[number] - 1) + [True]
        assert found["commander"].tolist() == [[0, 1]] * STEPS[number]
        assert found["intervention"].all()
        assert np.array_equal(found["timestamp"], (np.arange(STEPS[number]) / 25).astype(np.float32))


def test_a_dataset_simulated_again_is_the_same_dataset(made, tmp_path):
    """Also of the second episode alone, since each is given its own start."""
    _, folder, _ = made
    dataset = read_dataset(folder)
    assert [each.difference for each in simulate_again(dataset, record=tmp_path / "runs")] == ["", ""]
    to_lerobot(runs_of([tmp_path / "runs"]), tmp_path / "again")
    data = "data/chunk-000/file-000.parquet"
    assert (tmp_path / "again" / data).read_bytes() == (folder / data).read_bytes()
    (alone,) = simulate_again(dataset, [1])
    assert (alone.difference, alone.steps) == ("", STEPS[1])


def test_another_target_is_found(made):
    dataset = read_dataset(made[1])
    dataset.columns[ACTION][11, 4] = np.nextafter(dataset.columns[ACTION][11, 4], np.float32(9))
    first, second = simulate_again(dataset)
    assert first.difference == ""
    assert second.difference.startswith("step 2: left wrist_2_joint is ")


def test_files_are_as_lerobot_needs_them(made):
    """What its loader, its learners and its recorder ask for, found by taking away one thing at a time."""
    _, folder, _ = made
    info = json.loads((folder / "meta/info.json").read_text())
    assert (info["codebase_version"], info["fps"], type(info["fps"])) == ("v3.0", 25, int)
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"]) == (2, sum(STEPS), 1)
    assert (info["robot_type"], info["splits"], info["video_path"]) == ("dual_ur10", {"train": "0:2"}, None)
    file = pq.ParquetFile(folder / "data/chunk-000/file-000.parquet")
    assert file.schema_arrow.names == [*info["features"]]
    assert [file.metadata.row_group(k).num_rows for k in range(file.num_row_groups)] == list(STEPS)
    assert str(file.schema_arrow.field(ACTION).type) == "fixed_size_list<element: float>[14]"
    assert str(file.schema_arrow.field("next.reward").type) == "float"
    tasks = pq.read_table(folder / "meta/tasks.parquet")
    assert json.loads(tasks.schema.metadata[b"pandas"])["index_columns"] == ["task"]
    assert tasks.to_pydict() == {"task_index": [0], "task": ["Handover"]}
    episodes = pq.read_table(folder / "meta/episodes/chunk-000/file-000.parquet")
    assert episodes["dataset_from_index"].to_pylist() == [0, STEPS[0]]
    assert episodes["dataset_to_index"].to_pylist() == [STEPS[0], sum(STEPS)]
    wanted = {"min", "max", "mean", "std", "count", *QUANTILES}
    stats = json.loads((folder / "meta/stats.json").read_text())
    for name in info["features"]:
        assert {*stats[name]} == wanted
        assert {f"stats/{name}/{each}" for each in wanted} <= {*episodes.column_names}
    # Policies take their inputs by these prefixes.
    prefixed = [name for name in info["features"] if name.startswith(("action", "observation"))]
    assert prefixed == [STATE, ENVIRONMENT_STATE, ACTION]


@given(st.lists(st.integers(2, 6), min_size=1, max_size=4), st.integers(0, 9))
def test_statistics_of_parts_are_those_of_the_whole(lengths, seed):
    values = np.random.default_rng(seed).normal(3.0, 2.0, (sum(lengths), 2))
    found = combined(statistics_of(each) for each in np.split(values, np.cumsum(lengths)[:-1]))
    whole = statistics_of(values)
    for name in ("min", "max", "mean", "std", "count"):
        assert np.allclose(found[name], whole[name], rtol=1e-12, atol=1e-12), name
    assert (found["min"] <= found["q10"]).all()
    assert (found["q90"] <= found["max"]).all()


@given(st.lists(st.sampled_from([(1, 1), (2, 3), (5, 4)]), min_size=1, max_size=4), st.integers(0, 9))
def test_statistics_of_images_are_those_of_all_their_pixels(sizes, seed):
    rng, found = np.random.default_rng(seed), ImageStatistics()
    images = [rng.integers(0, 256, (*size, 3), dtype=np.uint8) for size in sizes]
    for each in images:
        found.add(each)
    whole = statistics_of(np.concatenate([each.reshape(-1, 3) for each in images]))
    for name, values in found.result().items():
        expected = len(images) if name == "count" else whole[name].reshape(3, 1, 1) / 255
        assert np.allclose(values, expected, rtol=1e-12, atol=1e-12), name


def test_images_are_those_of_the_same_simulation(made, tmp_path, monkeypatch):
    """A picture per frame, at a constant rate, with statistics of its channels in 0..1."""
    monkeypatch.chdir(tmp_path)
    runs, folder = made[0], Path("data:set")
    to_lerobot(runs_of([runs]), folder, cameras=("front", "left/wrist"), size=(64, 80))
    dataset = read_dataset(folder)
    key = "observation.images.left_wrist"
    assert dataset.features[key].shape == (64, 80, 3)
    with av.open(str(dataset.folder / f"videos/{key}/chunk-000/file-001.mp4")) as file:
        times = [float(frame.pts * frame.time_base) for frame in file.decode(video=0)]
    assert np.allclose(times, np.arange(STEPS[1]) / 25)
    stats = json.loads((folder / "meta/stats.json").read_text())[key]
    assert np.shape(stats["mean"]) == (3, 1, 1)
    assert 0.0 < np.min(stats["mean"]) < np.max(stats["mean"]) < 1.0
    video = folder / f"videos/{key}/chunk-000/file-001.mp4"
    video.rename(video.with_name("other.mp4"))
    video.write_text("ffconcat version 1.0\nfile other.mp4\n")
    with pytest.raises(DatasetError, match=r"cannot read the video .*file-001\.mp4"):
        read_dataset(folder)
    video.unlink()
    with pytest.raises(DatasetError, match=r"file-001\.mp4 is missing"):
        read_dataset(folder)


def test_format_v2_1_has_the_same_frames_and_the_parts_that_gr00t_asks_for(made, tmp_path):
    runs, folder, _ = made
    target = tmp_path / "dataset"
    assert command("export", "lerobot", str(runs), "--out", str(target), "--format", "v2.1")[0] == 0
    found, expected = read_dataset(target), read_dataset(folder)
    assert (found.version, found.lengths) == ("v2.1", expected.lengths)
    for name, values in expected.columns.items():
        assert found.columns[name].tobytes() == values.tobytes(), name
    modality = json.loads((target / "meta/modality.json").read_text())
    assert modality["action"] == modality["state"]
    assert modality["action"]["right_arm"] == {"start": 7, "end": 13}
    assert modality["action"]["right_gripper"] == {"start": 13, "end": 14}
    lines = [json.loads(each) for each in (target / "meta/episodes.jsonl").read_text().splitlines()]
    assert lines[1] == {"episode_index": 1, "tasks": ["Handover"], "length": STEPS[1]}
    stats = [json.loads(each) for each in (target / "meta/episodes_stats.jsonl").read_text().splitlines()]
    assert {*stats[0]["stats"][ACTION]} == {"min", "max", "mean", "std", "count"}
    assert [each.difference for each in simulate_again(found)] == ["", ""]
    assert command("export", "lerobot", str(runs), "--out", str(tmp_path / "x"), "--format", "v2.0")[0] == 2


def test_the_concise_view_is_exported_with_rounded_targets(tmp_path):
    commanded = recorded(tmp_path / "runs", "DualUR10/SineTracking-v0", (4,), observation="goals")
    to_lerobot(runs_of([tmp_path / "runs"]), tmp_path / "dataset")
    dataset = read_dataset(tmp_path / "dataset")
    assert np.allclose(dataset.columns[ACTION].reshape(-1, 2, 6), commanded[0], atol=1e-5)
    assert [each.difference for each in simulate_again(dataset)] == [""]


def test_what_cannot_be_exported_is_refused_and_leaves_nothing(made, tmp_path):
    runs, folder, _ = made
    (run,) = runs.iterdir()
    recorded(tmp_path / "slow", steps=(2,), policy_rate_hz=12.5)
    recorded(tmp_path / "other", "DualUR10/SineTracking-v0", (2,))
    recorded(tmp_path / "none", steps=())
    recorded(tmp_path / "wide", steps=(2,), cell=CellConfig(tools=("generic_140", "generic_140")))
    (slow,), (other,), (none,), (wide,) = ((tmp_path / each).iterdir() for each in ("slow", "other", "none", "wide"))
    target = tmp_path / "dataset"
    for chosen, error, message, options in (
        ([], DatasetError, "there is no run", {}),
        ([run, other], RecordingError, "is of another environment: env_id is 'DualUR10/SineTracking-v0'", {}),
        ([run, wide], RecordingError, r"gripper_stroke_m is \[0\.14, 0\.14\], and \[0\.085, 0\.085\] in the first", {}),
        ([slow], DatasetError, r"a step takes 0\.08 s: .* a whole number", {}),
        ([none], DatasetError, "no episode to export", {}),
        ([run], DatasetError, r"the task is 'Hand\\udc80', which is no Unicode text", {"task": "Hand\udc80"}),
        ([run], DatasetError, "no episode to export", {"successful": True}),
        ([tmp_path / "absent"], RecordingError, "cannot read", {}),
        ([run], DatasetError, "H.264 takes even sizes", {"cameras": ("front",), "size": (63, 80)}),
    ):
        with pytest.raises(error, match=message):
            to_lerobot(chosen, target, **options)
        assert [each for each in tmp_path.iterdir() if "dataset" in each.name] == []
    with pytest.raises(DatasetError, match="exists, and nothing is overwritten"):
        to_lerobot([run], folder)


@pytest.mark.parametrize("cameras", [(), ("front",)])
def test_a_full_disk_is_a_named_error_and_leaves_nothing(made, tmp_path, cameras):
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
    try:
        with pytest.raises(DatasetError, match=r"cannot write .*dataset: .*File too large"):
            to_lerobot(runs_of([made[0]]), tmp_path / "dataset", cameras=cameras, size=(64, 80))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert [*tmp_path.iterdir()] == []


def test_a_default_that_a_run_states_is_no_other_environment(made, tmp_path):
    recorded(tmp_path / "runs", steps=(2,), action_mode="joint_delta", observation="state", action_scale=1.0)
    found = to_lerobot(runs_of([made[0], tmp_path / "runs"]), tmp_path / "dataset")
    assert (found.episodes, found.frames) == (3, sum(STEPS) + 2)


def test_kept_demonstrations_are_the_successful_ones(tmp_path):
    """What a person kept, and nothing else, whatever the task itself reports."""
    env = gym.make("dual_ur10:DualUR10/Free-v0", record=str(tmp_path / "runs"))
    for number in range(3):
        env.reset(seed=number)
        for _ in range(2 + number):
            env.step(env.action_space.sample() * 0.0)
        if number:
            env.unwrapped.core.note(KEPT, json.dumps({"episode": number, "success": number == 2}))
    env.close()
    found = to_lerobot(runs_of([tmp_path / "runs"]), tmp_path / "dataset", successful=True)
    assert (found.episodes, found.frames) == (1, 4)
    assert read_dataset(tmp_path / "dataset").columns["next.success"].tolist() == [False, False, False, True]


def test_the_commands_export_and_import(made, tmp_path):
    runs, _, _ = made
    code, text = command("export", "lerobot", str(runs), "--out", str(tmp_path / "dataset"), "--task", "hand over")
    assert (code, text.strip().endswith("2 episodes, 14 frames at 25 per second")) == (0, True), text
    code, text = command("import", "lerobot", str(tmp_path / "dataset"), "--record", str(tmp_path / "runs"))
    assert code == 0
    assert "episode 1: 5 of 5 steps; commanded joints as in the dataset (at most 0 mrad apart)" in text
    assert len(read_run(next((tmp_path / "runs").iterdir())).episodes) == 2
    code, text = command("import", "lerobot", str(tmp_path / "dataset"), "--inspect")
    assert (code, "left_shoulder_pan.pos" in text, "episode 1" in text) == (0, True, False)
    assert command("import", "lerobot", str(tmp_path / "dataset"), "--set", "robot=ur5e")[0] == 2
    assert command("export", "lerobot", str(runs), "--out", str(tmp_path / "x"), "--size", "640")[0] == 2


def test_two_cameras_never_share_a_feature():
    assert image_keys(["front", "left/wrist", "front"]) == ["observation.images.front", "observation.images.left_wrist"]
    with pytest.raises(DatasetError, match="'left/wrist' and 'left_wrist' would both be"):
        image_keys(["left/wrist", "left_wrist"])


def test_a_run_of_controllers_has_the_images_that_its_cameras_took(tmp_path):
    pattern = {"name": "front", "kind": "pattern", "rate_hz": 30.0}
    shown = []
    with VirtualCell(file={"camera": [pattern]}) as cell:
        env = gym.make(
            "dual_ur10:DualUR10/SineTracking-v0", cell=cell, observation="both", cameras="front", width=96, height=72,
            record=tmp_path / "runs", confirm=lambda _: True,
        )  # fmt: skip
        for seed in range(2):
            found, _ = env.reset(seed=seed)
            for _ in range(8):
                shown.append(pattern_time_s(found["pixels"]["front"]))
                found, *_ = env.step(0.0 * env.action_space.sample())
        begin_s = env.unwrapped.core._hook.recorder.begin_s
        env.close()
    (folder,) = (tmp_path / "runs").iterdir()
    run = read_run(folder)
    times = np.concatenate([observed_s(run, each) for each in run.episodes])
    made = to_lerobot([folder], tmp_path / "dataset", cameras=("front",), size=(72, 96))
    assert (made.episodes, made.frames) == (2, 16)
    dataset = read_dataset(tmp_path / "dataset")
    written = []
    for video in sorted((dataset.folder / "videos").rglob("*.mp4")):
        with av.open(str(video)) as file:
            written += [pattern_time_s(frame.to_ndarray(format="rgb24")) for frame in file.decode(video=0)]
    ages = times - (np.array(written) - begin_s)
    assert ages.min() >= -1e-5  # none is newer than its observation
    assert ages.max() <= 1 / 30 + 1e-5
    # The policy saw the same, or the next one where that came while the state was read.
    later = (np.array(shown) - np.array(written)) * 30.0
    assert set(np.rint(later)) <= {0.0, 1.0}
    assert np.mean(np.rint(later)) < 0.2
    with pytest.raises(RecordingError, match="recorded without images of that camera"):
        to_lerobot([folder], tmp_path / "other", cameras=("side",), size=(72, 96))
    with pytest.raises(RecordingError, match="its images are 96 x 72 pixels, and 98 x 72 are asked for"):
        to_lerobot([folder], tmp_path / "other", cameras=("front",), size=(72, 98))
