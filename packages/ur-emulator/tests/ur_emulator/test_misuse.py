"""Programs cannot end the controller, keep it busy, or make it report wrong values."""

import inspect
import itertools

import numpy as np
import pytest

from tests.ur_emulator.ticking import HOME, Bench, program
from ur_core.kinematics import flange_pose
from ur_core.kinematics.ur10 import NOMINAL_DH
from ur_core.protocol.modes import RuntimeState, SafetyMode
from ur_core.protocol.primary_packet import PrimaryPacket
from ur_emulator.controller.reported_values import ArmReading
from ur_emulator.ports.realtime_packet import RealtimePacket

ODD = ("0", "-1", "7", "1e308", "-2147483647", "True", '"text"', '"123"', '"123456"', "[]", "[1, 2]", "[1, 2, 3]",
       "[0, 0, 0, 0, 0, 0]", "p[0, 0, 0, 0, 0, 0]", "[[1, 2], [3, 4]]", '["1", "1", "1", "1", "1", "1"]',
       "[1e308, 1e308, 1e308, 1e308, 1e308, 1e308]", "1e308 * 1e308 - 1e308 * 1e308")  # fmt: skip


def built_ins(bench):
    """Return the names of builtins with their least and greatest number of arguments."""
    for name, function in sorted(bench.controller.program.builtins.items()):
        parameters = inspect.signature(function).parameters.values()
        yield name, sum(each.default is each.empty for each in parameters), len(parameters)


@pytest.mark.parametrize("family", ["cb3", "e-series"])
def test_no_argument_of_a_function_ends_the_controller(family):
    bench = Bench(family)
    controller = bench.controller
    packets = RealtimePacket(controller.profile), PrimaryPacket(controller.profile, NOMINAL_DH)
    names = list(built_ins(bench))
    assert len(names) > 100
    for name, least, most in names:
        # A CB3 has no functions that an e-Series lacks.
        for index, odd in enumerate(ODD if family == "e-series" else ODD[::6]):
            for count in {least, min(least + index % 2, most)}:
                controller.run_script(program(f"x = 1\n{name}({', '.join([odd] * count)})"))
                for _ in range(2):
                    controller.tick(controller.reading._replace(q_rad=controller.motion.q.copy()))
                    packets[0].pack(controller.values)
                    packets[1].state(controller.values)
                controller.program.stop("the next")
                controller.safety.release(SafetyMode.PROTECTIVE_STOP)
                controller.popup = ""
    assert np.isfinite(controller.motion.q).all()


@pytest.mark.parametrize(
    "text",
    [
        "while True:\n  x = get_inverse_kin_has_solution(p[0.5, 0.1, 0.3, 0, 3.14, 0])\nend",
        "x = [" + ", ".join(["get_inverse_kin_has_solution(p[0.5, 0.1, 0.3, 0, 3.14, 0])"] * 200) + "]",
        "x = [" + ", ".join(["1"] * 500) + "]\nwhile True:\n  y = norm(x)\nend",
        *(
            f"x = {[0.123456] * 500}\ni = 0\nwhile i < 100:\n  {call}(x)\n  i = i + 1\nend\nsync()"
            for call in ("textmsg", "popup", "socket_send_line")
        ),
        "thread t():\n  i = 0\n  while i < 4000:\n    i = i + 1\n  end\n  sync()\nend\n" + "run t()\n" * 40 + "sync()",
    ],
)
@pytest.mark.parametrize("kind", ["def", "sec"])
def test_a_program_has_one_budget_per_control_period(bench, kind, text):
    bench.run(program(text).replace("def", kind, 1))
    bench.tick(3)
    assert bench.state == RuntimeState.STOPPED
    assert b"infinite loop" in b"".join(bench.controller.messages)


@pytest.mark.parametrize("cog", ["[0, 0]", '"123"', "[0, 0, 1e308 * 10]", "[0, 0, 1e300]", "[]"])
def test_a_payload_is_all_or_nothing(bench, cog):
    bench.run(program(f"set_payload(1.0, {cog})"))
    bench.tick(2)
    assert bench.controller.payload.mass_kg == 0.0
    assert bench.controller.payload.cog_m == (0.0, 0.0, 0.0)


