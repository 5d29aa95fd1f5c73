"""The command `cell calibrate`, and what it writes, on a virtual cell."""

import dataclasses
import datetime
import functools
import json

import numpy as np
import pytest

from dual_ur10.emulated.cell_emulator import write_cell_file
from dual_ur10.errors import CalibrationError, CellFileError, SettingsError, StartError
from dual_ur10.sim2real.analysis.cell_update import write_bases
from dual_ur10.sim2real.calibration.estimate import estimate
from dual_ur10.sim2real.calibration.recording import emulated_base, read_joints
from dual_ur10.sim2real.calibration.transforms import right_in_left
from dual_ur10.sim2real.cell_file.cell_file import CellFile, load_cell_file
from dual_ur10.sim2real.cell_file.reference import starting_text
from dual_ur10.sim2real.runtime.rtde_cell import _check_bases
from dual_ur10.testing import VirtualCell
from tests.cli import command
from tests.sim2real.calibration.cells import NEAR, NOMINAL, PLANNED, shifted, touches

run = functools.partial(command.run, "cell", "calibrate")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    path = tmp_path_factory.mktemp("cell") / "cell.toml"
    with VirtualCell(task="SyncCarry", seed=3) as cell:
        write_cell_file(path, cell.description)
        yield cell, path


@pytest.fixture
def here(made, tmp_path, monkeypatch):
    cell, path = made
    for module in (
        "dual_ur10.sim2real.calibration.recording.emulated_base",
        "dual_ur10.sim2real.calibration.recording.read_joints",
    ):
        name = module.rsplit(".", 1)[1]
        monkeypatch.setattr(
            module,
            functools.partial({"emulated_base": emulated_base, "read_joints": read_joints}[name], system=cell.system),
        )
    file = tmp_path / "cell.toml"
    file.write_text("# of the lab\n" + path.read_text())
    return cell, file, tmp_path / "data.json"


def test_touches_of_an_emulated_cell_find_its_bases(here):
    cell, file, data = here
    code, text = run(str(file), "--data", str(data), "--touch", "8", "--write")
    assert code == 0, text
    assert "simulated 8 touches" in text
    assert f"{file.name}.bak" in text.replace("\n", "")
    before, after = load_cell_file(file.with_name("cell.toml.bak")), load_cell_file(file)
    true = emulated_base(before, system=cell.system)
    found = right_in_left(after.left.mount, after.right.mount)
    assert np.linalg.norm(found[:3, 3] - true[:3, 3]) < 3e-4
    assert np.linalg.norm(true[:3, 3] - NEAR[:3, 3]) > 3e-4
    assert after.left == before.left
    assert after.base_to_base.data == str(data)
    assert 0 < after.base_to_base.uncertainty_m < 5e-4
    assert after.right.base_uncertainty_m == pytest.approx(after.base_to_base.uncertainty_m, abs=2e-6)
    assert file.read_text().startswith("# of the lab\n")
    _check_bases(after)


def test_a_plan_is_printed_before_the_first_touch(here):
    _, file, data = here
    code, text = run(str(file), "--data", str(data), "--suggest")
    assert code == 0
    assert text.count("touch the point") == 8
    assert not data.exists()


def test_too_few_touches_name_the_next_one(here):
    _, file, data = here
    code, text = run(str(file), "--data", str(data), "--touch", "2", "--suggest")
    assert code == 2
    assert "2 touches leave a rotation about the line" in " ".join(text.split())
    assert "next: touch the point" in text
    assert len(json.loads(data.read_text())["observations"]) == 2  # nothing recorded is lost


