"""Clients of plain sockets that send URScript and read the streams."""

import contextlib
import itertools
import math

import pytest

from tests.conformance.wire import (
    JOINT_DATA,
    MASTERBOARD_DATA,
    REALTIME,
    ROBOT_MODE_DATA,
    SECONDARY,
    Bounded,
    Client,
    Primary,
    Realtime,
    Rtde,
    joint_data,
    pose_distance,
    robot_mode_data,
)
from tests.ur_emulator.pairs import EmulatedPair
from ur_core.kinematics.robots import MODEL_OF_FAMILY

BOTH = pytest.mark.parametrize("family", ["cb3", "e-series"], indirect=True, scope="module")
CB3 = pytest.mark.parametrize("family", ["cb3"], indirect=True, scope="module")

NAMES = (
    "timestamp,runtime_state,safety_mode,actual_q,actual_qd,target_q,target_qd,actual_TCP_pose,"
    "actual_digital_output_bits"
)

CLOSE_RAD = 1e-4


@pytest.fixture(scope="module")
def family(request):
    with EmulatedPair(robot=MODEL_OF_FAMILY[request.param]) as cell:
        yield cell


@pytest.fixture
def cell(family):
    """The cell, without program and motion of the previous test."""
    yield family
    for host in (family.left, family.right):
        with watch(host) as rtde:
            send(host, "stopj(10)\n")
            rtde.until(at_rest, "the arm to stand")


class Arm:
    """One arm: a socket that commands it, and RTDE that reports its state."""

    def __init__(self, host, port, tick_s):
        self.socket, self.rtde, self.tick_s = Client(host, port), watch(host), tick_s
        self.start = self.rtde.data()

    def send(self, text):
        self.socket.send(text.encode())

    def until(self, condition, what):
        return self.rtde.until(condition, what)

    def until_there(self, q):
        """Return the packages until the arm stands at joint positions, and the program has ended."""
        return self.until(lambda now: at_rest(now) and away(now, q) < CLOSE_RAD, f"the arm to be at {q}")

    def close(self):
        self.socket.sock.close()
        self.rtde.sock.close()


@pytest.fixture
def arm(cell):
    """Factory of connections to an arm, which are closed at the end."""
    with contextlib.ExitStack() as stack:

        def connect(name, port):
            found = Arm(getattr(cell, name), port, 0.008 if cell.description[name]["family"] == "cb3" else 0.002)
            stack.callback(found.close)
            return found

        yield connect


def watch(host):
    rtde = Rtde(host)
    rtde.outputs(NAMES)
    assert rtde.start()
    return rtde


def send(host, text):
    with Client(host, SECONDARY) as client:
        client.send(text.encode())
        with watch(host) as rtde:  # time for it to be read
            first = rtde.data()["timestamp"]
            rtde.until(lambda now: now["timestamp"] > first + 0.03, "time to pass")


def at_rest(state):
    return state["runtime_state"] == 1 and max(map(abs, state["actual_qd"])) < 1e-3


def away(state, q):
    return max(abs(a - b) for a, b in zip(state["actual_q"], q, strict=True))


def moved(state, *by):
    """Return the joint positions of a state, with the last joints moved."""
    q = list(state["actual_q"])
    for index, angle in enumerate(by):
        q[6 - len(by) + index] += angle
    return q


def written(q):
    return "[" + ", ".join(f"{each:.9f}" for each in q) + "]"


def highest_speed(seen):
    return max(max(map(abs, each["target_qd"])) for each in seen)


def seconds(seen):
    """Return the duration of the arm's motion."""
    moving = [each["timestamp"] for each in seen if max(map(abs, each["target_qd"])) > 1e-6]
    return moving[-1] - moving[0]


@BOTH
@pytest.mark.parametrize("port", [SECONDARY, REALTIME])
def test_a_line_with_movej_moves_the_arm_there(arm, port):
    left = arm("left", port)
    goal = moved(left.start, 0.15, -0.2, 0.5)
    left.send(f"movej({written(goal)}, a=6.0, v=1.5)\n")
    seen = left.until_there(goal)
    assert highest_speed(seen) == pytest.approx(1.5, rel=1e-3)
    assert {each["runtime_state"] for each in seen} >= {1, 2}
    back = left.start["actual_q"]
    left.send(f"movej({written(back)}, a=6.0, v=1.5)\n")
    left.until_there(back)


