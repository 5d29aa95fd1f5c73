"""Base of tasks whose arms grip props: layout, measurement, start and refusal."""

from dataclasses import dataclass

import numpy as np
import pytest

from dual_ur10.assets.prop import Prop
from dual_ur10.assets.settings import Equipment, home_q_rad
from dual_ur10.envs.core.core import Core
from dual_ur10.envs.tasks.geometry import APPROACH_M, frame_of
from dual_ur10.envs.tasks.goal_fields import GOAL_FIELDS
from dual_ur10.envs.tasks.grasping import SLOW, GraspingTask, Grip, Lead
from dual_ur10.envs.tasks.observation_layout import ARM_FIELDS, Field, ObservationLayout
from dual_ur10.envs.tasks.staged import stage
from dual_ur10.envs.tasks.task import SceneRequirements, Timing
from dual_ur10.errors import SettingsError
from dual_ur10.registration import register
from dual_ur10.sim2real.cell.cell import CellState
from dual_ur10.sim2real.cell.cell_config import CellConfig
from dual_ur10.sim2real.control.limits import MotionLimits
from ur_core.kinematics.forward import flange_pose_quat
from ur_core.kinematics.frames import Frames
from ur_core.kinematics.poses import Poses, compose, pose, relative_to

N = 2
CASE = Prop(
    name="case",
    mjcf="""<mujoco><compiler angle="degree"/><worldbody><body mocap="true"><geom type="box" size=".1 .1 .02"/>
    <body name="lid" pos="-.1 0 .03"><joint name="lid" axis="0 -1 0" range="0 90" damping="5"/>
    <geom type="box" size=".1 .1 .005" pos=".1 0 0" mass="0.2"/></body></body></worldbody></mujoco>""",
)
RNG = np.random.default_rng(1)


@dataclass(frozen=True)
class Brief:
    duration_s: float = 2.0


class Two(GraspingTask):
    """The left arm grips the cup, the right one the lid; a mark is observed, too."""

    limits = MotionLimits()
    observed = ("mark", "cup", "lid")
    grips = (
        Grip("cup", pose((0.0, 0.0, 0.02), (0.0, 0.0, 1.0, 0.0)), 0.04),
        Grip("lid", pose((0.1, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0)), 0.02),
    )

    def facts(self, state, measured):
        return measured

    @stage(weight=1.0)
    def hold(self, measured):
        return measured.holding.all(axis=1), 0.0

    start = None


class Stranger(Two):
    """Grips a prop that it does not observe."""

    observed = ("mark", "cup")


class Plain(Two):
    """States its own layout."""

    observed = ("cup", "lid")
    layout = ObservationLayout(*ARM_FIELDS)


for _each in (Two, Stranger, Plain):
    _each.__abstractmethods__ = frozenset()


def made(task=Two):
    return task(Brief(), CellConfig(equipment=Equipment(grippers=True)), Timing(0.04, 0.04), N)


def random_poses(*shape):
    quat = RNG.standard_normal((*shape, 4))
    return Poses(RNG.uniform(-0.3, 0.3, (*shape, 3)), quat / np.linalg.norm(quat, axis=-1, keepdims=True))


def state_of(task, objects, tools, width_m):
    """Return a state in which the tools are at poses, (n, 2, ...), in the cell frame."""
    back = pose((0.0, 0.0, -task.cell.equipment.tools[0].tcp_m))
    flange = compose(tools, Poses(*(np.broadcast_to(part, (N, 2, part.size)) for part in back)))
    zeros = np.zeros((N, 2, 6))
    frames = Frames((task.cell.left, task.cell.right))
    base = Poses(frames.position_to_base(flange.position_m), frames.quat_to_base(flange.quat))
    failed = np.zeros(N, dtype=bool)
    wrench = RNG.uniform(-5.0, 5.0, (N, 2, 6))
    values = np.zeros(N), zeros, zeros, *base, flange.position_m, failed, flange.quat, width_m, wrench, objects
    return CellState(*values)


