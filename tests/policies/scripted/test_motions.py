"""Motions of both tools, driven step by step with arms that follow every command."""

import numpy as np
import pytest

from dual_ur10.assets.settings import SceneSettings, home_q_rad
from dual_ur10.envs.tasks.handover.task import Handover
from dual_ur10.envs.tasks.sine_tracking.task import SineTracking
from dual_ur10.envs.tasks.task import Timing
from dual_ur10.policies.scripted.base import Script
from dual_ur10.policies.scripted.motions import Motions, least_jerk, pair, raised
from ur_core.kinematics import flange_pose_quat
from ur_core.kinematics.frames import Frames
from ur_core.kinematics.poses import Poses, pose, relative_to, rotation_angle, yaw_quat
from ur_core.kinematics.rotations import quat_multiply, rotate
from ur_core.tools.tool import levers_m

TIMING = Timing(0.04, 0.04)
MOUNTS = SceneSettings().mounts
FRAMES = Frames(MOUNTS)


class Bench:
    """Arms that are at every command after one period, and grippers that move by 5 mm in it."""

    def __init__(self, task=Handover):
        self.script = type("Bench", (Script,), {"task": task, "script": lambda self, fields: iter(())})(TIMING)
        layout = task.layout
        self.fields = layout.split(np.zeros(2 * layout.size))
        self.fields["commanded_q_rad"][:] = home_q_rad(MOUNTS)
        if "gripper_m" in self.fields:
            self.fields["gripper_m"][:] = 0.08
        self.arms, self.widths_m = Motions(self.script, self.fields), []

    def run(self, steps, most=1000):
        """Return the tool poses at the end of each step."""
        tools, wish = [], next(steps)
        for _ in range(most):
            fields = {name: value.copy() for name, value in self.fields.items()}
            fields["commanded_q_rad"][:] = wish.q_rad
            if wish.opening is not None:
                goal = 0.04 * (1.0 + wish.opening[:, None])
                fields["gripper_m"] += np.clip(goal - fields["gripper_m"], -0.005, 0.005)
                self.widths_m.append(fields["gripper_m"][:, 0])
            self.fields = fields
            tools.append(self.tools())
            try:
                wish = steps.send(fields)
            except StopIteration:
                break
        return Poses(*(np.stack(each) for each in zip(*tools, strict=True)))

    def tools(self):
        """Return the poses of both tools in the cell frame, at the commanded joint positions."""
        q_rad = self.fields["commanded_q_rad"]
        found = [flange_pose_quat(q, mount.dh) for q, mount in zip(q_rad, MOUNTS, strict=True)]
        position, quat = (np.stack(each) for each in zip(*found, strict=True))
        quat = FRAMES.quat_to_cell(quat)
        lever = levers_m(self.script.tools) if self.arms.opening is not None else np.zeros((2, 3))
        return Poses(FRAMES.position_to_cell(position) + rotate(quat, lever), quat)


def elsewhere(tools):
    """Return goals beside tools, at different distances and angles."""
    shift = np.array([[0.1, -0.05, -0.1], [0.0, 0.02, 0.05]])
    return Poses(tools.position_m + shift, quat_multiply(yaw_quat(np.array([0.4, -0.1])), tools.quat))


def assert_equal(found, expected, atol=1e-6):
    np.testing.assert_allclose(found.position_m, expected.position_m, atol=atol)
    assert rotation_angle(relative_to(expected, found).quat).max() < 10 * atol


@pytest.mark.parametrize("task", [Handover, SineTracking])
def test_tools_are_those_of_the_command_with_and_without_grippers(task):
    bench = Bench(task)
    assert_equal(bench.arms.tools, bench.tools())


def test_a_line_is_straight_begins_and_ends_at_rest_and_keeps_its_speed():
    bench = Bench()
    begin, goal = bench.arms.tools, elsewhere(bench.arms.tools)
    path = bench.run(bench.arms.line(goal, speed_m_s=0.1))
    assert_equal(bench.tools(), goal)
    assert_equal(bench.arms.tools, goal)
    away, whole = path.position_m - begin.position_m, goal.position_m - begin.position_m
    ratio = np.vecdot(away, whole) / np.vecdot(whole, whole)
    np.testing.assert_allclose(away, ratio[..., None] * whole, atol=1e-6)
    np.testing.assert_allclose(ratio[:, 0], ratio[:, 1], atol=1e-6)  # both together
    speed = np.linalg.norm(np.diff(path.position_m, axis=0, prepend=begin.position_m[None]), axis=2) / TIMING.period_s
    assert 0.095 < speed.max() <= 0.1
    assert max(speed[0].max(), speed[-1].max()) < 0.01


def test_a_motion_of_the_joints_is_proportional_and_within_their_limits():
    bench = Bench()
    begin, goal = bench.fields["commanded_q_rad"].copy(), elsewhere(bench.arms.tools)
    seen = []
    steps = bench.arms.move(goal)
    bench.run(observed(steps, seen))
    assert_equal(bench.tools(), goal)
    way = np.array(seen) - begin
    np.testing.assert_allclose(way / way[-1], (way / way[-1])[:, :1, :1].repeat(2, 1).repeat(6, 2), atol=1e-6)
    speed = np.abs(np.diff(way, axis=0)) / TIMING.period_s
    assert 0.6 < (speed / bench.script.limits.speed_rad_s).max() < 0.71