@CB3
@pytest.mark.parametrize("port", [SECONDARY, REALTIME])
def test_movej_with_a_time_takes_that_time(arm, port):
    left = arm("left", port)
    goal = moved(left.start, 0.2)
    left.send(f"movej({written(goal)}, t=0.4)\n")
    assert seconds(left.until_there(goal)) == pytest.approx(0.4, abs=0.02)


@BOTH
def test_a_program_of_blended_moves_does_not_stop_in_between(arm):
    left = arm("left", SECONDARY)
    one, two = moved(left.start, 0.3), moved(left.start, 0.3, 0.3, 0.3)
    program = "def blended():\n  movej({}, a=8, v=1.5{})\n  movej({}, a=8, v=1.5)\nend\n"

    def slowest(blend, *points):
        left.send(program.format(written(points[0]), blend, written(points[1])))
        seen = left.until_there(points[1])
        times = [each["timestamp"] for each in seen if each["runtime_state"] == 2]
        speeds = [math.hypot(*each["target_qd"]) for each in seen if each["runtime_state"] == 2]
        middle = [
            speed
            for speed, at in zip(speeds, times, strict=True)
            if 0.2 < (at - times[0]) / (times[-1] - times[0]) < 0.8
        ]
        return min(middle), min(away(each, points[0]) for each in seen)

    blended_speed, missed_by = slowest(", r=0.1", one, two)
    left.send(f"movej({written(left.start['actual_q'])}, a=8, v=2.0)\n")
    left.until_there(left.start["actual_q"])
    stopped_speed, reached = slowest("", one, two)
    assert stopped_speed < 0.05
    assert reached < 1e-3
    assert blended_speed > 0.2
    assert missed_by > 1e-3


@BOTH
def test_movel_moves_the_tool_along_a_line(arm):
    left = arm("left", SECONDARY)
    begin = left.start["actual_TCP_pose"]
    goal = list(begin)
    goal[0] += 0.09
    goal[2] += 0.12
    left.send(f"movel(p{written(goal)}, a=1.2, v=0.4)\n")
    arrived = lambda now: at_rest(now) and max(pose_distance(now["actual_TCP_pose"], goal)) < CLOSE_RAD  # noqa: E731
    seen = left.until(arrived, "the tool to be there")
    for each in seen:
        offset = [a - b for a, b in zip(each["actual_TCP_pose"][:3], begin[:3], strict=True)]
        along = (3 * offset[0] + 4 * offset[2]) / 5
        assert math.dist(offset, (0.6 * along, 0.0, 0.8 * along)) < 3e-4
        assert pose_distance(each["actual_TCP_pose"], begin)[1] < 2e-3
    left.send(f"movel(p{written(begin)}, a=1.2, v=0.4)\n")
    left.until(
        lambda now: at_rest(now) and max(pose_distance(now["actual_TCP_pose"], begin)) < CLOSE_RAD,
        "the tool to be back",
    )


@BOTH
def test_a_program_with_a_servoj_loop_follows(arm):
    left = arm("left", REALTIME)
    goal = moved(left.start, 0.1)
    left.send(
        "def follow():\n  q = get_target_joint_positions()\n  first = q[5]\n  step = get_target_time\n  n = 0\n"
        "  while n * step < 0.6:\n    n = n + 1\n    q[5] = first + 0.05 * (1 - cos(5.23598776 * n * step))\n"
        "    servoj(q, t=step, lookahead_time=0.05, gain=500)\n  end\n  n = 0\n"
        "  while n * step < 0.3:\n    n = n + 1\n    servoj(q, t=step, lookahead_time=0.05, gain=500)\n  end\n"
        "  stopj(2)\nend\n".replace("get_target_time", str(left.tick_s))
    )
    seen = left.until_there(goal)
    assert {each["safety_mode"] for each in seen} == {1}
    # A raised cosine of 0.6 s and ±0.05 rad.
    assert highest_speed(seen) == pytest.approx(0.05 * math.pi / 0.6, rel=0.05)


