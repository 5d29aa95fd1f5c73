"""Program of a controller: loading, playing, pausing and ending."""

import struct

import numpy as np
import pytest

from tests.ur_emulator.ticking import COUNT, HOME, Bench, program
from ur_core.errors import OperationRefusedError, ScriptSyntaxError
from ur_core.protocol.modes import RuntimeState, SafetyMode

IDLE = "while True:\n  sync()\nend"
MOVE = f"movej({[1.2, *HOME[1:]]}, a=3, v=1)"


@pytest.fixture
def bench():
    made = Bench()
    made.tick()
    return made


def count(bench):
    return bench.controller.registers.output_int[0]


def heard(bench):
    """Return the new messages on 30001."""
    messages = b"".join(bench.controller.messages)
    bench.controller.messages.clear()
    return messages


def events(bench):
    """Return the new messages on 30001: titles and texts of key messages, places and texts of runtime exceptions."""
    found = []
    for message in bench.controller.messages:
        kind, body = message[14], message[15:]
        if kind == 7:
            found.append((body[9 : 9 + body[8]].decode(), body[9 + body[8] :].decode()))
        elif kind == 10:
            found.append((*struct.unpack_from(">ii", body), body[8:].decode()))
    bench.controller.messages.clear()
    return found


def test_start_and_end_of_programs_are_reported(bench):
    """By the key messages that UR's client library waits for; of secondary programs there are none."""
    started, stopped = "PROGRAM_XXX_STARTED", "PROGRAM_XXX_STOPPED"
    bench.run(program('textmsg("here")\nsync()', "mine"))
    bench.tick()
    assert b"".join(bench.controller.messages).index(b"STARTED") < b"".join(bench.controller.messages).index(b"here")
    assert events(bench) == [(started, "mine")]
    bench.tick(2)
    assert events(bench) == [(stopped, "mine")]
    bench.run(program(IDLE, "first"))
    bench.tick(2)
    bench.run(program(IDLE, "second"))
    bench.tick(2)
    assert events(bench) == [(started, "first"), (stopped, "first"), (started, "second")]
    bench.pendant.pause()
    bench.tick(40)
    assert events(bench) == []
    bench.pendant.stop()
    assert events(bench) == [(stopped, "second")]
    bench.run("sec beside():\n  sync()\nend\n")
    bench.tick(3)
    assert events(bench) == []
    bench.pendant.play()
    bench.tick()
    assert events(bench) == [(started, "second")]


def test_an_error_is_reported_before_the_end_of_its_program(bench):
    bench.run(program("sync()\nx = 1 / 0", "mine"))
    bench.tick(3)
    assert [event[0] for event in events(bench)] == ["PROGRAM_XXX_STARTED", 3, "PROGRAM_XXX_STOPPED"]


@pytest.mark.parametrize("word", ["calldoesntexist", "novariable"])
def test_unknown_names_are_reported_in_urs_words(bench, word):
    bench.run(program(f"{word}()" if word[0] == "c" else f"x = 1 + {word}"))
    assert events(bench) == [(2, 3 if word[0] == "c" else 11, f"compile_error_name_not_found:{word}:")]


def test_a_movej_beyond_the_joint_limits_ends_its_program(bench):
    """So that its sockets close, and a client that waits for its end goes on. UR's client library tests both ways."""
    for goal in ("[-123, 0, 0, 0, 0, 0]", "[0, -1.57, 3.2, 0, 0, 0]"):
        bench.run(program(f"{MOVE[:-1]}, r=0.05)\nmovej({goal})", "far"))
        bench.tick()
        bench.until(lambda: bench.state == RuntimeState.STOPPED)
        _, (line, column, text), stopped = events(bench)
        assert (line, column, stopped) == (3, 3, ("PROGRAM_XXX_STOPPED", "far"))
        assert "allowed are" in text
        assert bench.controller.safety.safety_mode == SafetyMode.NORMAL
        assert bench.moved == 0.0


def test_a_program_runs_from_its_first_tick_to_its_end(bench):
    bench.run(program("write_output_integer_register(0, 1)\nsync()\nwrite_output_integer_register(0, 2)", "three"))
    assert bench.controller.program.state == RuntimeState.PLAYING
    bench.tick()
    assert (bench.state, count(bench)) == (RuntimeState.PLAYING, 1)
    bench.tick()
    assert (bench.state, count(bench)) == (RuntimeState.STOPPED, 2)
    assert bench.ask("get loaded program") == "Loaded program: three"


