"""Arms in a wrong state at the start: rows 26 to 47 and 58 of docs/reference/faults.md."""

import os
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest

from dual_ur10.errors import CellBusyError, CellFaulted, LinkError, SettingsError, StartError
from dual_ur10.sim2real.runtime.arm_memory import Phase
from dual_ur10.sim2real.runtime.arm_process import ArmProcess
from tests.virtual.faults.lab import ARMS


def joints(lab, arm):
    return np.array(lab.ask(arm, "actual_q")[0])


def test_35_reduced_mode_is_refused(lab):
    lab.cell.ask("reduce", arm="right", on=True)
    lab.assert_refused("right, safety mode: 2 (REDUCED), expected: 1 (NORMAL); find the cause")


def test_37_a_cb3_is_not_asked_for_remote_control(lab):
    lab.cell.ask("remote", arm="left", on=False)
    lab.make()


def test_38_power_and_brakes_are_for_a_person(lab):
    lab.cell.ask("press", arm="left", button="power_off")
    lab.cell.wait_until("left", "robot_mode", 3)
    lab.assert_refused("left, robot mode: 3 (POWER_OFF), expected: 7 (RUNNING); power the arm on")
    lab.cell.ask("press", arm="left", button="power_on")
    lab.cell.wait_until("left", "robot_mode", 5)
    lab.assert_refused("left, robot mode: 5 (IDLE), expected: 7 (RUNNING); ", "brakes")
    assert lab.ask("left", "robot_mode") == [5]


@pytest.mark.parametrize("mode", [3, 5, 7, 21])
def test_38_a_stopped_arm_is_refused(lab, mode):
    lab.cell.ask("stop", arm="right", mode=mode)
    lab.cell.wait_until("right", "safety_mode", mode)
    lab.assert_refused("right", f"{mode} (", "expected: ")


@pytest.mark.parametrize(
    ("told", "word"),
    [
        (
            {"model": "UR5", "robot_type": 1},
            "left, model: UR5, expected: UR10; correct the address, or the model in the cell file",
        ),
        ({"version": [5, 12, 0, 1]}, "left, family: e-series, software 5.12.0.1, expected: cb3; correct"),
    ],
)
def test_39_another_robot_is_refused(lab, told, word):
    lab.cell.ask("pretend", arm="left", **told)
    lab.assert_refused(word)


def test_40_another_calibration_is_refused(lab):
    lab.cell.ask("calibration", arm="right", error_m=0.003)
    lab.assert_refused("right, calibration: flange ", "expected: at most 0.1 mm; read the calibration")


@pytest.mark.parametrize(
    ("keys", "word"),
    [
        ({"payload_kg": 2.0, "payload_cog_m": [0.0, 0.0, 0.06]}, "left, payload: 0.000 kg"),
        ({"tcp_position_m": [0.0, 0.0, 0.17], "tcp_rotation_rad": [0.0, 0.0, 0.0]}, "left, TCP: [0, 0, 0, 0, 0, 0]"),
    ],
)
def test_41_another_payload_or_tool_is_refused(lab, keys, word):
    lab.configure(left=keys)
    lab.assert_refused(word, "expected: ", "correct it in the installation on the pendant")


def test_34_a_slider_that_is_down_is_refused(lab):
    lab.cell.ask("slider", arm="right", fraction=0.5)
    lab.cell.wait_until("right", "target_speed_fraction", 0.5)
    lab.assert_refused("right, speed slider: 50 %, expected: 100 %; ")


AWAY = [0.3, 0.0, 0.0, 0.0, 0.2, 0.0]


def test_44_a_slow_approach_needs_confirmation(lab):
    lab.make()
    lab.env.reset(seed=0)
    lab.close_env()
    home = {arm: joints(lab, arm) for arm in ARMS}
    lab.play("left", f"movej({(home['left'] + AWAY).tolist()}, a=2.0, v=1.0)")
    lab.cell.wait_until("left", "runtime_state", 1)
    asked = []

    def answer(agrees):
        return lambda question: asked.append(question) or agrees

    for no in (None, "yes"):  # only True is a yes
        lab.make(confirm=answer(no))
        with pytest.raises(StartError, match="was not confirmed: the arms have not moved"):
            lab.env.reset(seed=0)
        assert len(lab.executed("left")) == 0
        assert "left turns a joint by up to 0.30 rad, right turns a joint by up to 0.00 rad" in asked[-1]
    lab.make(confirm=answer(True))
    lab.env.reset(seed=0)
    sent = lab.runner.arms[0].sent()[0]
    speed = np.abs(np.diff(sent.target_rad, axis=0)) / (np.diff(sent.period) * 0.008)[:, None]
    assert 0.05 < speed.max() <= 0.2
    for arm in ARMS:
        np.testing.assert_allclose(lab.ask(arm, "target_q")[0], home[arm], atol=1e-4)


