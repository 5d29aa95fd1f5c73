"""Programs that clients send to ports 30001, 30002 and 30003."""

import pytest

from tests.conformance.wire import PRIMARY, REALTIME, SECONDARY, Primary, pose_distance

TRACE = "timestamp,runtime_state,output_int_register_10,output_int_register_11,output_double_register_10"

INT, OTHER_INT, DOUBLE = TRACE.split(",")[2:]


@pytest.mark.parametrize("port", [PRIMARY, SECONDARY, REALTIME])
def test_programs_write_output_registers_for_rtde(controller, token, port):
    text = (
        f"def conformance():\n  write_output_integer_register(10, {-token})\n"
        f"  write_output_float_register(10, {token} / 8)\n  write_output_integer_register(11, {token})\nend\n"
    )
    with controller.rtde(TRACE) as rtde:
        controller.run(text, port)
        found = rtde.until(lambda now: now[OTHER_INT] == token, "the program to write")[-1]
    assert found[INT] == -token
    assert found[DOUBLE] == token / 8


def test_a_line_is_a_program(controller, token):
    with controller.rtde(TRACE) as rtde:
        controller.run(f"write_output_integer_register(10, {token})\n")
        rtde.until(lambda now: now[INT] == token, "the line to be run")


def test_programs_read_inputs_from_rtde(controller, token):
    with controller.rtde(TRACE) as rtde:
        recipe, _ = rtde.inputs("input_int_register_20,input_double_register_20")
        rtde.write(recipe, token, token / 4)
        controller.call(
            "while True:\n write_output_float_register(10, read_input_float_register(20))\n"
            " write_output_integer_register(10, read_input_integer_register(20))\n sync()\nend"
        )
        assert rtde.until(lambda now: now[INT] == token, "the program to see it")[-1][DOUBLE] == token / 4
        rtde.write(recipe, token + 1, token / 2)
        assert rtde.until(lambda now: now[INT] == token + 1, "the program to see that")[-1][DOUBLE] == token / 2


@pytest.mark.parametrize(
    "wrong",
    [
        "write_output_integer_register(10, {bad})\n1 = = 2",
        "write_output_integer_register(10, {bad}",
        "write_output_integer_register(10, {bad})\nthere_is_no_such_function(1)",
    ],
    ids=["no expression", "a bracket that stays open", "an unknown function"],
)
def test_an_invalid_program_does_not_run_but_the_next_one_does(controller, token, wrong):
    with controller.rtde(TRACE) as rtde:
        controller.call(wrong.format(bad=-token))
        controller.call(f"write_output_integer_register(11, {token})")
        seen = rtde.until(lambda now: now[OTHER_INT] == token, "the good program to run")
        assert -token not in [each[INT] for each in seen]


def test_a_program_that_fails_as_it_runs_stops_there(controller, token):
    with controller.rtde(TRACE) as rtde:
        controller.call(
            f"write_output_integer_register(10, {token})\nlist = [1, 2, 3]\nindex = 7\n"
            f"write_output_integer_register(11, {token} + list[index])"
        )
        rtde.until(lambda now: now[INT] == token, "the program to begin")
        seen = rtde.until(lambda now: now["runtime_state"] == 1, "the program to end")
        assert not any(token <= each[OTHER_INT] <= token + 3 for each in seen)
        controller.call(f"write_output_integer_register(11, {token})")
        rtde.until(lambda now: now[OTHER_INT] == token, "the next program to run")


def test_textmsg_arrives_on_the_primary_interface(controller, token):
    with Primary(controller.host) as primary:
        primary.state()
        controller.call(f'textmsg("conformance ", {token})')
        texts = []
        for _ in range(20):
            source, text = primary.message(0)
            texts.append(text)
            if text == f"conformance {token}".encode():
                assert source == -3
                return
    pytest.fail(f"only {texts} came")


def test_a_secondary_program_runs_concurrently(controller, token):
    with controller.rtde(TRACE) as rtde:
        controller.call("i = 0\nwhile True:\n i = i + 1\n write_output_integer_register(10, i)\n sync()\nend")
        rtde.until(lambda now: now["runtime_state"] == 2, "the program to run")
        before = rtde.latest()[INT]
        controller.run(f"sec beside():\n  write_output_integer_register(11, {token})\nend\n")
        seen = rtde.until(lambda now: now[OTHER_INT] == token, "the secondary program to run")
        seen += rtde.until(lambda now: now[INT] > seen[-1][INT] + 20, "the program to go on")
    assert {each["runtime_state"] for each in seen} == {2}
    counts = [each[INT] for each in seen]
    assert counts == sorted(counts)  # it did not begin anew
    assert counts[0] >= before


def test_a_new_program_replaces_the_one_that_runs(controller, token):
    with controller.rtde(TRACE) as rtde:
        controller.call("i = 0\nwhile True:\n i = i + 1\n write_output_integer_register(10, i)\n sync()\nend")
        rtde.until(lambda now: now[INT] > 5, "the program to run")
        controller.call(f"write_output_integer_register(11, {token})\nwhile True:\n sync()\nend")
        rtde.until(lambda now: now[OTHER_INT] == token, "the other program to run")
        seen = [rtde.data() for _ in range(20)]
    assert len({each[INT] for each in seen}) == 1
    assert seen[-1]["runtime_state"] == 2


def states(packages):
    """Return the successive states of the program."""
    found = [each["runtime_state"] for each in packages]
    return [state for index, state in enumerate(found) if index == 0 or found[index - 1] != state]


