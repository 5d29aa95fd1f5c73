"""Cameras of a cell: kinds, their processes, and what an environment observes of them."""

import contextlib
import dataclasses
import itertools
import shutil
import time
from fractions import Fraction

import av
import gymnasium as gym
import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import dual_ur10  # noqa: F401  # registers the environments
from dual_ur10.assets.scene import build_model
from dual_ur10.envs.rendering.images import Canvas
from dual_ur10.errors import CellFaulted, CellFileError, LinkError, RecordingError, SettingsError, UnknownNameError
from dual_ur10.sim2real.cameras import camera_process
from dual_ur10.sim2real.cameras.camera_memory import SLOTS, CameraMemory
from dual_ur10.sim2real.cameras.camera_process import CameraProcess
from dual_ur10.sim2real.cameras.camera_source import CameraRequest, CameraSource, Exposure, source_of
from dual_ur10.sim2real.cameras.image_size import check_fits, resized
from dual_ur10.sim2real.cameras.pattern_camera import pattern, pattern_time_s
from dual_ur10.sim2real.cameras.video_record import VideoRecord, read_video, video_name
from dual_ur10.sim2real.cell_file.cell_file import CellFile
from dual_ur10.sim2real.cell_file.tables import (
    FileCameraEntry,
    OwnCameraEntry,
    PatternCameraEntry,
    V4l2CameraEntry,
)
from dual_ur10.sim2real.recording.reader import read_run
from dual_ur10.sim2real.recording.recorded_images import RecordedImages
from dual_ur10.testing import VirtualCell
from ur_core.processes.system import LOCAL

SIZE = (48, 64)
SMALL = {"kind": "emulated", "left": {"host": "127.0.0.2"}, "right": {"host": "127.0.0.3"}}
REST = np.zeros(12, dtype=np.float32)
FRONT = {"name": "front", "kind": "pattern", "rate_hz": 30.0}


class Shaky(CameraSource):
    """Camera of one's own: what it does after some images is an option."""

    def __init__(self, request, then="grow", images=3):
        self._request, self._then, self._left = request, then, images
        if then == "absent":
            raise OSError("no such camera")

    def read(self):
        clock = self._request.system.clock
        clock.sleep(0.02)
        self._left -= 1
        size = SIZE
        if self._left < 0:
            if self._then == "end":
                raise LinkError("unplugged")
            if self._then == "crash":
                raise ZeroDivisionError("a bug")
            if self._then == "hang":
                clock.sleep(1000.0)
            size = (96, 128)
        return Exposure(np.full((*size, 3), 7, np.uint8), clock.now_s())


class NoCamera:
    """No camera at all."""


def file_of(*entries, **more):
    return CellFile.read({**SMALL, **more, "camera": list(entries)})


def request_of(entry, size=SIZE, **more):
    return CameraRequest(entry=entry, file=file_of(), size=size, **more)


def own(**options):
    text = " ".join(f"{name}={value}" for name, value in options.items())
    return OwnCameraEntry(name="front", camera=f"{__name__}:Shaky", options=text)


def until(condition, within_s=10.0):
    end = time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.005)


# Images.


@settings(max_examples=60)
@given(st.floats(0.0, 1e8), st.sampled_from([(14, 16), (48, 64), (480, 640), (61, 83)]))
def test_a_pattern_shows_its_time_to_a_microsecond(time_s, size):
    assert abs(pattern_time_s(pattern(time_s, size)) - time_s) <= 1e-6


