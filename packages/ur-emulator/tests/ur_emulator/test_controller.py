"""Controller, program and safety together: for any events the reported values agree, and a stopped arm stays still."""

import itertools
import math
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.soak import SOAK
from tests.ur_emulator.ticking import COUNT, HOME, PLAYS, Bench, program
from ur_core.errors import OperationRefusedError
from ur_core.kinematics.ur10 import JOINT_SPEED_RAD_S
from ur_core.protocol.modes import RobotMode, RuntimeState, SafetyBits, SafetyMode
from ur_emulator.controller.reported_values import LiveValues

FAR = [1.2, -1.2, 1.2, -1.0, -1.2, 1.5]
MOVE = f"movej({FAR}, a=3, v=1)"
SWING = f"""h = {HOME}
k = 0
while True:
  servoj([0.15 * sin(0.02 * k), -1.57, 1.57, -1.57, -1.57, 0.1 * sin(0.03 * k)], t=0.008, lookahead_time=0.1, gain=300)
  k = k + 1
end"""
LINES = """while True:
  movel(p[0.6, -0.2, 0.5, 0, 3.1, 0], a=1, v=0.4)
  movel(p[0.6, 0.2, 0.4, 0, 3.1, 0], r=0.02)
end"""
IDLE = "while True:\n  sync()\nend"
PROGRAMS = (
    program(MOVE),
    program(SWING),
    program(
        "while True:\n  speedj([0.4, -0.2, 0.1, 0.3, 0, -0.5], 2, 0.1)\n  speedj([-0.4, 0.2, 0, 0, 0, 0], 2, 0.1)\nend"
    ),
    program(COUNT + IDLE),
    program(LINES),
    program("sleep(0.05)\nx = [1][3]"),
    program("while True:\nend"),
    program("protective_stop()\n" + IDLE),
    program("servoj([1, 0, 0, 0, 0, 0])\nsync()"),
    program("force_mode(p[0,0,0,0,0,0], [0,0,1,0,0,0], [0,0,5,0,0,0], 2, [0.1,0.1,0.1,0.3,0.3,0.3])\nsleep(1)"),
    program('rtde_set_watchdog("input_int_register_0", 10, "stop")\n' + IDLE),
    program('rtde_set_watchdog("input_int_register_0", 10, "pause")\n' + SWING),
    "sec s():\n  set_standard_digital_out(1, True)\nend\n",
    "sec m():\n  movej([0, 0, 0, 0, 0, 0])\nend\n",
    "movej([0.2, -1.5, 1.5, -1.5, -1.5, 0])\n",
    "def broken(:\nend\n",
    program("no_such_function()"),
)
BUTTONS = ["play", "resume", "pause", "stop", "power_on", "power_off", "release_brakes", "unlock_protective_stop"]
BUTTONS += ["restart_safety"]
MODES = st.integers(0, 255) | st.integers(3, 14)

EVENTS = st.one_of(
    st.tuples(st.just("stop"), MODES),
    st.tuples(st.just("release"), MODES),
    st.tuples(st.just("release all")),
    st.tuples(st.just("press"), st.sampled_from(BUTTONS)),
    st.tuples(st.just("press"), st.sampled_from(["play", "release_brakes", "pause"])),
    st.tuples(st.just("run"), st.integers(0, len(PROGRAMS) - 1)),
    st.tuples(st.just("run"), st.integers(0, 4)),
    st.tuples(st.just("slider"), st.sampled_from([0.0, 0.1, 0.5, 1.0]) | st.floats(0.0, 1.0)),
    st.tuples(st.just("reduce"), st.booleans()),
    st.tuples(st.just("remote"), st.booleans()),
    st.tuples(st.just("tick"), st.integers(1, 60)),
    st.tuples(st.just("tick"), st.integers(1, 250)),
)