def observed(steps, seen):
    """Pass steps on, and keep the joint positions that they command."""
    wish = next(steps)
    while True:
        seen.append(wish.q_rad)
        fields = yield wish
        try:
            wish = steps.send(fields)
        except StopIteration:
            return


def test_a_motion_waits_for_a_command_that_lags_behind_but_not_forever():
    bench = Bench()
    steps = bench.arms.move(raised(bench.arms.tools, 0.001))
    stuck = dict(bench.fields)
    next(steps)
    count = sum(1 for _ in iter(lambda: sent(steps, stuck), None))
    assert 25 <= count < 40


def sent(steps, fields):
    """Return the next wish; None: the motion has ended."""
    try:
        return steps.send(fields)
    except StopIteration:
        return None


def test_following_is_bounded_in_speed_and_keeps_the_grip_of_both():
    bench = Bench()
    begin, goal = bench.arms.tools, raised(bench.arms.tools, 0.05)
    goal.position_m[1] = begin.position_m[1]  # a goal of one arm only
    (first,) = bench.run(bench.arms.follow(goal, speed_m_s=0.05)).position_m
    np.testing.assert_allclose(
        first - begin.position_m, [[0.0, 0.0, 0.05 * TIMING.period_s], [0.0, 0.0, 0.0]], atol=1e-6
    )
    for _ in range(200):
        bench.run(bench.arms.follow(goal))
    assert_equal(bench.tools(), goal, atol=1e-5)


def test_grippers_close_until_their_fingers_rest_and_stay_closed():
    bench = Bench()
    assert bench.arms.opening.tolist() == [1.0, 1.0]
    path = bench.run(bench.arms.grip(-1.0, 1.0))
    assert bench.fields["gripper_m"][:, 0] == pytest.approx([0.0, 0.08])
    assert 19 <= len(path.position_m) <= 21  # 16 periods of 5 mm, and 0.15 s at rest
    assert_equal(Poses(path.position_m[-1], path.quat[-1]), Poses(path.position_m[0], path.quat[0]))
    seen = []
    bench.run(observed(bench.arms.hold(0.1), seen))
    assert len(seen) == 3
    assert bench.arms.opening.tolist() == [-1.0, 1.0]


def test_fingers_touch_and_leave_an_object_at_their_least_speed():
    bench, width_m = Bench(), np.array([0.02, 0.04])
    for command in (-1.0, 1.0):
        bench.widths_m.clear()
        bench.run(bench.arms.grip(command, width_m=width_m))
        path_m = np.stack(bench.widths_m)
        assert np.abs(np.diff(path_m, axis=0)).max() > 0.004  # fast in the air
        for arm in (0, 1):
            near = np.abs(path_m[:, arm] - width_m[arm]) < 0.008
            assert near.sum() > 10
            assert np.abs(np.diff(path_m[near, arm])).max() <= 0.02 * TIMING.period_s
    assert bench.arms.opening.tolist() == [1.0, 1.0]


def test_a_pose_is_of_the_cell_and_lies_where_it_is_said_to():
    bench = Bench()
    at = Poses(np.array([[0.1, 0.2, 0.03]] * 2), quat_multiply(yaw_quat(np.array(0.3)), [1.0, 0.01, 0.0, 0.0])[None])
    at = Poses(at.position_m, np.repeat(at.quat / np.linalg.norm(at.quat), 2, axis=0))
    bench.fields["block_base_m"][:] = FRAMES.position_to_base(at.position_m)
    bench.fields["block_base_quat"][:] = FRAMES.quat_to_base(at.quat)
    assert_equal(bench.arms.pose("block_base"), Poses(at.position_m[0], at.quat[0]))
    lying = bench.arms.pose("block_base", 0.02)
    assert lying.position_m == pytest.approx([0.1, 0.2, 0.02])
    assert rotation_angle(relative_to(lying, Poses(lying.position_m, yaw_quat(np.array(0.3)))).quat) < 1e-3
    bench.fields["force_n"][:] = [1.0, 2.0, 3.0]  # base is rotated by 180 degrees
    np.testing.assert_allclose(bench.arms.vector("force_n"), [[-1.0, -2.0, 3.0]] * 2, atol=1e-12)


def test_small_helpers():
    left, right = pose((1.0, 2.0, 3.0)), pose((4.0, 5.0, 6.0), (0.0, 1.0, -1.0, 0.0))
    both = raised(pair(left, right), 0.5)
    assert both.position_m.tolist() == [[1.0, 2.0, 3.5], [4.0, 5.0, 6.5]]
    assert both.quat[1] == pytest.approx([0.0, 0.5**0.5, -(0.5**0.5), 0.0])
    assert least_jerk(np.array([-1.0, 0.0, 0.5, 1.0, 2.0])).tolist() == [0.0, 0.0, 0.5, 1.0, 1.0]