def test_observed_props_are_fields_unless_the_class_states_a_layout():
    assert Two.layout.names[len(ARM_FIELDS) :] == (
        *("gripper_m", "force_n", "torque_nm", "mark_base_m", "mark_base_quat"),
        *("cup_base_m", "cup_base_quat", "lid_base_m", "lid_base_quat"),
        *(field.name for field in GOAL_FIELDS),
    )
    assert Plain.layout.names == tuple(field.name for field in ARM_FIELDS)


def test_each_arm_holds_its_own_prop_and_sees_all():
    task, objects = made(), {name: random_poses(N) for name in Two.observed}
    at = [compose(objects[grip.prop], Poses(*(part[None] for part in grip.tool))) for grip in Two.grips]
    tools = Poses(*(np.stack(parts, axis=1) for parts in zip(*at, strict=True)))
    width_m = np.array([[0.04, 0.02], [0.04, 0.06]])  # the right gripper of the second cell is open
    state = state_of(task, objects, tools, width_m)
    measured = task.measure(state)
    assert measured.holding.tolist() == [[True, True], [True, False]]
    np.testing.assert_allclose(measured.grip_in_tool_m, 0.0, atol=1e-12)
    fields = task.layout.split(task.observe(state, measured, np.ones((N, 2, 6))))
    np.testing.assert_array_equal(fields["gripper_m"][..., 0], width_m)
    np.testing.assert_array_equal(fields["torque_nm"], state.wrench[..., 3:])
    flange = Poses(fields["flange_base_m"], fields["flange_base_quat"])
    for name in Two.observed:  # as seen from each flange, which no choice of base changes
        seen = relative_to(flange, Poses(fields[f"{name}_base_m"], fields[f"{name}_base_quat"]))
        there = Poses(*(np.repeat(part[:, None], 2, axis=1) for part in objects[name]))
        expected = relative_to(Poses(state.flange_m, state.flange_quat), there)
        np.testing.assert_allclose(seen.position_m, expected.position_m, atol=1e-9)


def test_observations_lead_each_tool_to_its_grip():
    task, objects = made(), {name: random_poses(N) for name in Two.observed}
    tools = random_poses(N, 2)
    state = state_of(task, objects, tools, np.full((N, 2), 0.08))
    commanded_q_rad = np.tile(home_q_rad((task.cell.left, task.cell.right)), (N, 1, 1))
    measured = task.measure(state)
    fields = task.layout.split(task.observe(state, measured, commanded_q_rad))
    frames = Frames((task.cell.left, task.cell.right))
    for arm, (grip, mount) in enumerate(zip(Two.grips, (task.cell.left, task.cell.right), strict=True)):
        at_m, quat = flange_pose_quat(commanded_q_rad[:, arm], mount.dh)
        both = Poses(np.repeat(at_m[:, None], 2, axis=1), np.repeat(quat[:, None], 2, axis=1))
        flange = Poses(frames.position_to_cell(both.position_m)[:, arm], frames.quat_to_cell(both.quat)[:, arm])
        commanded = compose(flange, pose((0.0, 0.0, task.cell.equipment.tools[arm].tcp_m)))
        goal = compose(objects[grip.prop], grip.tool)
        behind = relative_to(goal, Poses(commanded.position_m + fields["goal_step_m"][:, arm], goal.quat)).position_m
        # The step leads to the grip, or to a point at most an approach behind it.
        np.testing.assert_allclose(behind[:, :2], 0.0, atol=1e-9)
        assert ((behind[:, 2] <= 1e-9) & (behind[:, 2] >= -APPROACH_M - 1e-9)).all()
    assert fields["goal_opening"].all()  # far from its grip a gripper opens


class Leaving(Two):
    """Both arms open after their grips."""

    def lead(self, state, measured):
        return Lead(measured.tools, np.zeros((N, 2), dtype=bool))