def happen(bench, name, *values):
    controller = bench.controller
    try:
        match name:
            case "stop":
                controller.safety.stop(values[0])
            case "release":
                controller.safety.release(values[0])
            case "release all":
                for mode in range(256):
                    controller.safety.release(mode)
            case "press":
                getattr(bench.pendant, values[0])()
            case "run":
                bench.run(PROGRAMS[values[0]])
            case "slider":
                controller.io.set_slider(values[0])
            case "reduce":
                controller.safety.reduce(values[0])
            case "remote":
                controller.remote_control = values[0]
            case "tick":
                bench.tick(values[0])
    except OperationRefusedError:
        pass
    bench.tick()
    bench.agree()


@settings(max_examples=2400 if SOAK else 15)
@given(
    family=st.sampled_from(["cb3", "e-series"]),
    events=st.lists(EVENTS, max_size=40),
    powered=st.booleans(),
    resumes=st.booleans(),
    pauses=st.booleans(),
)
def test_any_events_keep_reports_consistent_and_arms_safe(family, events, powered, resumes, pauses):
    bench = Bench(family, powered=powered, safeguard_resumes=resumes, emergency_stop_pauses=pauses, unlock_wait_s=0.5)
    for event in events:
        happen(bench, *event)
    # Recovery is possible from any state.
    for mode in range(256):
        bench.controller.safety.release(mode)
    bench.controller.remote_control = True
    bench.controller.io.set_slider(1.0)
    bench.pendant.stop()
    bench.passing(0.4)  # an arm that loses its power has to come to rest first
    happen(bench, "press", "release_brakes")
    bench.until(lambda: bench.controller.safety.may_move, 1500)
    bench.tick()
    bench.run(program(COUNT + IDLE))
    bench.tick(3)
    assert bench.state in PLAYS
    bench.agree()


# Stops.


def moving(bench, text=MOVE):
    bench.run(program(COUNT + text))
    bench.tick(60)
    assert bench.moved > 0.0
    return bench.controller.registers.output_int


def stands(bench, ticks=150):
    q = bench.q.copy()
    bench.tick(ticks)
    assert np.array_equal(bench.q, q)


@pytest.mark.parametrize("mode", [3, 4, 255])
def test_a_stop_pauses_and_the_arm_stands_until_play(mode):
    bench = Bench(unlock_wait_s=0.2)
    counts = moving(bench)
    bench.controller.safety.stop(mode)
    bench.tick(25)
    assert bench.state == RuntimeState.PAUSED
    count = counts[0]
    stands(bench)
    with pytest.raises(OperationRefusedError, match="stopped"):
        bench.pendant.play()
    if mode == SafetyMode.PROTECTIVE_STOP:
        bench.pendant.unlock_protective_stop()
    else:
        bench.controller.safety.release(mode)
    stands(bench)
    assert (bench.state, counts[0]) == (RuntimeState.PAUSED, count)
    bench.pendant.play()
    bench.until(lambda: bench.state == RuntimeState.STOPPED or np.allclose(bench.q, FAR, atol=1e-6))
    assert bench.q == pytest.approx(FAR, abs=1e-6)  # it kept its path
    assert counts[0] > count


def test_a_new_program_runs_after_unlocking():
    bench = Bench(unlock_wait_s=0.2)
    moving(bench)
    bench.controller.safety.stop(3)
    bench.tick(40)
    bench.pendant.unlock_protective_stop()
    bench.tick(2)
    bench.run(program(IDLE))
    bench.tick(2)
    assert bench.state in PLAYS
    stands(bench)  # the target of the old program is dropped


def test_a_stop_takes_the_assumed_time(bench):
    moving(bench)
    bench.controller.safety.stop(3)
    speeds = []
    for _ in range(25):
        bench.tick()
        speeds.append(bench.moved / bench.tick_s)
    moved = [speed > 0.0 for speed in speeds]
    assert 0.1 <= sum(moved) * bench.tick_s <= 0.16
    assert all(a >= b for a, b in itertools.pairwise(speeds))


