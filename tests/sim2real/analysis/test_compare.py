"""Two runs beside each other: what is known of made-up ones is found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dual_ur10.errors import RecordingError
from dual_ur10.sim2real.analysis.compare import compare
from dual_ur10.sim2real.analysis.parity import parity
from dual_ur10.sim2real.analysis.series import interpolate, lag, smoothed, spread
from dual_ur10.sim2real.analysis.timing import LATE_S, ripple_of, timing
from dual_ur10.sim2real.analysis.tracks import flange_of, track, tracks
from dual_ur10.sim2real.recording.header import mounts_of
from dual_ur10.sim2real.recording.run import LATE
from tests.sim2real.analysis.made import DH, header, run, with_arm, with_stops
from tests.soak import scaled

TICK_S = 0.008


@settings(max_examples=scaled(200))
@given(st.floats(-0.2, 0.2), st.floats(0.3, 1.0), st.integers(0, 2**32))
def test_a_lag_is_found_between_samples(shift: float, hertz: float, seed: int) -> None:
    times = np.arange(1200) * TICK_S
    phases = np.random.default_rng(seed).uniform(0, 6, 6)
    early, late = (np.sin(2 * np.pi * hertz * (times[:, None] - away) + phases) for away in (0.0, shift))
    found = lag(late, early, TICK_S)
    assert found.reason == ""
    assert found.value == pytest.approx(shift, abs=5e-5)


@pytest.mark.parametrize(
    ("late", "early", "words"),
    [
        (np.zeros((10, 6)), np.zeros((10, 6)), "too short"),
        (np.zeros((200, 6)), np.sin(np.arange(200))[:, None] * np.ones(6), "the arm did not move"),
        (np.sin(np.arange(200) / 9)[:, None] * np.ones(6), np.zeros((200, 6)), "the arm did not move"),
        (np.arange(400.0)[:, None] ** 2, np.arange(400.0)[::-1, None] ** 2, "not alike"),
        (np.arange(400.0)[:, None], np.arange(400.0)[:, None], "no peak"),
    ],
)
def test_what_has_no_lag_says_why(late: np.ndarray, early: np.ndarray, words: str) -> None:
    found = lag(late + 1e-9 * np.sin(np.arange(len(late)))[:, None], early, TICK_S)
    assert words in found.reason or words == "no peak"
    assert np.isnan(found.value) or words == "no peak"


def test_a_run_is_equal_to_itself() -> None:
    found = compare(run(episodes=2), run(episodes=2))
    for arm in found.arms:
        assert arm.lag.value == pytest.approx(0.0, abs=1e-12)
        assert arm.found.flange_m == (0.0, 0.0, 0.0)
        assert all(each == (0.0, 0.0, 0.0) for each in arm.found.joints_rad)
        assert arm.found.angle_rad.most == 0.0
        assert (arm.sent.compared, arm.sent.equal, arm.sent.first) == (1500, 1500, None)
        assert arm.sent.is_exact
    assert found.vector_m == (0.0, 0.0, 0.0)
    assert found.notes == ()
    assert found.step_s == TICK_S
    assert len(found.pairs) == 2


@pytest.mark.parametrize("first_index", [0, 4711])
def test_each_arms_lag_is_found_and_taken_off(first_index: int) -> None:
    found = compare(run(), run(delay_parts=(4, 12), first_index=first_index))
    for arm, parts in zip(found.arms, (4, 12), strict=True):
        assert arm.lag.value == pytest.approx(parts * TICK_S / 8, abs=2e-5)
        assert arm.free is not None
        assert arm.free.flange_m.most < 0.02 * arm.found.flange_m.most
        assert arm.found.flange_m.rms > 1e-3
        assert arm.sent.is_exact
    assert found.vector_free_m.most < 0.02 * found.vector_m.most


def test_a_constant_offset_is_seen_where_it_is() -> None:
    found = compare(run(offset_rad=1e-3), run())
    plain = compare(run(), run())
    for arm, each in enumerate(found.arms):
        assert [joint.rms for joint in each.found.joints_rad] == pytest.approx([1e-3] * 6)
        assert each.lag.value == pytest.approx(0.0, abs=1e-4)
        # The vector points from B to A.
        pair = found.pairs[0]
        expected = (flange_of(mounts_of(header())[arm], pair.q_rad[0, :, arm])[0]
                    - flange_of(mounts_of(header())[arm], pair.q_rad[1, :, arm])[0]).mean(axis=0)  # fmt: skip
        assert each.found.flange_mean_m == pytest.approx(expected)
        assert np.linalg.norm(expected) > 1e-4
        assert each.found.flange_m.rms > plain.arms[arm].found.flange_m.rms + 1e-4


def test_flanges_are_by_each_runs_own_kinematics() -> None:
    moved = [{"position_m": [-0.75 + 0.003, y, 0.0], "yaw_rad": 0.0, "dh": DH} for y in (0.6, -0.6)]
    found = compare(run(mounts=moved), run())
    for arm in found.arms:
        assert arm.found.flange_mean_m == pytest.approx([0.003, 0.0, 0.0], abs=1e-12)
        assert arm.found.flange_m.rms == pytest.approx(0.003)
        assert [each.most for each in arm.found.joints_rad] == [0.0] * 6
    assert found.vector_m.most == pytest.approx(0.0, abs=1e-12)
    assert "bases or calibrations differ" in " ".join(found.notes)


@pytest.mark.parametrize("slower", [0.25, 0.5])
def test_runs_at_different_speeds_are_one_motion_on_the_tasks_clock(slower: float) -> None:
    found = compare(run(), run(slower=slower, speed_factor=slower))
    for arm in found.arms:
        # 34 ms behind its targets, which is less of the task's time.
        assert arm.lag.value == pytest.approx(-0.034 * (1 - slower), abs=6e-4)
        assert arm.free is not None
        assert arm.free.flange_m.rms < 3e-4
        assert arm.sent.is_exact
        assert arm.sent.compared > 700
    assert "speed factors differ: 1 in run A" in " ".join(found.notes)


def test_the_same_actions_at_another_latency_are_the_same_targets() -> None:
    found = compare(run(), run(latency_ticks=5))
    for arm in found.arms:
        assert arm.sent.is_exact
        assert arm.sent.later == 5
        assert arm.sent.compared == 745
        assert arm.lag.value == pytest.approx(0.04, abs=2e-5)


def test_one_bit_of_one_target_is_seen() -> None:
    made = run()
    targets = made.arms[1].sent["target_rad"].copy()
    targets[300, 2] = np.nextafter(targets[300, 2], 9.0)
    found = compare(made, with_arm(made, 1, sent={"target_rad": targets}))
    assert found.arms[0].sent.is_exact
    assert not found.arms[1].sent.is_exact
    assert (found.arms[1].sent.equal, found.arms[1].sent.compared) == (749, 750)
    assert found.arms[1].sent.first == (0, 300)


def test_nothing_sent_is_not_exact() -> None:
    assert not parity([]).is_exact


def test_arms_that_do_not_move_give_reasons_instead_of_figures() -> None:
    still = run(size=0.0)
    found = compare(still, still)
    for arm in found.arms:
        assert "the arm did not move" in arm.lag.reason
        assert arm.free is None
        assert arm.found.flange_m.most == 0.0
    assert np.isnan(found.vector_free_m.rms)
    for each in found.timing:
        for arm in each.arms:
            assert np.isnan(arm.behind.value)
            assert arm.behind.reason
            assert np.isnan(arm.ripple.size_m_s.rms)
            assert "faster than" in arm.ripple.reason
            assert "two episodes" in arm.repeatability.reason


@pytest.mark.parametrize(
    ("a", "b", "words"),
    [
        (run(seconds=2.0), run(seconds=2.0, env_id="DualUR10/Handover-v0"), "only runs of one task"),
        (run(seconds=2.0), replace(run(seconds=2.0), episodes=[]), "run B has no episode"),
        (run(seconds=2.0), run(seconds=0.16), "share 0.1"),
        (
            run(seconds=2.0),
            run(seconds=2.0, mounts=[{"position_m": [0, 0, 0], "yaw_rad": 0.0, "dh": {**DH, "a_m": [0] * 6}}] * 2),
            "another robot",
        ),
        (run(seconds=2.0), run(seconds=2.0, mounts=[{}, {}]), "another robot"),
    ],
)
def test_what_cannot_be_compared_is_refused(a: object, b: object, words: str) -> None:
    with pytest.raises(RecordingError, match=words):
        compare(a, b)  # type: ignore[arg-type]


def test_an_arm_without_rows_is_refused() -> None:
    made = run(seconds=2.0)
    nothing = {name: values[:0] for name, values in made.arms[0].sent.items()}
    with pytest.raises(RecordingError, match=r"left: 0 targets .* 2 or more are needed"):
        compare(made, with_arm(made, 0, sent=nothing))
    nothing = {name: values[:1] for name, values in made.arms[1].state.items()}
    with pytest.raises(RecordingError, match=r"right: [01] states .* 2 or more are needed"):
        compare(with_arm(made, 1, state=nothing), made)


def test_fewer_episodes_and_a_cut_off_run_are_noted() -> None:
    found = compare(run(seconds=2.0, episodes=3), replace(run(seconds=2.0, episodes=2), complete=False))
    assert len(found.pairs) == 2
    assert "3 and 2 episodes: the first 2" in " ".join(found.notes)
    assert "run B was cut off" in " ".join(found.notes)


@pytest.mark.parametrize("short", [0, 1, 2])
def test_an_episode_with_too_little_is_left_out(short: int) -> None:
    made, whole = run(seconds=2.0, episodes=3), run(seconds=2.0, episodes=3)
    episodes = list(made.episodes)
    # It was ended by a reset before its first step.
    episodes[short] = replace(
        episodes[short], action=np.zeros((0, 12)), targets_rad=np.zeros((0, 5, 2, 6)), reward=np.zeros(0)
    )
    for a, b in ((replace(made, episodes=episodes), whole), (whole, replace(made, episodes=episodes))):
        found = compare(a, b)
        assert [each.number for each in found.pairs] == [k for k in range(3) if k != short]
        assert f"episode {short} was left out: left: 0 targets were recorded" in " ".join(found.notes)
        assert found.arms[0].sent.is_exact
        assert [each.arms[0].late.targets for each in found.timing] == [500 + 250 * (each is whole) for each in (a, b)]
    with pytest.raises(RecordingError, match="0 targets were recorded"):
        compare(replace(made, episodes=episodes[short : short + 1]), whole)


def test_a_black_box_is_compared_with_nothing() -> None:
    whole = run(seconds=2.0, episodes=2)
    within = replace(whole, episodes=[replace(whole.episodes[0], first_step=7), whole.episodes[1]])
    found = compare(whole, within)
    assert [each.number for each in found.pairs] == [1]
    assert "in run B it begins with its step 7" in " ".join(found.notes)
    assert (
        "of 1 episodes" in found.timing[1].arms[0].repeatability.reason or found.timing[1].arms[0].repeatability.reason
    )
    with pytest.raises(RecordingError, match="in run A it begins with its step 7, as in a black box"):
        compare(replace(within, episodes=within.episodes[:1]), whole)


def test_states_that_are_years_apart_fill_no_memory() -> None:
    made = run(seconds=2.0)
    state = {name: values.copy() for name, values in made.arms[0].state.items()}
    sent = {name: values.copy() for name, values in made.arms[0].sent.items()}
    for values in (state["arrival_s"], state["timestamp_s"], sent["sent_s"]):
        values[-1] += 1e8
    with pytest.raises(RecordingError, match=r"left: \d+ states were recorded in 1000000\d\d s of episode 0"):
        timing(with_arm(made, 0, state=state, sent=sent))


def test_environments_that_differ_are_mentioned() -> None:
    a = run(seconds=2.0, kwargs={"amplitude_m": 0.03, "cell": {"x": 1}, "randomization": "mild"})
    b = run(seconds=2.0, kwargs={"amplitude_m": 0.1, "axis": "z"})
    text = " ".join(compare(a, b).notes)
    assert "amplitude_m of the environment differs: 0.03 in run A, 0.1 in run B" in text
    assert "axis of the environment differs: not given in run A, 'z' in run B" in text
    assert "cell of" not in text
    assert "randomization of" not in text


def test_targets_of_other_control_periods_are_not_compared() -> None:
    found = compare(run(seconds=2.0), run(seconds=2.0, family="e-series", tick_s=0.002))
    assert found.arms[0].sent.compared == 0
    assert "control periods differ" in " ".join(found.notes)


# Actions that missed their deadline, and clocks that do not run steadily.


@pytest.mark.parametrize("latency", [0, 5])
@pytest.mark.parametrize("late", [(40,), (40, 41), (30, 90), (0, 60), (60, 149)])
def test_after_a_stop_the_same_actions_are_compared(late: tuple[int, ...], latency: int) -> None:
    found = compare(run(latency_ticks=latency), with_stops(at=late, latency_ticks=latency, pause=77))
    for arm in found.arms:
        assert arm.sent.is_exact, arm.sent
        # Ticks of the dropped actions are compared with nothing, and at the end, those of which nothing was sent.
        dropped = 5 * len(late) - (latency if 149 in late else 0) + (latency if 0 in late else 0)
        assert arm.sent.compared == 750 - dropped
    pair = found.pairs[0]
    quiet = pair.time_s > (max(each for each in late if each < 149) + 25) * 0.04
    quiet &= pair.time_s < (149 * 0.04 if 149 in late else 9.0)
    apart = np.linalg.norm(pair.flange_m[0] - pair.flange_m[1], axis=-1)[quiet]
    assert len(apart) > 100
    assert apart.max() < 1e-4
    word = "1 action missed its" if len(late) == 1 else f"{len(late)} actions missed their"
    assert f"run B: {word} deadline" in " ".join(found.notes)
    assert np.diff(tracks(with_stops(at=late), 0)[0].task_s).min() > 0.0


def test_only_late_actions_of_compared_episodes_are_reported() -> None:
    late = run(episodes=2)
    firsts = late.episodes[1].first_target.copy()
    firsts[[3, 40]] = LATE
    late.episodes[1] = replace(late.episodes[1], first_target=firsts)
    assert not [note for note in compare(run(), late).notes if "missed" in note]
    assert any(note.startswith("run B: 2 actions missed") for note in compare(run(episodes=2), late).notes)


def test_a_run_with_stops_is_read_to_its_end() -> None:
    plain, made = tracks(run(), 0), tracks(with_stops(at=(20, 50, 80), pause=60), 0)
    for ours, theirs in zip(plain, made, strict=True):
        assert theirs.index[-1] == ours.index[-1] == 749
        assert theirs.task_s[-1] == pytest.approx(ours.task_s[-1], abs=1e-9)
        assert len(theirs.index) == 750 + 3 * (60 - 5)
        assert theirs.stopped.sum() == 3 * 60


def test_skew_is_between_equal_targets_whatever_stops_there_were() -> None:
    found = timing(with_stops(at=(20, 90), sent_later_s=0.7e-3))
    assert np.abs(found.skews_s + 0.7e-3).max() < 1e-9
    assert len(found.skews_s) > 700


@pytest.mark.parametrize("seed", range(3))
def test_a_clock_that_loses_time_mistimes_no_state(seed: int) -> None:
    made, plain = run(), run()
    rng = np.random.default_rng(seed)
    for arm in range(2):
        state = plain.arms[arm].state
        at_s = state["arrival_s"]
        # The clock stalls for long, and then runs at half the speed for a while.
        lives = ~((at_s > 3.1) & (at_s < 4.0)) & ~((at_s > 4.5) & (at_s < 5.7) & (np.arange(len(at_s)) % 2 == 0))
        delayed_s = np.where(rng.random(len(at_s)) < 0.3, rng.exponential(0.002, len(at_s)), 0.0)
        kept = {name: values[lives] for name, values in state.items()}
        kept["arrival_s"] = np.maximum.accumulate(at_s + delayed_s)[lives]
        kept["timestamp_s"] = 500.0 + TICK_S * np.arange(lives.sum())
        made = with_arm(made, arm, state=kept)
        found, expected = track(made, 0, arm), track(plain, 0, arm)
        mistimed_s = np.abs(found.time_s - expected.time_s[lives[-len(expected.time_s) :]])
        assert len(mistimed_s) == lives.sum() - 1
        assert np.median(mistimed_s) < 1e-9
        assert mistimed_s.max() < 0.015
    notes = " ".join(compare(plain, made).notes)
    for arm in ("left", "right"):
        assert f"run B: the clock of the {arm} controller did not run steadily" in notes
    assert "off by up to 1.4" in notes or "off by up to 1.5" in notes
    assert "run A: the clock" not in notes


def test_a_clock_that_is_fast_mistimes_no_state() -> None:
    made, plain = run(), run()
    for arm in range(2):
        stamps_s = 500.0 + 1.05 * plain.arms[arm].state["timestamp_s"]
        made = with_arm(made, arm, state={"timestamp_s": stamps_s})
        found, expected = (track(each, 0, arm).time_s for each in (made, plain))
        assert np.abs(found[-740:] - expected[-740:]).max() < 0.015
    assert "off by up to 0.29" in " ".join(compare(plain, made).notes)


def test_targets_of_a_clock_that_loses_time_are_due_when_they_were_sent() -> None:
    made = run()
    sent = made.arms[0].sent
    behind_s = 1.3 * (sent["sent_s"] > 4.0)
    period = sent["period"] - np.floor(behind_s / TICK_S)
    again = track(with_arm(made, 0, sent={"period": period}), 0, 0)
    assert np.abs(again.task_s - track(made, 0, 0).task_s).max() < 1e-9


def test_clocks_that_drift_as_clocks_do_are_not_mentioned() -> None:
    made = first = run(20.0)
    for arm in range(2):
        stamps_s = made.arms[arm].state["timestamp_s"]
        made = with_arm(made, arm, state={"timestamp_s": stamps_s * (1 + 3e-4)})
    assert compare(first, made).notes == ()


def test_seeds_that_differ_are_mentioned() -> None:
    made = run(seconds=2.0, episodes=2)
    other = replace(made, episodes=[made.episodes[0], replace(made.episodes[1], seed=9)])
    assert "seeds differ: 3, none in run A, 3, 9 in run B" in compare(made, other).notes
    replayed = replace(other, header=replace(other.header, extra={"replays": {"run": "a", "sha256": "", "episode": 0}}))
    assert not any("seeds" in each for each in compare(made, replayed).notes)


# Timing of one run.


@pytest.mark.parametrize(("lookahead_s", "parts"), [(0.03, 0), (0.05, 4), (0.1, 24)])
def test_the_lag_behind_the_targets_is_that_of_the_law(lookahead_s: float, parts: int) -> None:
    made = run(8.0, lookahead_s=(lookahead_s, 0.03), delay_parts=(parts, 0))
    # The phase of the law at the motion's frequency is nearly its lookahead; a held target is half a tick later.
    rate = np.pi
    expected = np.arctan2(lookahead_s * rate, 1 - rate**2 / 2000) / rate + TICK_S / 2 + parts * TICK_S / 8
    found = timing(made)
    assert found.arms[0].behind.value == pytest.approx(expected, abs=7e-4)
    assert found.arms[1].behind.value == pytest.approx(0.034, abs=5e-4)


def test_skew_is_the_time_between_sends_of_the_same_target() -> None:
    made = run()
    sent_s = made.arms[0].sent["sent_s"].copy()
    sent_s += 0.3e-3
    sent_s[100] += 2e-3
    found = timing(with_arm(made, 0, sent={"sent_s": sent_s}))
    assert len(found.skews_s) == 750
    assert found.skew_s.most == pytest.approx(2.3e-3)
    assert np.median(found.skews_s) == pytest.approx(0.3e-3)  # left later
    assert found.skew_reason == ""


def test_late_and_missed_targets_are_counted() -> None:
    made = run()
    late_s = np.zeros(750)
    late_s[[5, 6, 7]], late_s[8] = 2.1e-3, 9e-3
    period = made.arms[0].sent["period"].copy()
    period[200:] += 3
    found = timing(with_arm(made, 0, sent={"late_s": late_s, "period": period})).arms[0].late
    assert (found.targets, found.late, found.missed, found.most_s) == (750, (4, 1), 3, 9e-3)
    assert found.ratios == pytest.approx((4 / 750, 1 / 750))
    assert LATE_S == (0.002, 0.008)


def test_ripple_excludes_slow_motion() -> None:
    times = np.arange(2000) * 0.002
    path = np.stack([0.1 * np.sin(np.pi * times), 0 * times, 0 * times], axis=1)
    assert ripple_of(path, 0.002).max() < 2e-5
    shaking = path + np.stack([0 * times, 1e-5 * np.sin(2 * np.pi * 40 * times), 0 * times], axis=1)
    speed = 1e-5 * 2 * np.pi * 40
    found = spread(ripple_of(shaking, 0.002))
    assert found.rms == pytest.approx(speed / np.sqrt(2), rel=0.1)
    assert len(ripple_of(path[:10], 0.002)) == 0
    assert len(ripple_of(0 * path, 0.002)) == 0


def test_repeatability_is_the_spread_of_the_first_poses() -> None:
    made = run(seconds=1.0, episodes=4)
    mount = mounts_of(made.header)[0]
    away = [0.0, 1e-4, -1e-4, 2e-4]
    episodes = []
    for each, angle in zip(made.episodes, away, strict=True):
        q = each.q_rad.copy()
        q[0, 0, 0] += angle
        episodes.append(replace(each, q_rad=q))
    found = timing(replace(made, episodes=episodes)).arms[0].repeatability
    flanges = np.array([flange_of(mount, each.q_rad[:1, 0])[0][0] for each in episodes])
    distance = np.linalg.norm(flanges - flanges.mean(axis=0), axis=1)
    assert found.episodes == 4
    assert found.most_m == pytest.approx(distance.max())
    assert found.iso_m == pytest.approx(distance.mean() + 3 * distance.std(ddof=1))
    episodes[1] = replace(episodes[1], q_rad=episodes[1].q_rad + 0.1)
    assert timing(replace(made, episodes=episodes)).arms[0].repeatability.episodes == 3
    other = [replace(each, q_rad=each.q_rad + k) for k, each in enumerate(episodes)]
    assert "no other begins" in timing(replace(made, episodes=other)).arms[0].repeatability.reason


def test_states_are_timed_by_the_controllers_clock() -> None:
    made = run()
    rng = np.random.default_rng(0)
    arrival_s = made.arms[0].state["arrival_s"]
    late = arrival_s + np.where(rng.random(len(arrival_s)) < 0.7, rng.exponential(0.003, len(arrival_s)), 0.0)
    found = track(with_arm(made, 0, state={"arrival_s": np.maximum.accumulate(late)}), 0, 0)
    plain = track(made, 0, 0)
    kept = slice(0, min(len(found.time_s), len(plain.time_s)) - 2)
    assert np.abs(found.time_s[kept] - plain.time_s[kept]).max() < 1e-4


def test_episodes_do_not_leak_into_each_other() -> None:
    made = run(seconds=2.0, episodes=3)
    # Without a pause, as in simulation: the last state of one episode is when the next begins.
    count = 250
    sent = {name: values.reshape(3, count, *values.shape[1:]) for name, values in made.arms[0].sent.items()}
    logs = []
    for log in made.arms:
        state = {name: values.reshape(3, count + 1, *values.shape[1:])[:, 1:] for name, values in log.state.items()}
        times = (np.arange(3)[:, None] * count + np.arange(1, count + 1)) * TICK_S
        state["arrival_s"] = state["timestamp_s"] = times
        sent = {name: values.reshape(3, count, *values.shape[1:]) for name, values in log.sent.items()}
        sent["sent_s"] = times - TICK_S
        sent["index"] = sent["period"] = np.arange(3.0 * count).reshape(3, count)
        logs.append([{k: v.reshape(-1, *v.shape[2:]) for k, v in each.items()} for each in (state, sent)])
    episodes = [
        replace(each, begin_s=k * count * TICK_S, first_target=each.first_target + k * count)
        for k, each in enumerate(made.episodes)
    ]
    glued = replace(made, episodes=episodes)
    for arm, (state, rows) in enumerate(logs):
        glued = with_arm(glued, arm, state=state, sent=rows)
    for number in range(3):
        for each in tracks(glued, number):
            assert len(each.index) == count
            assert each.index[0] == 0.0
            assert len(each.time_s) == count
            assert each.time_s[0] == pytest.approx(TICK_S)
            assert each.task_s == pytest.approx(each.time_s)


def test_an_episode_that_is_not_there_is_refused() -> None:
    with pytest.raises(RecordingError, match="has 1 episodes"):
        track(run(seconds=1.0), 1, 0)


# Numbers over time.


@settings(max_examples=scaled(400, 40), suppress_health_check=list(HealthCheck))
@given(st.integers(0, 2**32), st.integers(2, 30))
def test_interpolation_hits_samples_and_follows_straight_lines(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.uniform(0.001, 0.02, count))
    values = rng.normal(size=(count, 3))
    assert (interpolate(times, values, times) == values).all()
    line = np.outer(times, [1.0, -2.0, 0.5])
    between = rng.uniform(times[0], times[-1], 20)
    assert interpolate(times, line, between) == pytest.approx(np.outer(between, [1.0, -2.0, 0.5]))
    assert interpolate(times, values, np.array([times[0] - 1, times[-1] + 1])) == pytest.approx(values[[0, -1]])


def test_interpolation_follows_parabolas_between_its_ends() -> None:
    times = np.arange(12) * 0.008
    between = np.linspace(times[1], times[-2], 99)
    assert interpolate(times, times[:, None] ** 2, between)[:, 0] == pytest.approx(between**2, abs=1e-12)


def test_smoothing_keeps_cubics() -> None:
    x = np.linspace(-1, 1, 50)
    cubic = np.stack([x**3 - x, 2 * x**2], axis=1)
    assert smoothed(cubic, 6) == pytest.approx(cubic[6:-6])
    assert len(smoothed(cubic[:12], 6)) == 0