@pytest.mark.parametrize("wider_m", [0.0, 0.003, 0.03])
def test_fingers_touch_and_leave_an_object_by_small_steps(wider_m):
    task = made(Leaving)
    cell = task.cell
    q_rad = np.tile(home_q_rad((cell.left, cell.right)), (N, 1, 1))
    found = [flange_pose_quat(q_rad[:, arm], mount.dh) for arm, mount in enumerate((cell.left, cell.right))]
    base = (np.stack(each, axis=1) for each in zip(*found, strict=True))
    frames, (at_m, quat) = Frames((cell.left, cell.right)), base
    flange = Poses(frames.position_to_cell(at_m), frames.quat_to_cell(quat))
    tools = compose(flange, pose((0.0, 0.0, cell.equipment.tools[0].tcp_m)))
    none = Poses(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
    objects = {"mark": random_poses(N)}
    for arm, grip in enumerate(Two.grips):  # where the commanded tool is at the grip
        objects[grip.prop] = compose(Poses(*(part[:, arm] for part in tools)), relative_to(grip.tool, none))
    width_m = np.tile([0.04, 0.02], (N, 1)) + wider_m
    state = state_of(task, objects, tools, width_m)
    measured = task.measure(state)
    assert measured.between.all()
    opened = width_m / 0.085

    def goal():
        return task.layout.split(task.observe(state, measured, q_rad))["goal_opening"][..., 0]

    assert measured.holding.all() == (wider_m == 0.0)
    np.testing.assert_allclose(goal(), 0.0 if measured.holding.all() else opened - SLOW)
    task.passed[:] = 1
    np.testing.assert_allclose(goal(), 1.0 if wider_m > 0.007 else opened + SLOW)


class Hinged(Two):
    """The left arm grips the lid of a case, the right one the case."""

    settings_type = Brief
    observed = ("case",)
    further = (Field("lid_rad", 1, -4.0, 4.0, "angle (rad)", "angle of the lid", concise=(0.5,)),)
    grips = (
        Grip("case", pose((-0.1, 0.0, 0.0)), 0.01, body="lid"),
        Grip("case", pose((0.0, 0.1, 0.0)), 0.02),
    )

    @classmethod
    def requirements(cls, settings):
        return SceneRequirements(Equipment(grippers=True, props=(CASE,)))

    def start(self, rows, rngs):
        case = np.tile([0.1, 0.3, 0.02, 0.8, 0.0, 0.0, 0.6], (len(rows), 1))
        return self.start_at_home(rows, {"case": case})._replace(joints={"lid": np.full(len(rows), 0.5)})

    def further_values(self, state, measured):
        return {"lid_rad": np.repeat(state.joints["lid"][:, None, None], 2, axis=1)}


def test_a_moving_part_of_a_prop_is_gripped(registries):
    register("Lab/Hinged-v0")(Hinged)
    core = Core("Lab/Hinged-v0", {"observation": "goals"}, n=N)
    core.reset([np.random.default_rng(row) for row in range(N)])
    core.step(np.zeros((N, 14)))
    _, data = core.cell_data(1)
    lid, measured = data.body("case/lid"), core.task.measure(core._state)
    np.testing.assert_allclose(measured.frames[1, 1], [*lid.xpos, *lid.xmat.ravel()], atol=1e-9)
    assert core.observation_space.contains(core.agents.joint.reshape(-1)[: core.observation_space.shape[0]])
    assert "lid_rad" in core.task.concise_view().layout.names


def test_a_start_at_home_has_open_grippers_and_forgets_the_stages():
    task = made()
    task.passed[:] = 3
    start = task.start_at_home(np.array([1]), {"cup": np.zeros((1, 7))})
    assert task.passed.tolist() == [3, 0]
    assert start.q_rad.tolist() == [home_q_rad((task.cell.left, task.cell.right)).tolist()]
    assert start.gripper_m.tolist() == [[each.stroke_m for each in task.cell.equipment.tools]]
    assert set(start.objects) == {"cup"}
    assert task.horizon == 50


def test_a_grip_of_a_prop_that_is_not_observed_is_refused():
    with pytest.raises(SettingsError, match="Stranger grips lid, but observes mark, cup"):
        made(Stranger)


def test_tools_bring_what_they_hold_to_poses_without_another_grip():
    task, objects = made(), {name: random_poses(N) for name in Two.observed}
    tools, wanted = random_poses(N, 2), random_poses(N, 2)
    led = task.bringing(task.measure(state_of(task, objects, tools, np.full((N, 2), 0.04))), wanted)
    held = Poses(*(np.stack([objects[grip.prop][part] for grip in Two.grips], axis=1) for part in (0, 1)))
    np.testing.assert_allclose(led, frame_of(compose(wanted, relative_to(held, tools))), atol=1e-12)