@pytest.mark.parametrize("mode", [6, 7, 8, 9])
def test_a_grave_stop_ends_the_program_and_takes_power(bench, mode):
    moving(bench)
    bench.controller.safety.stop(mode)
    bench.tick(2)
    assert bench.state == RuntimeState.STOPPING
    assert bench.moved > 0.0
    assert bench.controller.values["robot_mode"] == RobotMode.RUNNING  # until it stands
    bench.tick(23)
    assert bench.state == RuntimeState.STOPPED
    assert bench.controller.values["robot_mode"] == RobotMode.POWER_OFF
    assert bench.ask("robotmode") == "Robotmode: POWER_OFF"
    assert bench.robot_mode_data()["power"] is False
    assert bench.ask("power on") == "Failed to execute: power on"
    if mode in (8, 9):
        bench.pendant.restart_safety()
        bench.passing(1.1)
    else:
        bench.controller.safety.release(mode)
    stands(bench)
    bench.pendant.release_brakes()
    bench.passing(1.5)
    assert bench.controller.safety.may_move
    stands(bench)


def test_a_safeguard_stop_pauses_and_resumes(bench):
    moving(bench)
    bench.controller.safety.stop(5)
    bench.tick(25)
    assert bench.state == RuntimeState.PAUSED
    stands(bench)
    bench.controller.safety.release(5)
    bench.tick(3)
    assert bench.state == RuntimeState.RESUMING
    bench.until(lambda: np.allclose(bench.q, FAR, atol=1e-6))
    off = Bench(safeguard_resumes=False)
    moving(off)
    off.controller.safety.stop(5)
    off.tick(25)
    off.controller.safety.release(5)
    stands(off)
    assert off.state == RuntimeState.PAUSED


def test_a_manual_pause_outlasts_a_safeguard_stop(bench):
    moving(bench)
    bench.pendant.pause()
    bench.tick(40)
    bench.controller.safety.stop(5)
    bench.tick(40)
    bench.controller.safety.release(5)
    stands(bench)
    assert bench.state == RuntimeState.PAUSED


@pytest.mark.parametrize("graver", [3, 99])
def test_a_safeguard_stop_with_another_stop_does_not_resume(graver):
    bench = Bench(unlock_wait_s=0.1)
    moving(bench)
    bench.controller.safety.stop(5)
    bench.tick(10)
    bench.controller.safety.stop(graver)
    bench.tick(40)
    for mode in (graver, 5):
        bench.controller.safety.release(mode)
        stands(bench, 40)
    assert bench.state == RuntimeState.PAUSED


@pytest.mark.parametrize("mode", [3, 7, 9])
def test_a_stop_from_outside_is_reported_once(bench, mode):
    """By UR's messages of an error code, type 6, and of the safety mode, type 5."""
    bench.controller.messages.clear()
    for _ in range(2):
        bench.controller.stop(mode, "somebody pressed it")
        bench.tick(3)
    error, safety = bench.controller.messages
    assert (error[14], safety[14]) == (6, 5)
    assert error.endswith(b"somebody pressed it")
    assert safety[23] == mode
    with pytest.raises(OperationRefusedError, match="no stop"):
        bench.controller.stop(SafetyMode.NORMAL)


@pytest.mark.parametrize(("mode", "level"), [(3, 2), (7, 3), (9, 4)])
def test_the_level_of_a_stop_is_reported(bench, mode, level):
    """A protective stop is a warning: UR's client library goes on after one if it was told to ignore warnings."""
    bench.controller.messages.clear()
    bench.controller.stop(mode, "somebody pressed it")
    assert struct.unpack_from(">iii", bench.controller.messages[0], 15) == (0, 0, level)


def test_the_safety_mode_after_a_stop_is_reported(bench):
    bench.controller.stop(5)
    bench.tick(3)
    bench.controller.messages.clear()
    bench.controller.safety.release(5)
    bench.tick(3)
    bench.controller.safety.reduce(True)
    bench.tick(3)
    assert [(each[14], each[23]) for each in bench.controller.messages] == [(5, 1), (5, 2)]