def test_a_line_is_a_program_that_replaces_the_one_that_runs(bench):
    bench.run(program(COUNT + IDLE))
    bench.tick(5)
    bench.run("set_standard_digital_out(4, True)\n")
    bench.tick(3)
    assert bench.controller.io.outputs == 1 << 4
    assert bench.state == RuntimeState.STOPPED
    assert count(bench) == 5


def test_a_program_that_cannot_be_read_ends_the_one_that_runs(bench):
    for text, word in (("def p(:\nend\n", b""), (program("nothing_like_it()"), b"nothing_like_it")):
        bench.run(program(COUNT + IDLE))
        bench.tick(5)
        bench.run(text)
        bench.tick(3)
        assert bench.state == RuntimeState.STOPPED
        assert word in heard(bench)


def test_an_error_ends_the_program_and_stops_the_arm(bench):
    bench.run(program(f"def go():\n  {MOVE}\nend\nthread t():\n  go()\nend\nh = run t()\nsleep(0.4)\nx = 1 / 0"))
    bench.until(lambda: bench.state == RuntimeState.STOPPING)
    assert bench.moved > 0.0
    assert b"division by zero" in heard(bench)
    assert bench.until(lambda: bench.state == RuntimeState.STOPPED) < 40
    assert bench.moved == 0.0


def test_an_infinite_loop_ends_the_program(bench):
    bench.run(program("while True:\nend"))
    bench.tick(2)
    assert bench.state == RuntimeState.STOPPED
    assert b"infinite loop" in heard(bench)


def test_the_final_deceleration_is_within_its_limit(bench):
    bench.run(program("speedj([0.8, 0, 0, 0, 0, 0], 5, 0.3)"))
    bench.until(lambda: bench.state == RuntimeState.STOPPING)
    speeds = [bench.qd[0]]
    while bench.state == RuntimeState.STOPPING:
        bench.tick()
        speeds.append(bench.qd[0])
    assert speeds[0] == pytest.approx(0.8, rel=0.1)
    assert speeds[-1] == 0.0
    assert np.abs(np.diff(speeds)).max() / bench.tick_s <= 8.0 * 1.01
    assert len(speeds) * bench.tick_s == pytest.approx(0.8 / 8.0, abs=0.03)


def test_another_program_takes_over_while_the_arm_moves(bench):
    bench.run(program(MOVE))
    bench.tick(60)
    assert bench.moved > 0.0
    bench.run(program(f"movej({HOME}, a=3, v=1)"))
    bench.tick()
    assert bench.state == RuntimeState.PLAYING
    bench.until(lambda: bench.state == RuntimeState.STOPPED)
    assert bench.q == pytest.approx(HOME, abs=1e-6)


def test_another_program_ends_the_motion_of_the_one_before(bench):
    bench.run(program(MOVE))
    bench.tick(60)
    bench.run(program(COUNT + IDLE))
    bench.passing(0.3)
    assert bench.moved == 0.0
    assert bench.q[0] < 0.8
    assert bench.state == RuntimeState.PLAYING


def test_secondary_programs_move_nothing(bench):
    bench.run(program(COUNT + IDLE))
    bench.tick(5)
    bench.run("sec s():\n  set_standard_digital_out(2, True)\nend\n")
    bench.run(f"sec m():\n  {MOVE}\nend\n")
    bench.tick(5)
    assert bench.controller.io.outputs == 1 << 2
    assert bench.state == RuntimeState.PLAYING
    assert count(bench) == 10
    assert bench.q == pytest.approx(HOME)
    assert b"secondary" in heard(bench)


def test_secondary_programs_run_without_another(bench):
    bench.run("sec s():\n  set_standard_digital_out(2, True)\nend\n")
    bench.tick(2)
    assert bench.controller.io.outputs == 1 << 2
    assert bench.state == RuntimeState.STOPPED


def test_there_are_not_endlessly_many_secondary_programs(bench):
    for _ in range(50):
        bench.run("sec s():\n  while True:\n    sync()\n  end\nend\n")
    assert len(bench.controller.program._secondary) == 8
    bench.tick(3)