def test_recorded_observations_are_in_the_file_at_once(here, monkeypatch):
    cell, file, data = here
    answers = iter(["", "", "q"])
    monkeypatch.setattr("dual_ur10.cli.calibrate.sys.stdin", type("Terminal", (), {"isatty": lambda self: True})())
    monkeypatch.setattr("builtins.input", lambda question: next(answers))
    from dual_ur10.cli import calibrate

    calibrate._record(load_cell_file(file), data, "touch", "1", NOMINAL, NEAR)
    observed = json.loads(data.read_text())["observations"]
    assert len(observed) == 2
    np.testing.assert_allclose(observed[0]["left_q_rad"], cell.emulator.world.read(0).q_rad, atol=1e-3)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("--record", "poke"), "unknown kind of observation"),
        (("--record", "touch"), "needs a terminal"),
        (("--write", "--out", "x.toml"), "leave one of them out"),
        (("--kinematics", "middle=controller"), "left=controller"),
        (("--kinematics", "left=none.yaml"), "cannot read none.yaml"),
        ((), "there is no data file"),
    ],
)
def test_bad_options_are_refused(here, arguments, text):
    _, file, data = here
    code, printed = run(str(file), "--data", str(data), *arguments)
    assert code == 2
    assert text in " ".join(printed.split())


@pytest.fixture
def lab(tmp_path):
    path = tmp_path / "lab.toml"
    path.write_text(starting_text("real", "192.168.1.10", "192.168.1.11"))
    return path


def found_base(**keywords):
    return estimate(touches(shifted(**keywords), np.random.default_rng(1)), NOMINAL, NEAR)


DAY = datetime.date(2026, 1, 31)


def test_the_uncertainty_of_the_left_base_stays_in_that_of_the_right_one(lab, tmp_path):
    out = tmp_path / "new.toml"
    before = lab.read_text()
    assert write_bases(lab, found_base(), "t.json", day=DAY, out=out) is None
    cell = load_cell_file(out)
    assert lab.read_text() == before
    assert cell.base_to_base.date == "2026-01-31"
    # 5 mm and 0.01 rad of the left base, over the distance of the bases.
    assert cell.right.base_uncertainty_m == pytest.approx(
        0.005 + 0.01 * 1.2 + cell.base_to_base.uncertainty_m, abs=1e-4
    )
    assert cell.relative_uncertainty == (cell.base_to_base.uncertainty_m, cell.base_to_base.uncertainty_rad)
    with pytest.raises(CellFileError, match="exists"):
        write_bases(lab, found_base(), "t.json", day=DAY, out=out)


def test_a_tilted_base_is_written(lab):
    found = found_base(rotation_rad=(0.006, -0.008, 0.02))
    write_bases(lab, found, "t.json", day=DAY)
    cell = load_cell_file(lab)
    np.testing.assert_allclose(right_in_left(cell.left.mount, cell.right.mount), found.pose, atol=2e-7)
    assert np.linalg.norm(cell.right.base_tilt_rad) == pytest.approx(0.01, abs=1e-3)
    assert cell.base_to_base.uncertainty_rad < 5e-4
    level = lab.read_text().replace(f"base_tilt_rad = {[*cell.right.base_tilt_rad]}", "base_tilt_rad = [0.0, 0.0]")
    lab.write_text(level)
    with pytest.raises(CellFileError, match=r"base_to_base: the bases stand .* 0\.01 rad otherwise"):
        load_cell_file(lab)


def test_a_base_on_a_slope_is_not_written(lab):
    before = lab.read_text()
    with pytest.raises(SettingsError, match=r"tilt_rad is .*: at most 5° about each axis .* Level the base"):
        write_bases(lab, found_base(rotation_rad=(0.1, 0.0, 0.0)), "t.json", day=DAY)
    assert lab.read_text() == before


def test_an_uncertain_base_is_not_written(lab):
    before = lab.read_text()
    with pytest.raises(CalibrationError, match=r"uncertain by .*--suggest.*Nothing was written"):
        write_bases(lab, found_base(), "t.json", day=DAY, accept_m=1e-4)
    assert lab.read_text() == before
    assert list(lab.parent.iterdir()) == [lab]


def data_of(observations, path):
    """Write touches to a data file."""
    rows = [{"kind": "touch", **{k: list(v) for k, v in vars(each).items()}} for each in observations]
    path.write_text(json.dumps({"observations": rows}))
    return path