@settings(max_examples=60)
@given(st.integers(1, 40), st.integers(1, 40), st.integers(1, 60), st.integers(1, 80), st.integers(0, 2**31 - 1))
def test_images_of_another_size_are_means(high, wide, height, width, seed):
    own_size, wanted = (height, width), (high, wide)
    image = np.random.default_rng(seed).integers(0, 256, (*own_size, 3), dtype=np.uint8)
    try:
        check_fits(own_size, wanted, "it")
    except SettingsError:
        assert high > height or wide * height > width * high
        return
    found = resized(image, wanted)
    assert found.shape == (*wanted, 3)
    assert found.dtype == np.uint8
    constant = np.full_like(image, seed % 256)
    np.testing.assert_array_equal(resized(constant, wanted), seed % 256)
    middle = image[:, (width - round(height * wide / high)) // 2 :][:, : round(height * wide / high)]
    if middle.size and middle.shape[1] >= wide:
        assert abs(float(found.mean()) - float(middle.mean())) < 0.51


def test_halves_are_exact():
    image = np.zeros((4, 6, 3), np.uint8)
    image[:2, :2] = [[[1], [2]], [[3], [5]]]
    assert resized(image, (2, 3))[0, 0].tolist() == [3, 3, 3]  # 11 / 4
    square = resized(image, (2, 2))
    assert square.shape == (2, 2, 3)  # out of the middle, as a simulated camera with that field of view


# Memory.


@settings(max_examples=50)
@given(st.integers(0, 3 * SLOTS), st.integers(-1, 3 * SLOTS))
def test_the_newest_image_is_not_newer_than_asked(count, until_s):
    memory = CameraMemory((2, 2))
    for number in range(count):
        memory.put(Exposure(np.full((2, 2, 3), number, np.uint8), float(number)))
    found = memory.newest(float(until_s))
    kept = [each for each in range(max(0, count - SLOTS + 1), count) if each <= until_s]
    assert (None if found is None else found.exposed_s) == (kept[-1] if kept else None)
    if found is not None:
        assert (found.image == int(found.exposed_s)).all()
    memory.close()


# Kinds.


def write_video(path, frames, fps=50, size=SIZE):
    with av.open(str(path), "w") as file:
        stream = file.add_stream("libx264", rate=fps, options={"crf": "20"})
        stream.height, stream.width, stream.pix_fmt = *size, "yuv420p"
        stream.time_base = Fraction(1, fps)
        for number in range(frames):
            image = np.full((*size, 3), 40 * number, np.uint8)
            file.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        file.mux(stream.encode(None))


@pytest.mark.parametrize("repeat", [False, True])
def test_a_video_is_played_at_the_times_of_its_frames(tmp_path, repeat):
    write_video(tmp_path / "it.mp4", 5)
    with VirtualCell() as cell:
        entry = FileCameraEntry(name="front", file=str(tmp_path / "it.mp4"), repeat=repeat)
        begin_s = cell.now_s
        with source_of(request_of(entry, system=cell.system)) as source:
            found = [source.read() for _ in range(5 + 3 * repeat)]
            if not repeat:
                with pytest.raises(LinkError, match=r"the video has ended.*repeat = true"):
                    source.read()
        shades = [round(float(each.image.mean()) / 40) for each in found]
        assert shades == [0, 1, 2, 3, 4, 0, 1, 2][: len(found)]
        np.testing.assert_allclose([each.exposed_s - begin_s for each in found], np.arange(len(found)) / 50, atol=1e-6)


@pytest.mark.parametrize(
    ("content", "words"), [(None, "there is no video file"), (b"no video", "is no video"), (b"", "is no video")]
)
def test_a_file_that_is_no_video_is_refused(tmp_path, content, words):
    if content is not None:
        (tmp_path / "it.mp4").write_bytes(content)
    with pytest.raises(LinkError, match=words):
        source_of(request_of(FileCameraEntry(name="front", file=str(tmp_path / "it.mp4"))))


class FakeDevice:
    """PyAV's view of a camera: packets with the time stamps of a driver."""

    def __init__(self, stamps, size=(48, 64), lost=None):
        self.options, self.lost, self.closed = {}, lost, False
        self.streams = type("", (), {"video": [self]})()
        self.codec_context = type("", (), {"height": size[0], "width": size[1]})()
        self._packets = [self._packet(each) for each in stamps]

    @staticmethod
    def _packet(stamp):
        frame = av.VideoFrame.from_ndarray(np.full((48, 64, 3), 9, np.uint8), format="rgb24")
        pts = None if stamp is None else round(1e6 * stamp)
        return type("", (), {"pts": pts, "time_base": Fraction(1, 10**6), "decode": lambda _: [frame]})()

    def demux(self, stream):
        yield from self._packets
        if self.lost is not None:
            raise self.lost

    def close(self):
        self.closed = True

    def opened(self, path, **arguments):
        self.path, self.options = path, arguments
        return self


def v4l2(monkeypatch, device, **entry):
    monkeypatch.setattr(av, "open", device.opened)
    return source_of(request_of(V4l2CameraEntry(name="front", device="/dev/video0", width=64, height=48, **entry)))


def test_times_of_a_linux_camera_are_those_of_its_driver(monkeypatch):
    now_s = LOCAL.clock.now_s()
    device = FakeDevice([now_s - 0.03, now_s - 5.0, None, now_s + 1e6, now_s - 0.02])
    source = v4l2(monkeypatch, device, delay_s=0.01, format="yuyv422", rate_hz=20.0)
    assert device.path == "/dev/video0"
    assert device.options["format"] == "v4l2"
    assert device.options["options"] == {
        "video_size": "64x48", "framerate": "20", "input_format": "yuyv422", "timestamps": "default",
    }  # fmt: skip
    times = [source.read().exposed_s for _ in range(5)]
    assert times[0] == pytest.approx(now_s - 0.04, abs=1e-6)
    # Stamps of another clock, of the future, or none: those of arrival.
    assert times[1:4] == pytest.approx([now_s - 0.01] * 3, abs=0.5)
    assert times[4] == pytest.approx(now_s - 0.03, abs=1e-6)
    with pytest.raises(LinkError, match="sends no more images"):
        source.read()
    source.close()
    assert device.closed


def test_images_of_a_linux_camera_that_waited_are_left_out(monkeypatch):
    now_s = LOCAL.clock.now_s()
    source = v4l2(monkeypatch, FakeDevice([now_s - 0.5, now_s - 0.4, now_s - 0.01]))
    assert source.read().exposed_s == pytest.approx(now_s - 0.01, abs=1e-6)


def test_a_linux_camera_that_is_busy_absent_or_of_another_size(monkeypatch):
    def refuse(path, **arguments):
        raise av.error.OSError(16, "Device or resource busy", path)

    busy = FakeDevice([])
    busy.opened = refuse
    with pytest.raises(LinkError, match=r"video0 cannot be opened at 64 x 48.*busy"):
        v4l2(monkeypatch, busy)
    device = FakeDevice([], size=(24, 32))
    with pytest.raises(LinkError, match="gives 32 x 24 pixels, and 64 x 48 are in the cell file"):
        v4l2(monkeypatch, device)
    assert device.closed
    lost = FakeDevice([], lost=av.error.OSError(19, "No such device"))
    with pytest.raises(LinkError, match=r"was lost: .*No such device"):
        v4l2(monkeypatch, lost).read()


@pytest.mark.parametrize(
    ("entry", "error", "words"),
    [
        (OwnCameraEntry(name="a", camera=f"{__name__}:NoCamera"), SettingsError, "no subclass of CameraSource"),
        (OwnCameraEntry(name="a", camera="nowhere:Camera"), SettingsError, "nowhere"),
        (own(colour="red"), SettingsError, "the options colour=red"),
        (own(then="absent"), LinkError, "no such camera"),
        (PatternCameraEntry(name="a"), SettingsError, "too small for a clock"),
    ],
)
def test_cameras_that_cannot_be_made(entry, error, words):
    with pytest.raises(error, match=words):
        source_of(request_of(entry, size=(10, 10)))


# Processes.


def test_a_camera_has_a_process_that_ends_with_it():
    camera = CameraProcess(request_of(PatternCameraEntry(name="front", rate_hz=100.0)))
    camera.wait_until_ready(LOCAL.clock.now_s() + 20.0)
    for _ in range(3):
        now_s = LOCAL.clock.now_s()
        found = camera.newest(now_s)
        assert found.exposed_s <= now_s
        assert abs(pattern_time_s(found.image) - found.exposed_s) < 1e-3
    pid = camera.pid
    assert LOCAL.is_running(pid)
    camera.close()
    assert not LOCAL.is_running(pid)
    camera.close()


def test_a_camera_that_hangs_ends_with_its_program(monkeypatch, tmp_path):
    monkeypatch.setattr(camera_process, "_END_S", 5.0)  # it ends by itself, and is not killed
    camera = CameraProcess(request_of(own(then="hang", images=9)))
    camera.memory.record(str(tmp_path / "it.mp4"), LOCAL.clock.now_s())
    camera.wait_until_ready(LOCAL.clock.now_s() + 20.0)
    until(lambda: camera.memory.count == 9)
    until(lambda: LOCAL.clock.now_s() - camera.memory.times_s[-1] > camera_process.STALE_S)
    with pytest.raises(LinkError, match=r"camera front \(own\) stalls: the newest image is 0\.\d+ s old"):
        camera.newest(LOCAL.clock.now_s())
    killed = []
    monkeypatch.setattr(type(camera._process), "kill", lambda self: killed.append(self))
    camera.close()
    assert not killed
    assert not LOCAL.is_running(camera.pid)
    assert len(list(read_video(tmp_path / "it.mp4"))) == 9


@pytest.mark.parametrize(
    ("then", "words"),
    [
        ("grow", "has changed the size of its images from 64 x 48 to 128 x 96"),
        ("end", "unplugged"),
        ("crash", "ZeroDivisionError"),
    ],
)
def test_a_camera_that_is_lost_is_named(then, words):
    with VirtualCell() as cell:
        camera = CameraProcess(request_of(own(then=then), system=cell.system))
        camera.wait_until_ready(cell.now_s + 1.0)
        cell.clock.sleep(0.2)
        with pytest.raises(LinkError, match=words):
            camera.newest(cell.now_s)
        camera.close()


# Environments.


def make(cell, task="SineTracking", **keywords):
    given = {"observation": "both", "cameras": ("front",), "height": SIZE[0], "width": SIZE[1], **keywords}
    return gym.make(f"DualUR10/{task}-v0", cell=cell, disable_env_checker=True, **given)


@pytest.mark.parametrize("observation", ["state", "both", "flat"])
def test_the_newest_image_not_newer_than_the_observation(observation):
    with VirtualCell(file={"camera": [FRONT]}) as cell:
        env = make(cell, observation=observation)
        found, info = env.reset(seed=0)
        if observation == "state":  # no camera is opened
            assert env.unwrapped.core.cell.images is None
            assert "image_age_s/front" not in info
        for _ in range(6 * (observation != "state")):
            images = found["pixels"] if observation == "both" else found
            age_s, shown_s = info["image_age_s/front"], pattern_time_s(images["front"])
            assert env.observation_space.contains(found)
            assert 0.0 <= age_s <= 1 / 30 + 1e-6  # a newer one would not be older than the observation
            assert shown_s + age_s == pytest.approx(env.unwrapped.core.cell.images.looked_s, abs=1e-5)
            found, *_, info = env.step(REST)
        env.close()


def test_a_vector_environment_of_one_cell_has_images_and_ages():
    with VirtualCell(file={"camera": [FRONT]}) as cell:
        env = gym.make_vec(
            "DualUR10/SineTracking-v0", num_envs=1, cell=cell, observation="pixels", cameras="front",
            autoreset_mode="Disabled", height=SIZE[0], width=SIZE[1],
        )  # fmt: skip
        found, info = env.reset(seed=0)
        assert found["front"].shape == (1, *SIZE, 3)
        assert info["_image_age_s/front"].tolist() == [True]
        found, *_, info = env.step(REST[None])
        shown_s = pattern_time_s(found["front"][0]) + info["image_age_s/front"][0]
        assert shown_s == pytest.approx(env.unwrapped.core.cell.images.looked_s, abs=1e-5)
        env.close()


def test_images_are_kept_as_long_as_the_rate_asks():
    with VirtualCell(file={"camera": [FRONT]}) as cell:
        env = make(cell, pixels_rate_hz=12.5)
        found, _ = env.reset(seed=0)
        times, ages = [pattern_time_s(found["pixels"]["front"])], []
        for _ in range(4):
            found, *_, info = env.step(REST)
            times.append(pattern_time_s(found["pixels"]["front"]))
            ages.append(info["image_age_s/front"])
        env.close()
        assert [a == b for a, b in itertools.pairwise(times)] == [True, False, True, False]
        assert max(ages) > 0.04


def test_the_emulated_camera_sees_what_a_simulation_shows():
    """The image is that of a simulation with the arms and the block where they are."""
    with VirtualCell(task="Handover", plant="nominal") as cell:
        env = make(cell, "Handover", cameras=("front", "left/wrist"))
        env.reset(seed=0)
        for _ in range(20):  # until the grippers rest, too
            found, *_ = env.step(np.zeros(14, dtype=np.float32))
        core = env.unwrapped.core
        model = build_model(core.config.scene)
        data = mujoco.MjData(model)
        core.copy_state(0, model, data)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_camlight(model, data)
        canvas = Canvas(model, SIZE[1], SIZE[0])
        for name, image in found["pixels"].items():
            expected = canvas.image(data, name).astype(int)
            assert np.abs(expected - image).mean() <= 2.0
            assert image.std() > 10
        canvas.close()
        env.close()


def step_until_stopped(env):
    for _ in range(400):
        env.step(REST)


@pytest.mark.parametrize("then", ["grow", "hang"])
def test_a_lost_camera_stops_both_arms_where_the_task_observes_it(then):
    entry = {"name": "front", "kind": "own", "camera": f"{__name__}:Shaky", "options": f"then={then} images=300"}
    with VirtualCell(file={"camera": [entry]}) as cell:
        env = make(cell)
        env.reset(seed=0)
        with pytest.raises(CellFaulted, match="camera front"):
            step_until_stopped(env)
        assert "camera front" in cell.fault
        env.close()


def test_the_file_of_a_cell_names_its_cameras():
    with VirtualCell() as cell:
        with pytest.raises(UnknownNameError, match="camera 'back'"):
            make(cell, cameras=("back",))
        cell.file = cell.file.replace(emulator=None)
        with pytest.raises(CellFileError, match=r"the camera 'front' is observed.*\[\[camera\]\]"):
            make(cell)


def test_the_simulated_camera_stands_where_the_real_one_does():
    placed = {**FRONT, "position_m": [0.5, 0.0, 1.0], "target_m": [0.0, 0.0, 0.0], "fovy_rad": 0.5}
    bench = {**FRONT, "name": "bench", "position_m": [0.0, 1.0, 1.0], "target_m": [0.0, 0.0, 0.0]}
    cell = file_of(placed, bench).simulated()
    env = gym.make(
        "DualUR10/SineTracking-v0",
        cell=cell,
        disable_env_checker=True,
        observation="pixels",
        cameras=("front", "bench"),
    )
    model, _ = env.unwrapped.core.cell_data(0)
    assert model.camera("front").pos.tolist() == [0.5, 0.0, 1.0]
    assert model.camera("front").fovy[0] == pytest.approx(np.degrees(0.5))
    assert model.camera("bench").pos.tolist() == [0.0, 1.0, 1.0]
    env.close()


# Videos beside a record.


def test_a_run_has_a_video_of_each_observed_camera_with_true_times(tmp_path):
    wrist = {"name": "side", "kind": "pattern", "rate_hz": 10.0}
    with VirtualCell(file={"camera": [FRONT, wrist]}) as cell:
        env = make(cell, cameras=("front", "side"), record=tmp_path)
        env.reset(seed=0)
        for _ in range(10):
            env.step(REST)
        begin_s = env.unwrapped.core._hook.recorder.begin_s
        env.close()
    (folder,) = tmp_path.iterdir()
    for name, rate_hz in (("front", 30.0), ("side", 10.0)):
        found = list(read_video(folder / video_name(name)))
        times = np.array([time_s for time_s, _ in found])
        shown = np.array([pattern_time_s(image) for _, image in found])
        np.testing.assert_allclose(shown - begin_s, times, atol=5e-6)
        np.testing.assert_allclose(np.diff(times), 1 / rate_hz, atol=2e-6)
        assert len(found) > 4
    assert video_name("left/wrist") != video_name("left_wrist")


def test_cameras_that_nothing_observes_are_recorded_and_their_failure_is_a_note(tmp_path):
    lost = {"name": "side", "kind": "own", "camera": f"{__name__}:Shaky", "options": "then=end images=20"}
    absent = {"name": "overhead", "kind": "file", "file": "nowhere.mp4"}
    with VirtualCell(file={"camera": [FRONT, lost, absent]}) as cell:
        env = make(cell, observation="state", record=tmp_path)
        env.reset(seed=0)
        for _ in range(10):
            env.step(REST)  # it goes on
        env.close()
        assert not cell.fault
    (folder,) = tmp_path.iterdir()
    times = [pattern_time_s(image) for _, image in read_video(folder / video_name("front"))]
    assert len(times) > 10
    np.testing.assert_allclose(np.diff(times), 1 / 30, atol=2e-6)
    assert len(list(read_video(folder / video_name("side")))) > 10
    notes = [event.text for event in read_run(folder).events if event.kind == "camera"]
    assert len(notes) == 2
    assert any("camera side (own) is not recorded: unplugged" in each for each in notes)
    assert any("there is no video file nowhere.mp4" in each for each in notes)


def waits(*, system):
    system.clock.sleep(1000.0)


@pytest.mark.parametrize("orphan", [False, True])
@pytest.mark.parametrize("entry", [own(then="hang", images=7), PatternCameraEntry(name="front", rate_hz=0.1)])
def test_a_video_is_complete_although_the_camera_makes_its_process_wait(tmp_path, entry, orphan):
    with VirtualCell() as cell:
        request = request_of(entry, system=cell.system)
        memory, program = CameraMemory(request.kept), cell.system.spawn(waits)
        memory.record(str(tmp_path / "it.mp4"), cell.now_s)
        own_system = dataclasses.replace(request, system=LOCAL)
        cell.system.spawn(camera_process.main, memory.name, own_system, program.pid)
        cell.clock.sleep(23.0)
        if orphan:
            program.kill()
        else:
            memory.end()
        cell.clock.sleep(0.5)
        assert len(list(read_video(tmp_path / "it.mp4"))) == memory.count > 1
        memory.close()


@pytest.mark.parametrize("rate_hz", [0.4, 1.0, 2.04, 5.0, 30.0])
def test_a_video_that_was_cut_off_loses_its_last_second_or_its_last_image(tmp_path, rate_hz):
    video = VideoRecord(tmp_path / "it.mp4", SIZE, 0.0)
    for number in range(max(4, round(2.5 * rate_hz))):
        video.add(Exposure(np.full((*SIZE, 3), 7, np.uint8), number / rate_hz))
        if number and number % max(1, round(rate_hz / 5)) == 0:
            shutil.copy(tmp_path / "it.mp4", tmp_path / "cut.mp4")
            least = number if rate_hz <= 1.0 else number - rate_hz  # images of before the last second
            try:
                found = len(list(read_video(tmp_path / "cut.mp4")))
            except RecordingError:
                found = 0
            assert found >= least
    video.close()


def test_a_video_that_was_cut_off_within_an_image_is_read_up_to_it(tmp_path):
    path, noise = tmp_path / "it.mp4", np.random.default_rng(0)
    video = VideoRecord(path, SIZE, 0.0)
    for number in range(20):
        video.add(Exposure(noise.integers(0, 256, (*SIZE, 3), dtype=np.uint8), number / 10))
    video.close()
    content = path.read_bytes()
    for part in (0.4, 0.6, 0.8):
        path.write_bytes(content[: round(part * len(content))])
        times = [time_s for time_s, _ in read_video(path)]
        assert len(times) > 20 * part - 4
        np.testing.assert_allclose(times, np.arange(len(times)) / 10, atol=1e-6)


def test_an_image_of_a_slow_camera_lasts_until_the_next_one(tmp_path):
    video = VideoRecord(tmp_path / video_name("front"), SIZE, 0.0)
    for number in range(3):
        video.add(Exposure(np.full((*SIZE, 3), 40 * number, np.uint8), 4.0 * number))
    video.close()
    recorded = RecordedImages(tmp_path, ("front",))
    found = {time_s: recorded.at(time_s) for time_s in (1.5, 3.9, 4.0, 9.0, 21.0)}
    assert [round(each["front"].mean() / 40) for each in found.values() if each] == [0, 0, 1, 2]
    assert not found[21.0]  # later than three periods


def test_a_video_is_readable_where_its_process_was_killed(tmp_path):
    camera = CameraProcess(request_of(PatternCameraEntry(name="front", rate_hz=10.0)))
    camera.wait_until_ready(LOCAL.clock.now_s() + 20.0)
    camera.memory.record(str(tmp_path / "it.mp4"), LOCAL.clock.now_s())

    def readable():
        with contextlib.suppress(RecordingError):  # nothing is written yet
            return len(list(read_video(tmp_path / "it.mp4")))
        return 0

    until(lambda: readable() > 1, 60.0)  # its images are written when the machine has time for it
    camera._process.kill()
    assert readable() > 1
    with pytest.raises(LinkError, match="its process has ended"):
        camera.newest(LOCAL.clock.now_s())
    camera.close()


def test_a_video_that_cannot_be_written_is_a_note(tmp_path):
    with VirtualCell() as cell:
        camera = CameraProcess(request_of(PatternCameraEntry(name="front"), system=cell.system))
        camera.wait_until_ready(cell.now_s + 1.0)
        camera.memory.record(str(tmp_path / "nowhere" / "it.mp4"), cell.now_s)
        cell.clock.sleep(0.2)
        assert "cannot write" in camera.memory.failure
        assert camera.newest(cell.now_s).exposed_s > cell.now_s - 0.1
        camera.close()
    with pytest.raises(RecordingError, match="is no video of a camera"):
        list(read_video(tmp_path / "none.mp4"))