@pytest.mark.parametrize("mode", [3, 5, 7, 42])
def test_a_program_that_is_sent_during_a_stop_is_not_started(bench, mode):
    bench.controller.safety.stop(mode)
    bench.tick(3)
    for text in (program(COUNT + MOVE), f"{MOVE}\n"):
        bench.run(text)
        bench.tick(3)
        assert bench.state == RuntimeState.STOPPED
    messages = b"".join(bench.controller.messages)
    assert b"not started" in messages
    bench.controller.safety.release(mode)
    stands(bench)
    assert bench.controller.registers.output_int[0] == 0


def test_a_program_in_the_period_of_a_stop_runs_no_line(bench):
    bench.tick()
    bench.controller.safety.stop(3)
    bench.run(program(COUNT + MOVE))
    stands(bench, 40)
    assert bench.controller.registers.output_int[0] == 0


def test_a_program_without_power_is_not_started():
    bench = Bench(powered=False)
    bench.tick()
    bench.run(program(MOVE))
    stands(bench, 40)
    assert bench.state == RuntimeState.STOPPED
    with pytest.raises(OperationRefusedError, match="no power"):
        bench.pendant.play()


def test_taking_power_away_stops_the_arm(bench):
    moving(bench)
    assert bench.ask("power off") == "Powering off"
    bench.tick(25)
    assert bench.state == RuntimeState.STOPPED
    stands(bench)


def test_a_controller_that_was_shut_down_stays_so(bench):
    moving(bench)
    assert bench.ask("shutdown") == "Shutting down"
    assert bench.off == 1
    for button in ("power_on", "release_brakes"):
        with pytest.raises(OperationRefusedError, match="shut down"):
            getattr(bench.pendant, button)()
    bench.pendant.power_off()
    bench.controller.safety.stop(7)
    bench.passing(2.0)
    assert bench.controller.values["robot_mode"] == RobotMode.DISCONNECTED


# Pauses and the slider.


def test_pause_and_play_keep_the_path():
    def path(pauses):
        bench = Bench()
        bench.run(program(MOVE))
        found = []
        for tick in range(1000):
            bench.tick()
            found.append(bench.q)
            if tick in pauses:
                bench.pendant.pause()
                bench.tick(60)
                assert bench.state == RuntimeState.PAUSED
                stands(bench, 20)
                bench.pendant.play()
        return np.array(found)

    straight, paused = path(()), path((40, 90))
    assert np.allclose(straight[-1], FAR, atol=1e-6)
    assert np.allclose(paused[-1], FAR, atol=1e-6)
    # All joints move in proportion: so does every point of the path.
    displacement = np.array(FAR) - HOME
    for q in paused[::5]:
        fraction = (q - HOME)[0] / displacement[0]
        assert np.allclose(q, HOME + fraction * displacement, atol=1e-6)


@pytest.mark.parametrize("what", ["stop", "load", "safeguard"])
def test_stopping_a_paused_program_drops_its_motion(bench, what):
    moving(bench)
    bench.pendant.pause()
    bench.tick(60)
    q = bench.q.copy()
    if what == "stop":
        bench.pendant.stop()
    elif what == "load":
        bench.run(program(IDLE))
    else:
        bench.controller.safety.stop(5)
        bench.pendant.stop()
        bench.tick(20)
        bench.controller.safety.release(5)
    bench.tick(150)
    assert np.array_equal(bench.q, q)


def top_speed(bench, ticks):
    return max((bench.tick(), bench.moved)[1] for _ in range(ticks)) / bench.tick_s