def moved(lab, arm, by_rad):
    """Let an arm have been moved by hand, as far as its controller knows."""
    told = joints(lab, arm)
    told[3] += by_rad
    lab.override(arm, actual_q=told.tolist(), target_q=told.tolist())
    lab.clock.sleep(0.05)


@pytest.mark.parametrize("by_rad", [0.0019, 0.0021])
def test_44_an_arm_that_was_moved_before_the_answer_is_not_begun_with(lab, by_rad):
    """Its motion was planned from where it was."""
    lab.make(confirm=lambda question: moved(lab, "right", by_rad) or True)
    if by_rad < 0.002:
        lab.env.reset(seed=0)
        return
    with pytest.raises(StartError, match=r"right cannot begin: wrist_1_joint is 0\.0021 rad from where it was when"):
        lab.env.reset(seed=0)
    assert len(lab.executed("left")) == len(lab.executed("right")) == 0
    assert lab.latch.read() is None
    lab.make()
    lab.env.reset(seed=0)  # planned anew


def test_44_a_first_target_away_from_the_arm_is_not_sent(lab, monkeypatch):
    lab.make()
    there = np.array([joints(lab, arm) for arm in ARMS])
    before, note_moving = lab.programs(), lab.runner._claim.note_moving
    monkeypatch.setattr(lab.runner._claim, "note_moving", lambda: note_moving() or moved(lab, "right", -0.0021))
    with pytest.raises(CellFaulted, match=r"right: a target is 0\.0021 rad from where the arm is at joint 3: allowed"):
        lab.runner.begin(there)
    assert len(lab.executed("right")) == 0
    assert len(lab.executed("left")) <= 5  # where it stands
    lab.assert_at_rest()
    assert lab.programs() == before + 2


def test_a_start_lists_all_that_is_wrong(lab):
    lab.override("left", safety_mode=7, robot_mode=3)
    with pytest.raises(StartError, match=r"left, safety mode: 7 .*\. left, robot mode: 3 \(POWER_OFF\)"):
        lab.make()
    lab.assert_nothing_executed()


def test_45_an_arm_that_moves_is_refused(lab):
    there = joints(lab, "right")
    there[5] += 0.5
    lab.play("right", f"movej({there.tolist()}, a=0.3, v=0.1)")
    with pytest.raises(StartError, match=r"right, program: 2 \(PLAYING\), expected: 1 \(STOPPED\); stop the program"):
        lab.make()
    lab.play("right", f"movej({joints(lab, 'right').tolist()}, a=1, v=1)")
    lab.cell.wait_until("right", "runtime_state", 1)
    lab.override("right", actual_qd=[0.0, 0.0, 0.1, 0.0, 0.0, 0.0])
    with pytest.raises(StartError, match=r"right, at rest: 0\.1000 rad/s, expected: less than 0\.01 rad/s; "):
        lab.make()
    lab.assert_nothing_executed()


def test_45_an_arm_pushed_before_its_first_target_is_not_moved(lab):
    lab.make()
    lab.override("left", actual_qd=[0.0, 0.0, 0.1, 0.0, 0.0, 0.0])
    lab.clock.sleep(0.1)
    with pytest.raises(StartError, match=r"left cannot begin: it moves at 0\.100 rad/s"):
        lab.env.reset(seed=0)
    assert len(lab.executed("left")) == len(lab.executed("right")) == 0


@pytest.mark.parametrize(("joint", "value"), [(5, 6.25), (0, -6.2), (2, 3.2)])
def test_46_47_a_joint_near_its_end_is_not_rotated_beyond(lab, joint, value):
    lab.make()
    told = joints(lab, "left").tolist()
    told[joint] = value
    lab.override("left", actual_q=told, target_q=told)
    lab.clock.sleep(0.1)
    with pytest.raises(StartError, match=f"left: .* is at {value:.3f} rad, allowed are ±.*rotate it back by hand"):
        lab.env.reset(seed=0)
    assert len(lab.executed("left")) == len(lab.executed("right")) == 0


