"""Known lookaheads and latencies are found again, and written into cell files without loss."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dual_ur10.cli import records
from dual_ur10.errors import CellFileError, RecordingError
from dual_ur10.sim2real.analysis.cell_update import write_back
from dual_ur10.sim2real.analysis.fit import ArmFit, Estimate, fit, remark, respond
from dual_ur10.sim2real.cell_file.cell_file import load_cell_file
from dual_ur10.sim2real.cell_file.tables import Measured
from tests.sim2real.analysis.made import header, motion, run, with_arm
from tests.soak import scaled
from ur_core.servoj import ServojLaw

PART_S = 0.001  # of a made-up run


@settings(max_examples=scaled(300))
@given(st.floats(0.03, 0.2), st.floats(100.0, 2000.0), st.integers(0, 2**32))
def test_the_response_is_that_of_the_law(lookahead_s: float, gain: float, seed: int) -> None:
    targets = motion(300, 0.008)[:, 0] + np.random.default_rng(seed).normal(0, 1e-3, (300, 6))
    step, rows = ServojLaw(lookahead_s, gain).transition(0.008), []
    state = np.array([targets[0], np.zeros(6)])
    for target in targets:
        held = np.array([target, np.zeros(6)])
        state = step @ (state - held) + held
        rows.append(state[0])
    times = np.arange(300) * 0.008
    found = respond(times, targets, targets[0], lookahead_s, gain, times + 0.008)
    assert found == pytest.approx(np.array(rows), abs=1e-8)


def test_the_response_of_a_law_without_overshoot_or_swing_is_right_too() -> None:
    targets, times = motion(300, 0.008)[:, 0], np.arange(300) * 0.008
    exact = respond(times, targets, targets[0], 0.2, 100.0, times)  # damping 1: a double root
    near = respond(times, targets, targets[0], 0.2 * (1 + 1e-5), 100.0, times)
    assert exact == pytest.approx(near, abs=1e-5)
    assert respond(times + 1.0, targets, targets[0], 0.03, 2000.0, times[:100]) == pytest.approx(
        np.repeat(targets[:1], 100, axis=0)
    )


@settings(max_examples=scaled(200, 40), suppress_health_check=list(HealthCheck))
@given(
    st.floats(0.03, 0.12),
    st.floats(0.03, 0.12),
    st.integers(0, 40),
    st.integers(0, 40),
    st.sampled_from([0.0, 1e-5, 1e-4]),
    st.integers(0, 2**32),
)
def test_known_lookahead_and_latency_are_found_again(
    left_s: float, right_s: float, left_late: int, right_late: int, noise_rad: float, seed: int
) -> None:
    made = run(lookahead_s=(left_s, right_s), delay_parts=(left_late, right_late), noise_rad=noise_rad, seed=seed)
    for found, lookahead_s, late in zip(fit(made), (left_s, right_s), (left_late, right_late), strict=True):
        assert found.law.reason == ""
        assert found.law.lookahead_s == pytest.approx(lookahead_s, abs=1e-6)
        assert found.law.latency_s == pytest.approx(late * PART_S, abs=1e-6)
        assert found.arm.reason == ""
        assert found.arm.lookahead_s == found.law.lookahead_s
        assert abs(found.arm.latency_s - late * PART_S) <= 5 * found.arm.latency_sigma_s + 1e-6
        assert found.arm.latency_sigma_s < 1e-4
        assert found.arm.rms_rad == pytest.approx(noise_rad, rel=0.1, abs=1e-8)


@settings(max_examples=scaled(100, 33), suppress_health_check=list(HealthCheck))
@given(st.floats(0.03, 0.12), st.integers(0, 30), st.integers(0, 2**32))
def test_both_are_found_from_measured_joints_alone(lookahead_s: float, late: int, seed: int) -> None:
    made = run(lookahead_s=(lookahead_s, 0.03), delay_parts=(late, 0), noise_rad=2e-5, seed=seed, offset_rad=2e-3)
    for log in made.arms:
        del log.state["target_q_rad"]
    found, other = fit(made)
    assert "does not hold" in found.law.reason
    assert np.isnan(found.law.lookahead_s)
    for each, true_s, parts in ((found.arm, lookahead_s, late), (other.arm, 0.03, 0)):
        assert abs(each.lookahead_s - true_s) <= 5 * each.lookahead_sigma_s
        assert abs(each.latency_s - parts * PART_S) <= 5 * each.latency_sigma_s
        assert 0 < each.lookahead_sigma_s < 1e-3
        assert each.lookahead_s == pytest.approx(true_s, abs=1e-3)


def test_uneven_targets_are_fitted_at_their_times() -> None:
    made = run(noise_rad=0.0)
    rng = np.random.default_rng(1)
    sent_s = made.arms[0].sent["sent_s"] + rng.uniform(0, 0.004, 750)
    period = np.delete(np.arange(750.0), [200, 201, 400])
    sent = {name: np.delete(values, [200, 201, 400], axis=0) for name, values in made.arms[0].sent.items()}
    sent |= {"sent_s": np.delete(sent_s, [200, 201, 400]), "period": period}
    begin = made.episodes[0].begin_s
    state_s = made.arms[0].state["arrival_s"]
    path = respond(sent["sent_s"] - begin, sent["target_rad"], sent["target_rad"][0], 0.05, 2000.0, state_s - begin)
    found = fit(with_arm(made, 0, sent=sent, state={"q_rad": path, "target_q_rad": path}))[0]
    assert found.law.lookahead_s == pytest.approx(0.05, abs=1e-7)
    assert found.law.latency_s == pytest.approx(0.0, abs=1e-7)


def test_what_cannot_be_fitted_has_a_reason() -> None:
    still = fit(run(size=0.0))[0]
    assert "targets of the arm do not move" in still.law.reason
    assert "targets of the arm do not move" in still.arm.reason
    assert np.isnan([still.arm.lookahead_s, still.arm.latency_s, still.arm.latency_sigma_s]).all()
    assert "too short" in fit(run(seconds=0.4))[0].arm.reason
    made = run()
    stuck = np.repeat(made.arms[0].state["q_rad"][:1], 751, axis=0)
    assert "the arm did not move" in fit(with_arm(made, 0, state={"q_rad": stuck}))[0].arm.reason
    other = made.arms[0].state["q_rad"][::-1]
    found = fit(with_arm(made, 0, state={"q_rad": other, "target_q_rad": other}))[0].law
    assert "law" in found.reason
    with pytest.raises(RecordingError, match=r"servoj was called with lookahead_s=0\.0"):
        fit(run(servoj=[{"lookahead_s": 0.0, "gain": 2000.0}, {"lookahead_s": 0.03, "gain": 2000.0}]))
    with pytest.raises(RecordingError, match="there is no number 3"):
        fit(made, 3)


# Cell files.

CELL = """# My cell, measured in May.
kind = "emulated"
left = { host = "127.0.0.2" }  # inline

