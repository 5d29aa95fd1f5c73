"""Protective stops, and stops at the end of a program. They need `--moves` at a given host."""

import itertools

import pytest

from tests.conformance.wire import PRIMARY, ROBOT_MODE_DATA, Bounded, Dashboard, Primary, robot_mode_data

pytestmark = pytest.mark.moves

TRACE = "timestamp,runtime_state,robot_mode,safety_mode,safety_status_bits,actual_q,target_q,target_qd"

JOINT = 5
"""The wrist's last joint: it turns the tool about itself, and is near nothing."""

SPEED_RAD_S = 0.5

STOPPED_BITS = 1 << 2 | 1 << 10


def rotating(extra):
    """Return a program that rotates the last joint evenly with servoj for 0.3 s, and then goes on with `extra`."""
    return (
        "q = get_target_joint_positions()\nstep = get_steptime_here\nspeed = 0.0\nn = 0\nwhile n * step < 0.3:\n"
        f"  speed = speed + 2.0 * step\n  if speed > {SPEED_RAD_S}:\n    speed = {SPEED_RAD_S}\n  end\n"
        f"  q[{JOINT}] = q[{JOINT}] + speed * step\n"
        f"  servoj(q, t=step, lookahead_time=0.03, gain=1000)\n  n = n + 1\nend\n{extra}"
    )


def call(controller, text):
    controller.call(text.replace("get_steptime_here", str(controller.tick_s)))


def at_rest(state):
    return max(map(abs, state["target_qd"])) < 1e-3


def stopped(rtde):
    """Return the packages until the arm has stopped protectively, and the first of them."""
    seen = rtde.until(lambda now: now["safety_mode"] != 1, "a protective stop")
    assert seen[-1]["safety_mode"] == 3
    return seen, seen[-1]


@pytest.mark.assumption("protective_stop_pauses")
@pytest.mark.assumption("unlock_wait_s")
def test_a_protective_stop_can_be_unlocked_only_later(controller, token):
    registers = "output_int_register_10,output_int_register_11"
    with (
        controller.rtde(f"{TRACE},{registers}") as rtde,
        Dashboard(controller.host) as dashboard,
        Primary(controller.host, PRIMARY) as primary,
    ):
        controller.call(
            f"write_output_integer_register(11, 0)\nprotective_stop()\nsync()\nsync()\nsync()\n"
            f"write_output_integer_register(11, {token})\nwhile True:\n sync()\nend"
        )
        _, first = stopped(rtde)
        assert first["safety_status_bits"] & STOPPED_BITS == STOPPED_BITS
        expected = 4 if controller.assumed.protective_stop_pauses else 1
        now = rtde.until(lambda now: now["runtime_state"] not in (2, 3, 0), "the program to pause or stop")[-1]
        assert now["runtime_state"] == expected
        assert now["output_int_register_11"] == 0
        assert dashboard.ask("safetymode") == "Safetymode: PROTECTIVE_STOP"
        for _ in Bounded("the primary interface to tell of the stop"):
            mode = robot_mode_data(primary.state()[ROBOT_MODE_DATA])
            if mode["protective_stopped"]:
                break
        assert mode["robot_mode"] == now["robot_mode"] == 7
        assert not mode["emergency_stopped"]
        refused = 0
        while True:
            before = rtde.latest()["timestamp"]
            answer = dashboard.ask("unlock protective stop")
            after = rtde.latest()["timestamp"]
            if answer == "Protective stop releasing":
                break
            assert answer.startswith("Cannot unlock protective stop until 5s after occurrence")
            assert before - first["timestamp"] < controller.assumed.unlock_wait_s + 2 * controller.tick_s
            refused += 1
            rtde.until(lambda now, after=after: now["timestamp"] > after + 0.05, "time to pass")
        assert refused
        assert after - first["timestamp"] > controller.assumed.unlock_wait_s - 2 * controller.tick_s
        now = rtde.until(lambda now: now["safety_mode"] == 1, "the stop to end")[-1]
        assert now["safety_status_bits"] & (STOPPED_BITS | 1) == 1
        assert now["runtime_state"] == expected
        assert dashboard.ask("play") == "Starting program"
        if controller.assumed.protective_stop_pauses:
            rtde.until(lambda now: now["output_int_register_11"] == token, "the program to go on")


@pytest.mark.assumption("primary_unlock_waits")
def test_the_primary_interface_unlocks_a_protective_stop(controller):
    with controller.rtde(TRACE) as rtde:
        controller.call("protective_stop()\nsync()")
        begin = stopped(rtde)[1]["timestamp"]
        controller.run("set unlock protective stop\n", PRIMARY)
        now = rtde.until(lambda now: now["safety_mode"] == 1 or now["timestamp"] > begin + 1.0, "the stop to end")[-1]
    assert (now["safety_mode"] != 1) == controller.assumed.primary_unlock_waits