def test_play_starts_the_last_program_anew(bench):
    with pytest.raises(OperationRefusedError, match="no program"):
        bench.pendant.play()
    assert bench.ask("play") == "Failed to execute: play"
    bench.run(program(COUNT + IDLE))
    bench.tick(5)
    assert bench.ask("stop") == "Stopped"
    bench.tick(3)
    assert (bench.state, count(bench)) == (RuntimeState.STOPPED, 5)
    assert bench.ask("play") == "Starting program"
    bench.tick(4)
    assert (bench.state, count(bench)) == (RuntimeState.PLAYING, 9)
    assert bench.ask("play") == "Starting program"  # it plays already
    bench.tick(4)
    assert count(bench) == 13


def test_pause_holds_the_program_and_play_resumes(bench):
    bench.run(program(COUNT + IDLE))
    bench.tick(5)
    assert bench.ask("pause") == "Pausing program"
    bench.tick()
    assert bench.state == RuntimeState.PAUSING
    bench.tick(40)
    assert bench.state == RuntimeState.PAUSED
    assert bench.ask("programState").startswith("PAUSED")
    assert count(bench) == 5
    bench.pendant.pause()
    bench.pendant.play()
    bench.tick()
    assert bench.state == RuntimeState.RESUMING
    bench.tick(40)
    assert bench.state == RuntimeState.PLAYING
    assert count(bench) == 46


def test_pause_needs_a_playing_program(bench):
    assert bench.ask("pause") == "Failed to execute: pause"
    bench.pendant.stop()
    bench.tick(3)
    assert bench.state == RuntimeState.STOPPED


def test_the_speed_changes_without_a_jump(bench):
    bench.run(program(MOVE))
    bench.tick(80)
    speeds, scalings = [], []
    for slider in (0.3, 1.0, 0.0, 0.7):
        bench.controller.io.set_slider(slider)
        for _ in range(40):
            bench.tick()
            speeds.append(bench.qd[0])
            scalings.append(bench.controller.values["speed_scaling"])
        assert scalings[-1] == pytest.approx(slider)
    # Its own speed is at most 1 rad/s, and the slider takes a quarter of a second over its range.
    assert np.abs(np.diff(scalings)).max() <= bench.tick_s / 0.25 + 1e-9
    assert np.abs(np.diff(speeds)).max() <= (1.0 / 0.25 + 3.0) * bench.tick_s * 1.01


@pytest.mark.parametrize("family", ["cb3", "e-series"])
def test_an_operators_stop_decelerates_on_every_family(family):
    bench = Bench(family)
    bench.run(program(MOVE))
    bench.passing(0.5)
    before = bench.qd.copy()
    assert before[0] > 0.3
    bench.pendant.stop()
    bench.tick()
    assert 0.0 < bench.qd[0] < before[0]
    bench.passing(0.2)
    assert bench.state == RuntimeState.STOPPED
    assert bench.moved == 0.0


def test_output_registers_outlive_the_program(bench):
    bench.run(program("write_output_float_register(3, 2.5)\nwrite_output_integer_register(4, 7)"))
    bench.tick(5)
    registers = bench.controller.registers
    assert (registers.output_double[3], registers.output_int[4]) == (2.5, 7)


def test_a_program_that_cannot_be_read_is_not_kept(bench):
    with pytest.raises(ScriptSyntaxError, match="line 1"):
        bench.pendant.keep("a.urp", "def p(:\n")
    assert not bench.pendant.programs


def test_play_starts_the_program_that_the_dashboard_reports(bench):
    bench.pendant.keep("a.urp", program("write_output_integer_register(9, 1)\n" + IDLE))
    bench.pendant.load("a.urp")
    assert bench.ask("get loaded program") == "Loaded program: a.urp"
    assert bench.ask("isProgramSaved") == "true a.urp"
    bench.run(program("write_output_integer_register(9, 2)\n" + IDLE))
    bench.tick(3)
    assert bench.ask("isProgramSaved").startswith("false")
    assert "a.urp" not in bench.ask("programState")
    assert bench.controller.registers.output_int[9] == 2
    bench.pendant.load("a.urp")
    bench.tick(3)
    bench.pendant.play()
    bench.tick(3)
    assert bench.ask("programState") == "PLAYING a.urp"
    assert bench.controller.registers.output_int[9] == 1


def test_two_threads_do_not_move_the_arm(bench):
    text = f"thread t():\n  {MOVE}\nend\nh = run t()\nsync()\nmovej({HOME})"
    bench.run(program(text))
    bench.tick(5)
    assert b"another thread" in heard(bench)
    bench.tick(60)
    assert bench.state == RuntimeState.STOPPED