@CB3
def test_a_stream_of_servoj_lines_moves_the_arm(arm):
    """Every line is a program that replaces the previous one."""
    left = arm("left", REALTIME)
    begin, speed = left.start["target_q"], 0.2
    first = left.start["timestamp"]
    seen = []
    while not seen or seen[-1]["timestamp"] - first < 1.0:
        seen.append(left.rtde.data())
        q = list(begin)
        q[5] += speed * min(0.8, max(0.0, seen[-1]["timestamp"] - first))
        left.send(f"servoj({written(q)}, t=0.008, lookahead_time=0.05, gain=500)\n")
    assert {each["safety_mode"] for each in seen} == {1}
    left.send("stopj(2)\n")
    end = left.until(at_rest, "the arm to stand")[-1]
    assert end["actual_q"][5] - begin[5] == pytest.approx(0.8 * speed, abs=0.02)
    assert end["actual_q"][:5] == pytest.approx(begin[:5], abs=1e-3)


@BOTH
def test_speedj_and_stopj(arm):
    left = arm("left", REALTIME)
    left.send("speedj([0, 0, 0, 0, 0, 0.4], a=2.0, t=10)\n")
    left.until(lambda now: now["actual_qd"][5] == pytest.approx(0.4, abs=0.01), "the joint to rotate")
    left.send("stopj(2.0)\n")
    seen = left.until(at_rest, "the arm to stand")
    slowing = [each for each in seen if 0.02 < each["target_qd"][5] < 0.38]
    rate = (slowing[0]["target_qd"][5] - slowing[-1]["target_qd"][5]) / (
        slowing[-1]["timestamp"] - slowing[0]["timestamp"]
    )
    assert rate == pytest.approx(2.0, rel=0.05)
    assert {each["safety_mode"] for each in seen} == {1}


@BOTH
@pytest.mark.parametrize("port", [SECONDARY, REALTIME])
def test_digital_outputs_are_set_by_both_functions(arm, port):
    left = arm("left", port)
    for line, bits in (
        ("set_digital_out(2, True)", 0b00100),
        ("digital_out[4]=True", 0b10100),
        ("digital_out[2]=False", 0b10000),
        ("set_standard_digital_out(4, False)", 0),
    ):
        left.send(f"{line}\n")
        left.until(lambda now, bits=bits: now["actual_digital_output_bits"] == bits, line)


@BOTH
def test_the_streams_of_both_ports_report_the_motion(arm, cell):
    left = arm("left", SECONDARY)
    goal = moved(left.start, 0.4)
    with Realtime(cell.left) as realtime, Primary(cell.left, SECONDARY) as secondary:
        left.send(f"def both():\n  set_digital_out(1, True)\n  movej({written(goal)}, a=2, v=0.5)\nend\n")
        packets, states = [], []
        for _ in Bounded("both streams to say that the arm is there"):
            states.append(secondary.state())
            time_s = robot_mode_data(states[-1][ROBOT_MODE_DATA])["timestamp_us"] / 1e6
            while not packets or packets[-1]["timestamp"] < time_s:
                packets.append(realtime.packet())
            mode = robot_mode_data(states[-1][ROBOT_MODE_DATA])
            actual, _, _ = joint_data(states[-1][JOINT_DATA])
            if not mode["program_running"] and actual == pytest.approx(goal, abs=CLOSE_RAD) and len(states) > 2:
                break
    running = [robot_mode_data(each[ROBOT_MODE_DATA])["program_running"] for each in states]
    assert any(running)
    assert {each["runtime_state"] for each in packets} >= {1.0, 2.0}
    assert max(each["actual_qd"][5] for each in packets) == pytest.approx(0.5, rel=0.02)
    assert max(joint_data(each[JOINT_DATA])[2][5] for each in states) > 0.3
    assert packets[-1]["actual_digital_output_bits"] == 2.0
    assert states[-1][MASTERBOARD_DATA][4:8] == b"\0\0\0\2"
    by_time = {round(each["timestamp"] * 1e4): each for each in packets}
    shared = 0
    for state in states:
        at = round(robot_mode_data(state[ROBOT_MODE_DATA])["timestamp_us"] / 100)
        if at in by_time:
            shared += 1
            actual, _, speed = joint_data(state[JOINT_DATA])
            assert actual == pytest.approx(by_time[at]["actual_q"], abs=1e-9)
            assert speed == pytest.approx(by_time[at]["actual_qd"], abs=1e-9)
    assert shared > 3
    left.send("set_digital_out(1, False)\n")
    left.until(lambda now: now["actual_digital_output_bits"] == 0, "the output to be off")


