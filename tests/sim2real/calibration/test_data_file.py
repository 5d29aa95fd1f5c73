"""The data file: what is read, what is refused, and that nothing recorded is lost."""

import datetime
import json
import threading

import pytest

from dual_ur10.errors import CalibrationError
from dual_ur10.sim2real.calibration import data_file
from dual_ur10.sim2real.calibration.data_file import BarEntry, DataFile, TouchEntry, append, parse, read
from dual_ur10.sim2real.calibration.observations import BarPose, BoardView, Noise, Touch

NOW = datetime.datetime(2026, 1, 31, 12, 0, 0, tzinfo=datetime.UTC)
Q = (0.0, -1.5, 1.5, -1.5, -1.5, 0.1)
TOUCH = TouchEntry(left_q_rad=Q, right_q_rad=Q, left_tcp_m=(0.0, 0.0, 0.17), right_tcp_m=(0.0, 0.0, 0.2))
VIEW = {"kind": "board", "camera_on": "left", "board_on": "right", "left_q_rad": Q, "right_q_rad": Q}
POSE = {"position_m": (0.0, 0.0, 0.5), "rotation_rad": (0.0, 0.1, 0.0)}


def test_observations_are_appended_and_read_back(tmp_path):
    path = tmp_path / "data.json"
    assert append(path, TOUCH, NOW) == 1
    assert append(path, BarEntry(left_q_rad=Q, right_q_rad=Q, grasp="second"), NOW) == 2
    content = read(path)
    assert [each.time for each in content.observations] == ["2026-01-31T12:00:00+00:00"] * 2
    assert content.measured(tmp_path) == [Touch(Q, Q, (0.0, 0.0, 0.17), (0.0, 0.0, 0.2)), BarPose(Q, Q, "second")]
    assert content.standard_deviations() == Noise()


def test_two_programs_that_record_at_the_same_time_lose_nothing(tmp_path, monkeypatch):
    path, write = tmp_path / "data.json", data_file.write_text
    other = threading.Thread(target=append, args=(path, TOUCH, NOW))

    def slowly(*arguments):
        monkeypatch.setattr(data_file, "write_text", write)
        other.start()
        other.join(0.2)  # it waits, or has read the file as it was
        write(*arguments)

    monkeypatch.setattr(data_file, "write_text", slowly)
    append(path, TOUCH, NOW)
    other.join()
    assert len(read(path).observations) == 2


def test_noise_board_and_cameras_stay_when_observations_are_appended(tmp_path):
    path = tmp_path / "data.json"
    given = {
        "noise": {"touch_m": 2e-4},
        "board": {"squares_x": 7, "squares_y": 5, "square_m": 0.04, "marker_m": 0.03},
        "cameras": {"left": {"matrix_px": (900.0, 900.0, 640.0, 480.0)}},
        "observations": [{**VIEW, **POSE}],
    }
    path.write_text(json.dumps(given))
    append(path, TOUCH, NOW)
    content = read(path)
    assert content.noise.touch_m == 2e-4
    assert content.board.squares_x == 7
    assert content.cameras["left"].matrix_px[2] == 640.0
    view, touch = content.measured(tmp_path)
    assert isinstance(view, BoardView)
    assert isinstance(touch, Touch)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", ("no data file", "Correct these places")),
        (b"[1, 2", ("no data file",)),
        (b'{"observation": []}', ("observation", "Extra inputs")),
        (b'{"observations": [{"kind": "tap"}]}', ("observations 1", "touch")),
        (b'{"observations": [{"kind": "touch", "left_q_rad": [1, 2]}]}', ("observations 1 touch left_q_rad",)),
        (
            b'{"observations": [{"kind": "bar", "left_q_rad": [1,2,3,4,5,NaN], "right_q_rad": [1,2,3,4,5,6]}]}',
            ("no data",),
        ),
        (b'{"noise": {"touch_m": "small"}}', ("noise touch_m",)),
        (b'{"cameras": {"roof": {"matrix_px": [1, 1, 1, 1]}}}', ("cameras roof",)),
        (b" " * (data_file.MAX_BYTES + 1), ("longer than",)),
    ],
)
def test_bad_files_are_refused_with_the_place(content, words):
    with pytest.raises(CalibrationError) as refused:
        parse(content, "data.json")
    for word in ("data.json", *words):
        assert word in str(refused.value)


def test_a_damaged_file_is_not_overwritten(tmp_path):
    path = tmp_path / "data.json"
    path.write_text('{"observations": [')
    with pytest.raises(CalibrationError, match="no data file of a calibration"):
        append(path, TOUCH, NOW)
    assert path.read_text() == '{"observations": ['


def test_a_missing_file_says_how_to_record(tmp_path):
    with pytest.raises(CalibrationError, match="--record touch"):
        read(tmp_path / "none.json")


@pytest.mark.parametrize(
    ("entries", "text"),
    [
        ([VIEW], "observation 1: a view needs either"),
        ([{**VIEW, **POSE, "image": "a.png"}], "either `image`, or"),
        (
            [{**VIEW, **POSE}, {**VIEW, "image": "a.png"}],
            "observation 2: there are images, and the file has no `board`",
        ),
        ([{**VIEW, **POSE, "board_on": "left"}], "relates no arms"),
        ([{**VIEW, "image": "a.png", "board_on": "left"}], "no `board`"),
    ],
)
def test_incomplete_views_are_refused(entries, text, tmp_path):
    content = DataFile.model_validate_json(json.dumps({"observations": entries}))
    with pytest.raises(CalibrationError, match=text):
        content.measured(tmp_path)


def test_noise_out_of_range_is_refused():
    with pytest.raises(CalibrationError, match="touch_m"):
        parse(b'{"noise": {"touch_m": 7}}').standard_deviations()