def moving(bench, speed=1.0):
    bench.run(program(f"movej({[HOME[0] + 2.0, *HOME[1:]]}, a=20, v={speed})"))
    bench.tick(60)
    assert abs(bench.controller.motion.qd[0]) == pytest.approx(speed, rel=1e-3)


@pytest.mark.parametrize("pausing", [1, 5, 12, 17])
def test_a_stop_during_a_pause_makes_no_arm_faster(bench, pausing):
    moving(bench)
    bench.pendant.pause()
    bench.tick(pausing)
    before = abs(bench.controller.motion.qd[0])
    bench.pendant.stop()
    for _ in range(100):
        bench.tick()
        speed = abs(bench.controller.motion.qd[0])
        assert speed <= before + 1e-6
        before = speed
    assert bench.state == RuntimeState.STOPPED
    assert before == 0.0


def test_a_stopped_arm_stays_when_the_slider_returns(bench):
    moving(bench)
    bench.controller.io.set_slider(0.0)
    bench.tick(28)
    bench.pendant.stop()
    bench.tick(60)
    assert bench.state == RuntimeState.STOPPED
    q = bench.controller.motion.q.copy()
    bench.controller.io.set_slider(1.0)
    bench.tick(100)
    assert np.array_equal(bench.controller.motion.q, q)


def test_a_deviating_arm_is_stopped(bench):
    controller = bench.controller
    stuck = ArmReading(np.array(HOME, dtype=float), np.zeros(6), np.zeros(6), np.zeros(6), None)
    bench.run(program(f"movej({[HOME[0] + 1.0, *HOME[1:]]}, a=2, v=1)\nset_standard_digital_out(0, True)"))
    for _ in range(300):
        controller.tick(stuck)
    assert controller.safety.safety_mode == SafetyMode.PROTECTIVE_STOP
    assert "C153A0" in controller.safety.reason
    assert not controller.io.outputs  # the program did not go on as if the arm had arrived
    assert np.abs(controller.motion.q - HOME).max() < 0.11
    # Resuming reports that the motion was lost.
    controller.safety.release(SafetyMode.PROTECTIVE_STOP)
    controller.play()
    for _ in range(100):
        controller.tick(stuck)
    assert bench.state == RuntimeState.STOPPED
    assert not controller.io.outputs


def test_refused_targets_are_not_listed_as_executed(bench):
    bench.run(program(f"servoj({[HOME[0] + 3.0, *HOME[1:]]}, t=0.008, lookahead_time=0.05, gain=500)"))
    bench.tick(5)
    assert bench.controller.safety.safety_mode == SafetyMode.PROTECTIVE_STOP
    assert not bench.controller.setpoints


def test_a_safeguard_does_not_end_a_manual_pause(bench):
    moving(bench)
    bench.controller.safety.stop(SafetyMode.SAFEGUARD_STOP)
    bench.tick(30)
    bench.pendant.pause()
    bench.controller.safety.release(SafetyMode.SAFEGUARD_STOP)
    bench.tick(30)
    assert bench.state == RuntimeState.PAUSED


@pytest.mark.parametrize("ticks", [0, 1, 3])
def test_a_short_emergency_stop_takes_effect(bench, ticks):
    moving(bench)
    bench.controller.safety.stop(SafetyMode.ROBOT_EMERGENCY_STOP)
    bench.tick(ticks)
    bench.controller.safety.release(SafetyMode.ROBOT_EMERGENCY_STOP)
    bench.tick(100)
    assert bench.state == RuntimeState.STOPPED
    assert bench.controller.values["robot_mode"] == 3


@pytest.mark.parametrize("call", ["teach_mode()", "freedrive_mode()", f"movej({HOME})", "force_mode(p[0,0,0,0,0,0],"
                                  " [0,0,1,0,0,0], [0,0,9,0,0,0], 2, [1,1,1,1,1,1])"])  # fmt: skip