@pytest.mark.parametrize("text", [MOVE, SWING, "speedj([0.5, 0, 0, 0, 0, 0], 2, 1)"])
def test_the_slider_slows_all_motion(text):
    speeds = {}
    for slider in (1.0, 0.1):
        bench = Bench()
        bench.controller.io.set_slider(slider)
        bench.tick(40)
        bench.run(program(text))
        speeds[slider] = top_speed(bench, 90)
        assert bench.controller.values["speed_scaling"] == pytest.approx(slider)
    assert speeds[0.1] <= 0.1001 * max(speeds[1.0], np.max(JOINT_SPEED_RAD_S) * (text == SWING))
    assert 0.0 < speeds[0.1] <= 0.5 * speeds[1.0]


def test_servoj_at_a_tenth_follows_at_a_tenth_of_the_speed():
    def first_joint(slider):
        bench = Bench()
        bench.controller.io.set_slider(slider)
        bench.tick(40)
        bench.run(program(f"while True:\n  servoj({[0.1, *HOME[1:]]}, t=0.008, lookahead_time=0.1, gain=300)\nend"))
        found = []
        for _ in range(400):
            bench.tick()
            found.append(bench.q[0])
        return np.array(found)

    full, slow = first_joint(1.0), first_joint(0.1)
    assert full[39] > 0.05
    # The same path in ten times the time.
    assert np.allclose(slow[9::10][:38], full[:38], atol=2e-3)


def test_reduced_mode_is_half_as_fast_and_no_stop(bench):
    moving(bench)
    full = bench.moved
    bench.controller.safety.reduce(True)
    bench.tick(20)
    assert bench.moved == pytest.approx(full / 2, rel=0.05)
    assert bench.controller.values["safety_mode"] == SafetyMode.REDUCED
    assert bench.controller.values["safety_status_bits"] == SafetyBits.REDUCED
    assert bench.state == RuntimeState.PLAYING
    bench.controller.safety.reduce(False)
    bench.tick(40)
    assert bench.moved > 0.9 * full or np.allclose(bench.q, FAR, atol=0.05)


def test_at_slider_zero_the_arm_stands_and_the_program_plays(bench):
    counts = moving(bench)
    bench.controller.io.set_slider(0.0)
    bench.tick(40)
    count = counts[0]
    stands(bench)
    assert bench.state == RuntimeState.PLAYING
    assert counts[0] == count + 150


# Faults.


def test_a_program_that_starves_the_arm_is_stopped_protectively(bench):
    bench.run(
        program(
            "k = 0\nwhile k < 60:\n  servoj([0.01 * k, -1.57, 1.57, -1.57, -1.57, 0], t=0.008)\n  k = k + 1\nend\n"
            + IDLE
        )
    )
    bench.until(lambda: bench.controller.values["safety_mode"] == 3, 200)
    assert "sudden stop" in bench.controller.safety.reason
    bench.tick(40)
    assert bench.state == RuntimeState.PAUSED
    stands(bench)


def test_a_jump_of_servoj_is_stopped_protectively(bench):
    bench.run(program(f"servoj({[2.0, *HOME[1:]]}, t=0.008)\n{IDLE}"))
    bench.tick(3)
    assert bench.controller.values["safety_mode"] == 3
    assert bench.controller.safety.reason.startswith("C204")
    stands(bench)
    assert bench.q == pytest.approx(HOME)


# A watchdog.


def test_an_unfed_watchdog_stops_the_program(bench):
    bench.run(program('rtde_set_watchdog("input_int_register_0", 10, "stop")\n' + COUNT + MOVE))
    for _ in range(10):
        bench.tick(10)  # 0.08 s of the 0.1 s
        bench.controller.registers.writes["input_int_register_0"] = bench.controller.ticks
        assert bench.state == RuntimeState.PLAYING
    assert 12 <= bench.until(lambda: bench.state != RuntimeState.PLAYING) <= 14
    assert b"RTDE_WATCHDOG" in b"".join(bench.controller.messages)
    bench.tick(60)
    assert bench.state == RuntimeState.STOPPED
    stands(bench)