ASKEW = shifted(rotation_rad=(0.0, 0.0, 0.4))
"""23° from the cell file's base."""


def plain(text):
    return " ".join(text.split())


def test_exchanged_arms_are_named_and_not_written(lab, tmp_path):
    right = [each.exchanged(tips=True) for each in touches(shifted(rotation_rad=(0, 0, 0)), np.random.default_rng(2))]
    before, data = lab.read_text(), data_of(right, tmp_path / "data.json")
    code, text = run(str(lab), "--data", str(data), "--write")
    assert code == 2
    assert "2.4 m and 0.0" in plain(text)
    assert "allowed are 0.3 m and 20°" in plain(text)
    assert "left and right are exchanged in the data" in plain(text)
    assert plain(text).count("allowed are 0.3 m") == 1  # the refusal, without a note before it
    assert lab.read_text() == before
    code, text = run(str(lab), "--data", str(data))
    assert code == 0
    assert "left and right are exchanged in the data" in plain(text)


def test_exchanged_addresses_exchange_no_tips(lab):
    tips = {"left_tcp_m": (0.0, 0.0, 0.17), "right_tcp_m": (0.02, 0.0, 0.3)}
    planned = [dataclasses.replace(each, **tips) for each in PLANNED]
    seen = [each.exchanged(tips=False) for each in touches(NEAR, np.random.default_rng(2), planned)]
    try:
        exchanged = estimate(seen, NOMINAL, NEAR).exchanged
    except CalibrationError as error:
        exchanged = "left and right are exchanged" in str(error)
    assert exchanged


def test_a_base_far_away_needs_moved(lab, tmp_path):
    data = data_of(touches(ASKEW, np.random.default_rng(2)), tmp_path / "data.json")
    before = lab.read_text()
    code, text = run(str(lab), "--data", str(data), "--write")
    assert code == 2
    assert "22.9°" in text
    assert "give --moved" in plain(text)
    assert "exchanged" not in text
    assert lab.read_text() == before
    code, text = run(str(lab), "--data", str(data), "--write", "--moved")
    assert code == 0, text
    assert "22.9°" in text  # still told
    assert load_cell_file(lab).right.base_yaw_rad == pytest.approx(0.4, abs=1e-3)


def test_a_carry_needs_known_bases(lab):
    cell = load_cell_file(lab)
    with pytest.raises(StartError, match=r"uncertain by 22 mm and 0.02 rad.*cell calibrate"):
        _check_bases(cell)
    none = {"base_uncertainty_m": 0.0, "base_uncertainty_rad": 0.0}
    with pytest.raises(StartError, match=r"does not state.*cell calibrate"):
        _check_bases(cell.replace(left=cell.left.replace(**none), right=cell.right.replace(**none)))
    write_bases(lab, found_base(), "t.json", day=DAY)
    _check_bases(load_cell_file(lab))


def test_a_carry_on_an_emulated_cell_with_uncertain_bases_does_not_start():
    import gymnasium as gym

    description = {"right": {"base_uncertainty_m": 0.003}}
    with VirtualCell(task="SyncCarry", plant="nominal") as cell:
        right = {**cell.description["right"], **description["right"]}
        cell.file = CellFile.read({**cell.description, "right": right}, "lab.toml")
        with pytest.raises(StartError, match=r"cell calibrate lab.toml"):
            gym.make("DualUR10/SyncCarry-v0", cell=cell)


def test_bases_moved_by_hand_after_a_calibration_are_found(lab):
    write_bases(lab, found_base(), "t.json", day=DAY)
    lab.write_text(
        lab.read_text().replace("base_position_m = [-0.75, 0.6, 0.0]", "base_position_m = [-0.75, 0.61, 0.0]")
    )
    with pytest.raises(CellFileError, match=r"base_to_base: the bases stand 10 mm .*cell calibrate"):
        load_cell_file(lab)