@BOTH
def test_two_sockets_move_both_arms_at_the_same_time(arm):
    left, right = arm("left", SECONDARY), arm("right", REALTIME)
    left.send("speedj([0, 0, 0, 0, 0, 0.4], a=4, t=30)\n")
    right.send("speedj([0, 0, 0, 0, 0, -0.3], a=4, t=30)\n")
    left.until(lambda now: now["actual_qd"][5] == pytest.approx(0.4, abs=0.01), "the left arm to rotate")
    right.until(lambda now: now["actual_qd"][5] == pytest.approx(-0.3, abs=0.01), "the right arm to rotate")
    assert left.rtde.latest()["actual_qd"][5] == pytest.approx(0.4, abs=0.01)
    goals = left.start["actual_q"], right.start["actual_q"]
    for one, goal in zip((left, right), goals, strict=True):
        one.send(f"movej({written(goal)}, a=6, v=1.5)\n")
    for one, goal in zip((left, right), goals, strict=True):
        assert {each["safety_mode"] for each in one.until_there(goal)} == {1}


@BOTH
def test_one_arm_is_not_disturbed_by_the_other(arm, cell):
    """Motion, stops, outputs and failing programs of one arm do not affect the other."""
    left, right = arm("left", SECONDARY), arm("right", SECONDARY)
    right.send("speedj([0, 0, 0, 0, 0, 0.2], a=2.0, t=20)\n")
    right.until(lambda now: now["target_qd"][5] == pytest.approx(0.2), "the right arm to rotate")
    left.send(f"movej({written(moved(left.start, 0.2))}, a=4, v=1.0)\n")
    left.until_there(moved(left.start, 0.2))
    left.send("set_digital_out(3, True)\n")
    left.until(lambda now: now["actual_digital_output_bits"] == 8, "the left output")
    left.send("no_such_function()\n")
    cell.ask("stop", arm="left", mode=3)
    left.until(lambda now: now["safety_mode"] == 3, "the left arm to be stopped")
    cell.ask("drop", arm="left", port="secondary")
    cell.ask("release", arm="left", mode=3)
    first = right.rtde.latest()["timestamp"]
    seen = right.until(lambda now: now["timestamp"] > first + 0.1, "time to pass")
    for each in seen:
        assert each["target_qd"][5] == pytest.approx(0.2, abs=1e-6)
        assert each["actual_qd"][5] == pytest.approx(0.2, abs=0.01)
        assert (each["runtime_state"], each["safety_mode"], each["actual_digital_output_bits"]) == (2, 1, 0)
    other = arm("left", SECONDARY)
    other.send("set_digital_out(3, False)\n")
    other.until(lambda now: now["actual_digital_output_bits"] == 0, "the left output")


@BOTH
def test_two_clients_of_one_arm_take_it_from_each_other(arm):
    """The last line wins on any port, and the arm has no jump."""
    one, other = arm("left", SECONDARY), arm("left", REALTIME)
    there, back = moved(one.start, 0.5), moved(one.start, -0.1)
    one.send(f"movej({written(there)}, a=2, v=0.5)\n")
    one.until(lambda now: now["target_qd"][5] > 0.45, "the arm to move")
    other.send(f"movej({written(back)}, a=2, v=0.5)\n")
    seen = other.until_there(back)
    speeds = [each["target_qd"][5] for each in seen]
    assert max(abs(b - a) for a, b in itertools.pairwise(speeds)) < 0.1
    assert max(each["actual_q"][5] for each in seen) < there[5] - 0.1
    assert {each["safety_mode"] for each in seen} == {1}