def test_a_watchdog_may_pause(bench):
    bench.run(program('rtde_set_watchdog("input_int_register_0", 10, "pause")\n' + MOVE))
    bench.tick(60)
    assert bench.state == RuntimeState.PAUSED
    bench.pendant.play()
    bench.tick(60)
    assert bench.state == RuntimeState.PLAYING


@pytest.mark.parametrize("unfed", [0, 1])
def test_each_variable_has_a_watchdog_of_its_own(bench, unfed):
    bench.run(program("".join(f'rtde_set_watchdog("input_int_register_{k}", 10, "stop")\n' for k in (0, 1)) + IDLE))
    writes = bench.controller.registers.writes
    for _ in range(60):
        writes["input_int_register_0"] = writes["input_int_register_1"] = bench.controller.ticks
        bench.tick()
    assert bench.state == RuntimeState.PLAYING
    for _ in range(14):
        writes[f"input_int_register_{1 - unfed}"] = bench.controller.ticks
        bench.tick()
    assert bench.state != RuntimeState.PLAYING


@pytest.mark.parametrize("end", ['"ignore"', '"stop"'])
def test_a_watchdog_is_set_anew(bench, end):
    frequency = 10 if end == '"ignore"' else 0.1
    text = 'rtde_set_watchdog("input_int_register_0", 10, "stop")\n'
    bench.run(program(f'{text}rtde_set_watchdog("input_int_register_0", {frequency}, {end})\n{IDLE}'))
    bench.tick(60)
    assert bench.state == RuntimeState.PLAYING


def test_any_input_has_a_watchdog(bench):
    for name in ("external_force_torque", "input_bit_registers0_to_31", "speed_slider_mask"):
        bench.run(program(f'rtde_set_watchdog("{name}", 10, "stop")\n{IDLE}'))
        for _ in range(6):
            bench.tick(10)
            bench.controller.registers.writes[name] += 1
            assert bench.state == RuntimeState.PLAYING
        assert 12 <= bench.until(lambda: bench.state != RuntimeState.PLAYING) <= 14


@pytest.mark.parametrize(
    ("before", "after", "pauses"),
    [
        ("", "", True),
        ("", "ft_rtde_input_enable(False)", False),
        ('rtde_set_watchdog("input_int_register_0", 0.1)', "", False),
        ('rtde_set_watchdog("external_force_torque", 10)', "ft_rtde_input_enable(False)", True),
    ],
)
def test_a_silent_external_sensor_pauses_its_program(bench, before, after, pauses):
    """Unless the program has set a watchdog of its own, which stays."""
    bench.run(program(f"{before}\nft_rtde_input_enable(True)\n{after}\n{IDLE}"))
    for _ in range(6):
        bench.tick(10)
        bench.controller.registers.writes["external_force_torque"] += 1
        assert bench.state == RuntimeState.PLAYING
    bench.tick(60)
    assert (bench.state == RuntimeState.PAUSED) == pauses


@pytest.mark.parametrize("between", [0, 40])
def test_a_watchdog_ends_with_its_program(bench, between):
    bench.run(program('rtde_set_watchdog("input_int_register_0", 10, "stop")\n' + IDLE))
    bench.tick(5)
    if between:
        bench.pendant.stop()
        bench.tick(between)
    bench.run(program(IDLE))
    bench.tick(60)
    assert bench.state == RuntimeState.PLAYING


# Local mode, payload, TCP.


def test_an_e_series_in_local_mode_refuses_programs():
    bench = Bench("e-series")
    bench.controller.remote_control = False
    bench.run(program(MOVE))
    stands(bench, 10)
    assert b"local mode" in b"".join(bench.controller.messages)
    for line in ("play", "stop", "pause", "power off", "brake release", "unlock protective stop", "load x"):
        assert "Remote Control" in bench.ask(line), line
    assert bench.controller.safety.robot_mode == RobotMode.RUNNING
    cb3 = Bench("cb3")
    cb3.controller.remote_control = False
    moving(cb3)