@pytest.mark.assumption("starved_ticks")
def test_a_program_must_not_abandon_a_moving_arm(controller, token):
    register = "output_int_register_10"
    with controller.rtde(f"{TRACE},{register}") as rtde:
        wait = f"write_output_integer_register(10, {token})\nn = 0\nwhile n < 30:\n sync()\n n = n + 1\nend\nstopj(4)\n"
        call(controller, rotating(wait))
        seen, first = stopped(rtde)
        rest = rtde.until(at_rest, "the arm to stand")
    assert seen[-2]["target_qd"][JOINT] > 0.2 * SPEED_RAD_S
    alone = next(each["timestamp"] for each in seen if each[register] == token)
    ticks = round((first["timestamp"] - alone) / controller.tick_s)
    assert abs(ticks - controller.assumed.starved_ticks) <= 1
    assert rest[-1]["timestamp"] - first["timestamp"] <= controller.assumed.stopping_s + 2 * controller.tick_s


@pytest.mark.assumption("stopping_s")
def test_a_protective_stop_takes_as_long_as_assumed(controller):
    with controller.rtde(TRACE) as rtde:
        controller.call(
            f"thread stopper():\n  sleep(0.3)\n  protective_stop()\nend\nrun stopper()\n"
            f"speedj([0, 0, 0, 0, 0, {SPEED_RAD_S}], 4, 20)"
        )
        seen, first = stopped(rtde)
        rest = rtde.until(at_rest, "the arm to stand")
    assert max(each["target_qd"][JOINT] for each in seen) == pytest.approx(SPEED_RAD_S, rel=1e-3)
    took_s = rest[-1]["timestamp"] - first["timestamp"]
    assert took_s == pytest.approx(controller.assumed.stopping_s, rel=0.2, abs=2 * controller.tick_s)


@pytest.mark.assumption("starved_ticks")
def test_a_program_may_be_late_by_a_control_period(controller):
    ticks = max(0, controller.assumed.starved_ticks - 1)
    with controller.rtde(TRACE) as rtde:
        call(controller, rotating("sync()\n" * ticks + "stopj(4)\n"))
        rtde.until(lambda now: not at_rest(now), "the arm to move")
        seen = rtde.until(lambda now: now["runtime_state"] == 1, "the program to end")
    assert {each["safety_mode"] for each in seen} == {1}


@pytest.mark.assumption("servoj_jump_factor")
@pytest.mark.parametrize("fraction", [0.9, 1.15])
def test_servoj_targets_have_the_assumed_largest_jump(controller, fraction):
    lookahead_s = 0.03
    reach = controller.assumed.servoj_jump_factor * 3.1416 * (lookahead_s + controller.tick_s)
    with controller.rtde(TRACE) as rtde:
        call(
            controller,
            f"q = get_target_joint_positions()\nq[{JOINT}] = q[{JOINT}] + {fraction * reach}\nn = 0\n"
            "while n * get_steptime_here < 0.5:\n"
            f"  servoj(q, t=get_steptime_here, lookahead_time={lookahead_s}, gain=300)\n  n = n + 1\nend\nstopj(4)\n",
        )
        rtde.until(lambda now: now["runtime_state"] == 2, "the program to run")
        end = rtde.until(lambda now: now["runtime_state"] in (1, 4), "the program to end or to pause")[-1]
    assert end["safety_mode"] == (1 if fraction < 1 else 3)


@pytest.mark.assumption("program_stop_rad_s2")
def test_the_arm_slows_down_evenly_when_its_program_is_stopped(controller):
    with controller.rtde(TRACE) as rtde, Dashboard(controller.host) as dashboard:
        controller.call(f"speedj([0, 0, 0, 0, 0, {SPEED_RAD_S}], 4, 20)")
        rtde.until(lambda now: now["target_qd"][JOINT] > 0.999 * SPEED_RAD_S, "the arm to rotate")
        assert dashboard.ask("stop") == "Stopped"
        seen = rtde.until(at_rest, "the arm to stand")
        assert rtde.until(lambda now: now["runtime_state"] == 1, "the program to stop")[-1]["safety_mode"] == 1
    speeds = [(each["timestamp"], each["target_qd"][JOINT]) for each in seen]
    slowing = [
        (before - after) / (at - since)
        for (since, before), (at, after) in itertools.pairwise(speeds)
        if after > 0.02 and before < 0.98 * SPEED_RAD_S
    ]
    assert len(slowing) >= 3
    assert slowing == pytest.approx([controller.assumed.program_stop_rad_s2] * len(slowing), rel=0.1)