def test_46_an_extra_turn_is_undone_completely_or_refused(lab):
    asked = []
    lab.make(confirm=lambda question: asked.append(question))
    told = joints(lab, "left").tolist()
    told[5] = 6.1
    lab.override("left", actual_q=told, target_q=told)
    lab.clock.sleep(0.1)
    with pytest.raises(StartError, match="not confirmed"):
        lab.env.reset(seed=0)
    home = lab.env.unwrapped.core.task.start(np.arange(1), [np.random.default_rng(0)]).q_rad.reshape(2, 6)[0, 5]
    assert f"left turns a joint by up to {6.1 - home:.2f} rad" in asked[0]


def test_26_swapped_addresses_are_named_by_their_serial_numbers(lab):
    lab.configure(left={"host": lab.cell.right}, right={"host": lab.cell.left})
    with pytest.raises(StartError, match=r"swapped addresses: each controller has the serial number of the other arm"):
        lab.make(confirm=lambda question: False)
    lab.assert_nothing_executed()


# Who moves them.


def test_58_a_second_runner_is_refused_and_the_first_continues(lab):
    lab.begin(steps=3)
    lab.env.unwrapped.core.cell.finish()  # between two episodes the policy has no deadline
    with pytest.raises(CellBusyError, match=rf"the left arm at {lab.cell.left} is moved by this program already"):
        gym.make("DualUR10/SineTracking-v0", cell=lab.where)
    lab.reset(seed=0)
    lab.env.step(lab.policy())
    assert lab.latch.read() is None


def test_58_the_lock_of_a_program_that_is_gone_is_taken_over(lab):
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    for host in (lab.cell.left, lab.cell.right):
        (lab.system.state_folder() / f"lock-{host}").write_text(f"{ended.pid}\n")
    lab.make()
    assert (lab.system.state_folder() / f"lock-{lab.cell.left}").read_text() == f"{os.getpid()}\n"


def test_58_a_lock_that_leads_elsewhere_is_refused(lab, tmp_path):
    path = lab.system.state_folder() / f"lock-{lab.cell.right}"
    path.unlink(missing_ok=True)
    target = tmp_path / "precious"
    target.write_text("mine")
    path.symlink_to(target)
    try:
        with pytest.raises(SettingsError, match=r"cannot keep a lock in .* Remove it"):
            lab.make()
    finally:
        path.unlink()
    assert target.read_text() == "mine"


def test_54_before_anything_moves_a_stall_of_half_a_second_is_tolerated(lab):
    lab.make()
    for who in ("emulated cell", "supervisor"):
        lab.cell.stall(who, 0.4)
        lab.clock.sleep(0.5)
    lab.reset(seed=0)
    assert lab.latch.read() is None


def test_54_a_longer_stall_before_anything_moves_is_no_latched_stop(lab):
    lab.make()
    lab.cell.stall("emulated cell", 0.8)
    lab.clock.sleep(1.0)
    with pytest.raises(StartError, match=r"this machine is too busy .*Nothing has moved: make the environment again"):
        lab.env.reset(seed=0)
    lab.assert_nothing_executed()
    assert lab.latch.read() is None
    lab.close_env()
    assert lab.latch.read() is None
    lab.assert_at_rest()
    lab.make()
    lab.reset(seed=0)


@pytest.mark.parametrize(("stalls", "tries"), [(1, 2), (3, 3)])
def test_54_a_connection_that_a_stall_ends_is_made_again(lab, monkeypatch, stalls, tries):
    """Nothing has moved, and both programs have ended."""
    wait, waited = ArmProcess.wait_until_ready, []

    def stalled(process, within_s):
        if process.connection.name == "left":
            waited.append(process)
            while process.memory.phase < Phase.READY and not process.memory.status:
                lab.clock.sleep(0.01)  # until it knows its controller
            if len(waited) <= stalls:
                lab.cell.stall("emulated cell", 0.8)
        return wait(process, within_s)

    monkeypatch.setattr(ArmProcess, "wait_until_ready", stalled)
    if stalls < tries:
        lab.make()
        lab.reset(seed=0)
    else:
        with pytest.raises(LinkError, match=r"^(left|right): this machine is too busy to move arms in real time"):
            lab.make()
        lab.assert_nothing_executed()
        lab.assert_at_rest()
    assert len(waited) == tries
    assert lab.latch.read() is None
    for wire in lab.wires:
        wire.uploads_before += tries - 1