def test_payload_and_tcp_change_reported_values(bench):
    bench.tick()
    before = dict(bench.controller.values)
    text = "set_payload(2.5, [0.01, 0.02, 0.03])\nset_tcp(p[0, 0, 0.1, 0, 0, 0])"
    bench.run(program(text))
    bench.tick(2)
    values = bench.controller.values
    assert (values["payload"], values["payload_cog"]) == (2.5, (0.01, 0.02, 0.03))
    assert values["actual_q"] == before["actual_q"]
    displacement = np.subtract(values["actual_TCP_pose"][:3], before["actual_TCP_pose"][:3])
    assert np.linalg.norm(displacement) == pytest.approx(0.1)
    assert values["actual_TCP_pose"][3:] == pytest.approx(before["actual_TCP_pose"][3:])
    assert values["tcp_offset"] == pytest.approx([0, 0, 0.1, 0, 0, 0])
    # The weight of the declared payload is no external force.
    assert values["actual_TCP_force"][2] == pytest.approx(2.5 * 9.81)
    bench.wrench[2] = -2.5 * 9.81
    bench.tick()
    assert bench.controller.values["actual_TCP_force"][2] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("text", ["set_payload(1)", "set_payload_mass(1)", "set_payload_cog([0, 0, 0.1])"])
def test_a_payload_without_an_inertia_has_none(bench, text):
    bench.run(program(f"set_target_payload(1, [0, 0, 0], [1, 2, 133, -133, 0, 0])\nsync()\n{text}"))
    bench.tick()
    assert bench.controller.values["payload_inertia"] == (1, 2, 133, -133, 0, 0)
    bench.tick()
    assert bench.controller.values["payload_inertia"] == (0,) * 6


@pytest.mark.parametrize("inertia", ["[134, 0, 0, 0, 0, 0]", "[0, 0, -1, 0, 0, 0]", "[0, 0, 0, 0, -134, 0]"])
def test_an_inertia_that_no_payload_has_ends_the_program(bench, inertia):
    bench.run(program(f"set_target_payload(1, [0, 0, 0], {inertia})\n{IDLE}"))
    bench.tick(2)
    assert bench.state != RuntimeState.PLAYING
    assert bench.controller.payload.mass_kg == 0.0


def test_derived_values_are_computed_once_and_leave_overrides(bench):
    made = []

    def pose_and_speed():
        made.append(1)
        return (len(made),) * 6, (-len(made),) * 6

    derived = {("pose", "speed", "absent"): lambda: (*pose_and_speed(), 9)}
    values = LiveValues(dict.fromkeys(("mode", "pose", "speed"), 0), derived)
    assert not made
    values.forget()
    assert (values["speed"], values["pose"], values["mode"]) == ((-1,) * 6, (1,) * 6, 0)
    values.forget()
    values["pose"] = "overridden"
    values.complete()
    assert values == {"mode": 0, "pose": "overridden", "speed": (-2,) * 6}
    with pytest.raises(KeyError):
        values["absent"]
    # A controller reports what it overrides beside what it derives from the same state.
    bench.controller.override("actual_TCP_pose", (9.0,) * 6)
    bench.tick()
    speed = bench.controller.motion.tcp_speed(bench.controller.reading.q_rad, bench.controller.reading.qd_rad_s)
    assert bench.controller.values["actual_TCP_pose"] == (9.0,) * 6
    assert bench.controller.values["actual_TCP_speed"] == pytest.approx(speed)


def test_a_payload_beyond_the_arm_ends_the_program(bench):
    bench.run(program(f"set_payload(11)\n{IDLE}"))
    bench.tick(2)
    assert bench.state == RuntimeState.STOPPED
    assert bench.controller.values["payload"] == 0.0


def test_the_clock_is_the_controllers_own():
    bench = Bench("e-series")
    first = bench.controller.values["timestamp"]
    bench.tick(500)
    assert bench.controller.values["timestamp"] - first == pytest.approx(1.0)
    assert math.isclose(first, bench.controller.boot_s)