def test_a_program_plays_and_then_has_stopped(controller, token):
    with controller.rtde(TRACE) as rtde:
        seen = [rtde.data()]
        controller.call(
            f"i = 0\nwhile i < 50:\n i = i + 1\n sync()\nend\nwrite_output_integer_register(10, {token})\nsync()"
        )
        seen += rtde.until(lambda now: now[INT] == token, "the program to come to its end")
        seen += rtde.until(lambda now: now["runtime_state"] == 1, "the program to have stopped")
    # "Stopping" may be seen, or be over within a control period.
    assert [state for state in states(seen) if state != 0] == [1, 2, 1]


def test_robot_bits_report_a_running_program(controller):
    with controller.rtde("runtime_state,robot_status_bits") as rtde:
        assert rtde.data()["robot_status_bits"] & 0b11 == 0b01
        controller.call("while True:\n sync()\nend")
        assert rtde.until(lambda now: now["runtime_state"] == 2, "a program")[-1]["robot_status_bits"] & 0b11 == 0b11


def test_sync_is_one_control_period(controller):
    with controller.rtde(TRACE) as rtde:
        controller.call("i = 0\nwhile i <= 100:\n write_output_integer_register(10, i)\n i = i + 1\n sync()\nend")
        rtde.until(lambda now: now["runtime_state"] == 2 and now[INT] == 0, "the program to begin")
        first = rtde.until(lambda now: now[INT] > 0, "the program to count")[-1]
        last = rtde.until(lambda now: now[INT] == 100, "the program to count to 100")[-1]
    ticks = round((last["timestamp"] - first["timestamp"]) / controller.tick_s)
    assert ticks == last[INT] - first[INT]
    assert ticks > 90


def test_sleep_has_its_duration(controller):
    with controller.rtde(TRACE) as rtde:
        controller.call(
            "write_output_integer_register(10, -1)\nsleep(0.2)\nwrite_output_integer_register(10, -2)\nsync()"
        )
        first = rtde.until(lambda now: now[INT] == -1, "the program to begin")[-1]["timestamp"]
        last = rtde.until(lambda now: now[INT] == -2, "the program to go on")[-1]["timestamp"]
    assert last - first == pytest.approx(0.2, abs=1.5 * controller.tick_s)


def test_threads_run_concurrently(controller, token):
    with controller.rtde(TRACE) as rtde:
        controller.call(
            "thread other():\n  j = 0\n  while True:\n    j = j + 1\n    write_output_integer_register(11, j)\n"
            "    sync()\n  end\nend\nhandle = run other()\ni = 0\nwhile True:\n  i = i + 1\n"
            "  write_output_integer_register(10, i)\n  sync()\nend"
        )
        rtde.until(lambda now: now["runtime_state"] == 2 and now[INT] > 3 and now[OTHER_INT] > 3, "both to count")
        seen = [rtde.data() for _ in range(20)]
    assert {abs(each[INT] - each[OTHER_INT]) for each in seen} <= {0, 1}
    assert seen[-1][INT] >= seen[0][INT] + 19


def test_a_program_may_come_in_pieces(controller, token):
    text = f"def conformance():\n  write_output_integer_register(10, {token})\nend\n".encode()
    with controller.rtde(TRACE) as rtde, Primary(controller.host, SECONDARY) as client:
        for begin in range(0, len(text), 15):
            client.send(text[begin : begin + 15])
            after = rtde.latest()["timestamp"] + 4 * controller.tick_s
            rtde.until(lambda now, after=after: now["timestamp"] > after, "time to pass")
        rtde.until(lambda now: now[INT] == token, "the program to run")


def test_a_program_that_never_ended_is_not_run(controller, token):
    with controller.rtde(TRACE) as rtde:
        controller.run(f"def conformance():\n  write_output_integer_register(10, {-token})\n")
        controller.call(f"write_output_integer_register(11, {token})")
        seen = rtde.until(lambda now: now[OTHER_INT] == token, "the other program to run")
    assert -token not in [each[INT] for each in seen]


def test_programs_and_rtde_report_the_same_values(controller):
    names = "timestamp,runtime_state,actual_q,actual_TCP_pose," + ",".join(
        f"output_double_register_{i}" for i in range(12)
    )
    with controller.rtde(names) as rtde:
        lines = ["q = get_actual_joint_positions()", "p = get_actual_tcp_pose()"]
        lines += [f"write_output_float_register({i}, q[{i}])" for i in range(6)]
        lines += [f"write_output_float_register({6 + i}, p[{i}])" for i in range(6)]
        controller.call("\n".join([*lines, "sync()"]))
        rtde.until(lambda now: now["runtime_state"] == 2, "the program to run")
        seen = rtde.until(lambda now: now["runtime_state"] == 1, "the program to end")[-1]
    registers = [seen[f"output_double_register_{i}"] for i in range(12)]
    assert registers[:6] == pytest.approx(seen["actual_q"], abs=1e-3)
    assert max(pose_distance(registers[6:], seen["actual_TCP_pose"])) < 2e-3


def test_forward_and_inverse_kinematics_agree(controller):
    names = "timestamp,runtime_state,actual_q," + ",".join(f"output_double_register_{i}" for i in range(7))
    with controller.rtde(names) as rtde:
        lines = ["q = get_actual_joint_positions()", "found = get_inverse_kin(get_forward_kin(q), q)"]
        lines += [f"write_output_float_register({i}, found[{i}] - q[{i}])" for i in range(6)]
        controller.call("\n".join([*lines, "write_output_float_register(6, 1)", "sync()"]))
        rtde.until(lambda now: now["runtime_state"] == 2, "the program to run")
        seen = rtde.until(lambda now: now["runtime_state"] == 1, "the program to end")[-1]
    assert seen["output_double_register_6"] == 1
    assert [seen[f"output_double_register_{i}"] for i in range(6)] == pytest.approx([0] * 6, abs=1e-6)