[right]
host = "127.0.0.3"  # as on the screen
payload_kg = 0.5

[right.limits]
speed_rad_s = 0.5
"""


def estimate(**values: float) -> Estimate:
    return Estimate(**{**dict.fromkeys(Estimate.__dataclass_fields__, 0.0), "reason": "", **values})


def fits(lookahead_s: float = 0.0312345678, latency_s: float = 0.0041, **more: float) -> list[ArmFit]:
    each = estimate(lookahead_s=lookahead_s, latency_s=latency_s, **more)
    return [ArmFit(each, each, 0.03, 2000.0)] * 2


def emulated(**values: Any) -> Any:
    return header(source="emulated", **values)


@pytest.mark.parametrize(
    "text",
    [
        CELL,
        CELL.replace('left = { host = "127.0.0.2" }  # inline', '[left]\nhost = "127.0.0.2"'),
        CELL.replace("\n", "\r\n"),
        CELL.rstrip(),
        CELL + "\n[right.measured]  # long ago\nlookahead_s = 0.05  # slow\nlatency_s = 0.01\n# the end\n",
        CELL + "\n[right.measured]\nlatency_s = 0.01\n[[obstacle]]\nname = 'w'\nkind = 'plane'\n"
        "point_m = [2.0, 0, 0]\nnormal = [-1.0, 0, 0]\n",
        CELL + "[right.gripper]\nkind = 'none'\n",
        CELL + "\n[right.measured]\n# fitted in May\n\nlookahead_s = 0.05\n",
        CELL.replace("payload_kg = 0.5", "payload_kg = 0.5\nmeasured = { lookahead_s = 0.04 }"),
        CELL.replace("payload_kg = 0.5", "payload_kg = 0.5\nmeasured.lookahead_s = 0.04"),
    ],
)
def test_what_was_measured_is_written_and_nothing_is_lost(tmp_path: Path, text: str) -> None:
    path = tmp_path / "lab.toml"
    path.write_bytes(text.encode())
    before = load_cell_file(path)
    kept = write_back(path, emulated(), fits())
    assert kept == tmp_path / "lab.toml.bak"
    assert kept.read_bytes() == text.encode()
    measured = Measured(lookahead_s=0.031235, latency_s=0.0041)
    after = load_cell_file(path)
    assert after == before.replace(
        left=before.left.replace(measured=measured), right=before.right.replace(measured=measured)
    )
    comments = [each.strip() for each in re.findall("#.*", text)]
    assert len(comments) > 1
    assert all(each in path.read_text() for each in comments)
    path.chmod(0o600)
    again = write_back(path, emulated(), fits(latency_s=0.005))
    assert again == tmp_path / "lab.toml.bak1"
    assert kept.read_bytes() == text.encode()
    assert load_cell_file(again) == after
    assert load_cell_file(path).left.measured.latency_s == 0.005
    assert path.stat().st_mode & 0o777 == 0o600
    assert sorted(each.name for each in tmp_path.iterdir()) == ["lab.toml", "lab.toml.bak", "lab.toml.bak1"]


def test_a_latency_just_below_zero_is_none(tmp_path: Path) -> None:
    path = tmp_path / "lab.toml"
    path.write_text(CELL)
    write_back(path, emulated(), fits(latency_s=-1e-5))
    assert load_cell_file(path).right.measured.latency_s == 0.0


@pytest.mark.parametrize(
    ("head", "found", "words"),
    [
        (header(), fits(), "only a run of this cell"),
        (header(source="real"), fits(), "only a run of this cell"),
        (emulated(family="e-series"), fits(), "e-series controllers"),
        (emulated(servoj=[{"lookahead_s": 0.05, "gain": 2000.0}] * 2), fits(), "lookahead_s = 0.05"),
        (emulated(cell_file="kind = 1"), fits(), "cell file is not legal"),
        (emulated(), fits(lookahead_sigma_s=0.004), "too uncertain"),
        (emulated(), fits(latency_sigma_s=float("nan")), "too uncertain"),
        (emulated(), fits(latency_s=-0.02), "no figures of a controller"),
        (emulated(), fits(lookahead_s=0.6), "no figures of a controller"),
        (
            emulated(),
            [ArmFit(estimate(), estimate(reason="it did not move"), 0.03, 2000.0)] * 2,
            "left: .* it did not move",
        ),
    ],
)
def test_what_must_not_be_written_is_refused(tmp_path: Path, head: Any, found: Any, words: str) -> None:
    path = tmp_path / "lab.toml"
    path.write_text(CELL)
    with pytest.raises(RecordingError, match=words):
        write_back(path, head, found)
    assert path.read_text() == CELL
    assert [each.name for each in tmp_path.iterdir()] == ["lab.toml"]


def test_a_run_of_other_robots_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "lab.toml"
    from dual_ur10.sim2real.cell_file.reference import starting_text

    path.write_text(starting_text("real", "192.168.1.10", "192.168.1.11"))
    other = starting_text("real", "192.168.1.10", "192.168.1.12")
    with pytest.raises(RecordingError, match=r"right: .*192\.168\.1\.12"):
        write_back(path, header(source="real", cell_file=other), fits())
    write_back(path, header(source="real", cell_file=path.read_text()), fits())
    assert path.read_text().startswith("# A cell of two arms")  # comments stay


def test_an_illegal_cell_file_stays_as_it_is(tmp_path: Path) -> None:
    path = tmp_path / "lab.toml"
    path.write_text("kind = 3\n")
    with pytest.raises(CellFileError):
        write_back(path, emulated(), fits())
    assert path.read_text() == "kind = 3\n"
    assert [each.name for each in tmp_path.iterdir()] == ["lab.toml"]


@pytest.mark.parametrize(
    ("latency_s", "words"),
    [
        (0.0, ""),
        (0.004, ""),
        (-0.004217, "counts as 0"),
        (-0.0081, "counts as 0"),
        (-0.012, "no controller's is"),
    ],
)
def test_a_latency_below_zero_is_explained(latency_s: float, words: str) -> None:
    found = remark(Estimate(0.03, latency_s, 1e-4, 1e-4, 1e-5), 0.008)
    assert (words in found) if words else not found
    assert not remark(replace(Estimate(0.03, latency_s, 1e-4, 1e-4, 1e-5), reason="too short"), 0.008)


def test_fit_reports_it_at_the_terminal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    early = Estimate(0.03, -0.004217, 1e-4, 1e-4, 1e-5)
    arm = ArmFit(early, replace(early, latency_s=0.001), 0.03, 2000.0)
    monkeypatch.setattr("dual_ur10.sim2real.analysis.fit.fit", lambda run, episode: (arm, arm))
    monkeypatch.setattr("dual_ur10.sim2real.recording.reader.read_run", lambda path, allow_partial: run(1.0))
    with records.console.capture() as shown:
        records.fit(tmp_path)
    text = shown.get()
    assert text.count("counts as 0") == 2
    assert "note: left, controller alone: the latency is below 0" in text