@pytest.mark.parametrize("beside", [False, True])
def test_secondary_programs_neither_move_nor_free_the_arm(bench, call, beside):
    if beside:
        bench.run(program("while True:\n  sync()\nend"))
        bench.tick(2)
    bench.controller.run_script(f"sec s():\n  {call}\nend\n")
    bench.tick(3)
    assert b"secondary" in b"".join(bench.controller.messages)
    assert not bench.controller.motion.free
    assert bench.state == (RuntimeState.PLAYING if beside else RuntimeState.STOPPED)


def test_secondary_programs_end_with_the_power(bench):
    loop = "i = 0\nwhile True:\n  i = i + 1\n  write_output_integer_register(0, i)\n  sync()\nend"
    bench.controller.run_script("sec s():\n" + loop + "\nend\n")
    bench.tick(5)
    bench.controller.safety.stop(SafetyMode.ROBOT_EMERGENCY_STOP)
    bench.tick(5)
    value = bench.controller.registers.output_int[0]
    bench.tick(20)
    assert bench.controller.registers.output_int[0] == value
    bench.controller.run_script("sec s():\n" + loop + "\nend\n")
    assert b"not started" in b"".join(bench.controller.messages)


def test_an_unreadable_secondary_program_ends_nothing(bench):
    bench.run(program("while True:\n  sync()\nend"))
    bench.tick(2)
    bench.controller.run_script("sec s():\n  no_such_thing()\nend\n")
    bench.tick(2)
    assert bench.state == RuntimeState.PLAYING


def test_programs_see_true_values_despite_overrides(bench):
    bench.controller.override("actual_q", (9.0,) * 6)
    bench.run(program("q = get_actual_joint_positions()\nwrite_output_float_register(0, q[0])"))
    bench.tick(3)
    assert bench.controller.values["actual_q"][0] == 9.0
    assert bench.controller.registers.output_double[0] == pytest.approx(HOME[0])


def test_a_declared_payload_adds_no_force(bench):
    controller = bench.controller
    bench.run(program("set_payload(2.0, [0.1, 0.0, 0.2])\nwhile True:\n  sync()\nend"))
    bench.tick(2)
    q = controller.motion.q.copy()
    _, rotation = flange_pose(q, NOMINAL_DH)
    weight = np.array([0.0, 0.0, -2.0 * 9.81])
    wrench = np.concatenate([weight, np.cross(rotation @ [0.1, 0.0, 0.2], weight)])
    controller.tick(ArmReading(q, np.zeros(6), np.zeros(6), wrench, None))
    assert np.allclose(controller.values["actual_TCP_force"], 0.0, atol=1e-9)


@pytest.mark.parametrize("persist", [True, False])
def test_persistence_of_output_registers_is_assumed(persist):
    bench = Bench(output_registers_persist=persist)
    bench.run(program("write_output_integer_register(5, 7)\nsync()"))
    bench.tick(5)
    assert bench.state == RuntimeState.STOPPED
    assert bench.controller.registers.output_int[5] == (7 if persist else 0)


@pytest.mark.parametrize("unchanged", [True, False])
def test_feeding_by_an_unchanged_value_is_assumed(unchanged):
    bench = Bench(watchdog_counts_unchanged=unchanged)
    loop = "while True:\n  sync()\nend"
    bench.run(program(f'rtde_set_watchdog("input_int_register_0", 10, "stop")\n{loop}'))
    for value in itertools.chain([1, 2, 3, 4], [4] * 6):
        bench.controller.registers.input_int[0] = value
        bench.controller.registers.writes["input_int_register_0"] += 1
        bench.tick(5)
    assert bench.state == (RuntimeState.PLAYING if unchanged else RuntimeState.STOPPED)


def test_a_blocking_popup_blocks_until_it_is_closed(bench):
    bench.run(program('popup("look", blocking=True)\nset_standard_digital_out(1, True)\nwhile True:\n  sync()\nend'))
    bench.tick(10)
    assert not bench.controller.io.outputs
    bench.ask("close popup")
    bench.tick(2)
    assert bench.controller.io.outputs == 2


def test_an_emergency_stop_from_full_speed_is_as_short_as_others(bench):
    moving(bench, 2.0)
    bench.controller.safety.stop(SafetyMode.ROBOT_EMERGENCY_STOP)
    bench.passing(bench.profile.assumptions.stopping_s + 0.02)
    assert not bench.controller.motion.qd.any()
