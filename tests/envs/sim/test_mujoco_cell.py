import copy
import pickle

import mujoco
import numpy as np
import pytest

from dual_ur10.assets.collision_model import build_collision_model
from dual_ur10.assets.settings import HOME_Q_RAD, Equipment, SceneSettings
from dual_ur10.envs.core.setup import EnvSetup
from dual_ur10.envs.sim.feedforward import FeedForward
from dual_ur10.envs.sim.mujoco_cell import MujocoCell
from dual_ur10.envs.sim.servo_reference import ReferenceMotion, ServojReference, TargetDelay
from dual_ur10.errors import ClosedError, SettingsError, UnknownNameError
from dual_ur10.sim2real.cell.cell import Start
from dual_ur10.sim2real.cell.cell_config import CellConfig
from dual_ur10.sim2real.cell.perturbation import Perturbation
from dual_ur10.sim2real.control.adapter import Command
from ur_core.kinematics import flange_pose
from ur_core.kinematics.dynamics import inverse_dynamics
from ur_core.kinematics.frames import ArmMount
from ur_core.kinematics.ur10 import ARMS, LINK_MASS_KG, LINKS, NOMINAL_DH
from ur_core.mjcf.gains import COMPLIANT, INTEGRATORS
from ur_core.servoj import ServojLaw, ServojProfile

TICKS = 5
LOOKAHEAD_S, GAIN, STEP_S = 0.03, 2000.0, 0.002


def home(n=1):
    return np.tile(HOME_Q_RAD, (n, 1, 1))


def wave(period, n=1, size=0.05):
    """Return the targets of one policy period of a slow wave of all joints, (n, ticks, 2, 6)."""
    time = (period * TICKS + np.arange(1, TICKS + 1)) * 0.008
    offset = size * (1 - np.cos(2 * np.pi * 0.5 * time))
    signs = np.array([[1, -1, 1, 1, -1, 1], [-1, 1, -1, 1, 1, 1]])
    return np.broadcast_to(HOME_Q_RAD + offset[:, None, None] * signs, (n, TICKS, 2, 6)).copy()


def run(perturbation=None, periods=50, n=1, **keywords):
    config = CellConfig(perturbation=perturbation or Perturbation(), **keywords)
    cell = MujocoCell(config, TICKS, n=n)
    cell.reset(Start(home(n)))
    trace = [cell.advance(Command(wave(k, n))).state.q_rad.copy() for k in range(periods)]
    return np.array(trace), cell


def law_by_scalar_loop(targets, lookahead_s=LOOKAHEAD_S, delay_steps=0):
    """Integrate the servoj law of one joint by the closed solution of each physics step."""
    transition = ServojLaw(lookahead_s, GAIN).transition(STEP_S)
    held = np.repeat(targets, 4)
    held = np.concatenate([np.full(delay_steps, targets[0]), held])[: len(held)]
    state, trace = np.array([targets[0], 0.0]), []
    for target in held:
        state = transition @ (state - [target, 0.0]) + [target, 0.0]
        trace.append(state[0])
    return np.array(trace)


def test_the_arms_follow_the_law():
    trace, _ = run()
    targets = np.concatenate([wave(k)[0] for k in range(50)])
    for arm in (0, 1):
        for joint in range(6):
            column = np.concatenate([[HOME_Q_RAD[arm, joint]], targets[:, arm, joint]])
            expected = law_by_scalar_loop(column)[4:]
            assert np.abs(trace[:, 0, arm, joint] - expected[TICKS * 4 - 1 :: TICKS * 4]).max() < 5e-6


SOFT = {"gains": COMPLIANT, "timestep_s": 0.001}


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_feed_forward_fits_the_integrator(integrator):
    """Compliant servos follow an exact model; with the other integrator's feed-forward they are 5 µrad off."""
    cell = MujocoCell(CellConfig(integrator=integrator, **SOFT), TICKS)
    cell.reset(Start(home()))
    reference = ServojReference(cell.config.servoj, 1, cell.config.substeps, TICKS)
    reference.reset(home(), np.arange(1))
    for k in range(50):
        motion = reference(wave(k))
        before, speed = motion.q_rad, motion.qd_rad_s
        q_rad = cell.advance(Command(wave(k))).state.q_rad
        assert np.abs(q_rad.reshape(12) - before[0, -1] - speed[0, -1] * 0.001).max() < 1e-6


def test_euler_is_the_choice_where_it_is_stable():
    def chosen(**keywords):
        return CellConfig(**keywords).scene.integrator

    assert chosen() == chosen(timestep_s=0.001) == chosen(gains=COMPLIANT) == "implicitfast"
    assert chosen(**SOFT) == "Euler"
    assert chosen(**SOFT, integrator="implicitfast") == "implicitfast"
    light = Perturbation(mass_scale=((0.9, 0.8),))
    assert chosen(**SOFT, perturbation=light) == "implicitfast"
    with pytest.raises(SettingsError, match=r"masses times 0.8: .* up to 2.47, allowed are 2.2, .* from 4 on"):
        CellConfig(**SOFT, integrator="Euler", perturbation=light)
    carry = EnvSetup.resolve("SyncCarry", {"cell": CellConfig(integrator="Euler")})
    assert carry.config.scene.integrator == "Euler"
    for task, gains in (("SineTracking", "stiff"), ("Handover", "stiff"), ("SyncCarry", "compliant")):
        keywords = {"cell": CellConfig(integrator="Euler"), **({"grasp": "rigid"} if task == "SyncCarry" else {})}
        with pytest.raises(SettingsError, match=rf"gains='{gains}', timestep_s=0.002 .* allowed are 2.2"):
            EnvSetup.resolve(task, keywords)
    with pytest.raises(UnknownNameError, match="'implicitfast', 'Euler'"):
        CellConfig(integrator="RK4")


@pytest.mark.parametrize("slow", [0.25, 0.5, 0.8])
@pytest.mark.parametrize("latency_s", [0.0, 0.016])
def test_time_scaling_makes_the_law_quicker(slow, latency_s):
    """As on two controllers: a curve through the targets is sampled every control period, which is a part of a tick."""
    periods, fine = 50, 800
    perturbation = Perturbation(latency_s=np.full((1, 2), latency_s))
    trace, cell = run(perturbation, periods, speed_factor=slow)
    ticks = np.arange(periods * TICKS + 1)
    late_s = round(latency_s * slow / STEP_S) * STEP_S
    times = np.arange(fine * periods) / fine * TICKS  # in ticks of the task
    transition = ServojLaw(LOOKAHEAD_S * slow, GAIN / slow**2).transition(TICKS * 0.008 / fine)
    targets = np.concatenate([home(), np.concatenate([wave(k)[0] for k in range(periods)])])
    for arm, joint in ((0, 0), (1, 3)):
        # Target k acts from tick k on, and what is held for a control period is late by half of it.
        held = np.interp(times - slow / 2 - late_s / 0.008 + 1.0, ticks, targets[:, arm, joint])
        state, end = np.array([targets[0, arm, joint], 0.0]), []
        for target in held:
            state = transition @ (state - [target, 0.0]) + [target, 0.0]
            end.append(state[0])
        assert np.abs(trace[5:, 0, arm, joint] - np.array(end)[fine - 1 :: fine][5:]).max() < 6e-5
    state = cell.reset(Start(home())).state
    for _ in range(3):  # nothing of before is left
        state = cell.advance(Command(np.tile(HOME_Q_RAD, (1, TICKS, 1, 1)))).state
    assert np.abs(state.q_rad - home()).max() < 1e-9


def test_a_wrong_lookahead_and_a_latency_enter_the_law():
    trace, _ = run(Perturbation(lookahead_scale=np.array([[1.05, 1.2]]), latency_s=np.array([[0.004, 0.006]])))
    targets = np.concatenate([wave(k)[0] for k in range(50)])
    for arm, (scale, delay) in enumerate(((1.05, 2), (1.2, 3))):
        column = np.concatenate([[HOME_Q_RAD[arm, 2]], targets[:, arm, 2]])
        expected = law_by_scalar_loop(column, LOOKAHEAD_S * scale, delay)[4:]
        assert np.abs(trace[:, 0, arm, 2] - expected[TICKS * 4 - 1 :: TICKS * 4]).max() < 1e-5


def test_the_state_is_of_this_instant():
    _, cell = run(periods=20)
    state = cell.advance(Command(wave(20))).state
    position, _ = flange_pose(state.q_rad, NOMINAL_DH)
    assert np.abs(state.qd_rad_s).max() > 0.05
    assert np.abs(state.flange_base_m - position).max() < 1e-9
    assert state.time_s.tolist() == [21 * TICKS * 0.008]


def droop(**perturbation):
    cell = MujocoCell(CellConfig(perturbation=Perturbation(**perturbation)), TICKS)
    cell.reset(Start(home()))
    for _ in range(40):
        state = cell.advance(Command(np.repeat(home()[:, None], TICKS, axis=1))).state
    return state.q_rad[0] - HOME_Q_RAD


def test_unmodelled_masses_make_the_arms_droop():
    # 5 % of the gravity torque over the servo's stiffness: gravity compensation uses the nominal arm.
    gravity = inverse_dynamics(HOME_Q_RAD, np.zeros((2, 6)), np.zeros((2, 6)), robot="ur10")
    stiffness = np.array([20000, 20000, 10000, 3000, 3000, 3000])
    assert np.allclose(droop(mass_scale=1.05), -0.05 * gravity / stiffness, atol=2e-7)
    assert np.abs(droop()).max() < 1e-9


def test_payload_droops_unless_declared():
    gravity = [inverse_dynamics(HOME_Q_RAD, *np.zeros((2, 2, 6)), payload_kg=mass, robot="ur10") for mass in (0.0, 3.0)]
    stiffness = np.array([20000, 20000, 10000, 3000, 3000, 3000])
    assert np.allclose(droop(payload_kg=3.0), -(gravity[1] - gravity[0]) / stiffness, atol=2e-5)
    assert np.abs(droop(payload_kg=3.0, declared_payload_kg=3.0)).max() < 1e-7


def test_a_declared_payload_is_in_the_feed_forward():
    known, _ = run(Perturbation(payload_kg=5.0, declared_payload_kg=5.0))
    nominal, _ = run()
    unknown, _ = run(Perturbation(payload_kg=5.0))
    assert np.abs(known - nominal).max() < 2e-6
    assert np.abs(unknown - nominal).max() > 1e-4


def test_payload_masses_and_inertia_are_those_of_a_welded_ball():
    cell = MujocoCell(CellConfig(perturbation=Perturbation(payload_kg=4.0, mass_scale=1.1)), TICKS)
    batch, model = cell._physics._batch, cell._physics._batch.model
    bodies = [model.body(f"left/{link}").id for link in LINKS]
    expected = LINK_MASS_KG * 1.1
    expected[-1] += 4.0
    assert np.allclose(batch.expand("body_mass")[0, bodies], expected)
    # Inertia about the flange axis does not change, across it it grows by the reduced mass times the distance squared.
    inertia = np.sort(batch.expand("body_inertia")[0, bodies[-1]])
    distance = 0.026  # flange to the centre of mass of the last link
    reduced = 0.365 * 1.1 * 4.0 / (0.365 * 1.1 + 4.0)
    assert np.allclose(inertia, np.sort(np.array([0.00034, 0.0004, 0.00041]) * 1.1 + [0, *[reduced * distance**2] * 2]))


def test_friction_delays_by_its_size():
    friction = np.array([5.0, 5.0, 3.0, 1.0, 1.0, 1.0])
    with_friction, _ = run(Perturbation(friction_nm=friction))
    without, _ = run()
    stiffness = np.array([20000, 20000, 10000, 3000, 3000, 3000])
    middle = slice(6, 20)  # all joints move one way
    lag = np.abs(with_friction - without)[middle].mean(axis=0)[0]
    assert np.allclose(lag, friction / stiffness, rtol=0.15)


def test_perturbations_are_per_cell():
    both, _ = run(Perturbation(mass_scale=np.array([[1.0, 1.0], [1.05, 1.0]])), n=2)
    nominal, _ = run()
    assert np.array_equal(both[:, 0], nominal[:, 0])
    assert np.abs(both[:, 1, 0] - nominal[:, 0, 0]).max() > 1e-5
    assert np.abs(both[:, 1, 1] - nominal[:, 0, 1]).max() < 1e-12


def test_perturbing_back_to_nominal_restores_it():
    nominal, _ = run()
    _, cell = run(
        Perturbation(
            mass_scale=1.2,
            friction_nm=3.0,
            latency_s=0.01,
            lookahead_scale=1.1,
            payload_kg=2.0,
            declared_payload_kg=1.5,
        )
    )
    cell.reset(Start(home()), perturbation=Perturbation().expanded(1))
    trace = np.array([cell.advance(Command(wave(k))).state.q_rad.copy() for k in range(50)])
    assert np.abs(trace - nominal).max() < 1e-12


def test_latency_of_one_arm():
    trace, _ = run(Perturbation(latency_s=np.array([[0.0, 0.02]])))
    nominal, _ = run()
    assert np.abs(trace[:, 0, 0] - nominal[:, 0, 0]).max() < 1e-12
    assert np.abs(trace[:, 0, 1] - nominal[:, 0, 1]).max() > 1e-3


def test_jitter_and_loss_repeat_with_the_seed_and_only_delay():
    wild = Perturbation(jitter_s=0.012, loss=0.2)

    def once(seed):
        cell = MujocoCell(CellConfig(perturbation=wild), TICKS)
        cell.reset(Start(home()), seeds=[seed])
        return np.array([cell.advance(Command(wave(k))).state.q_rad.copy() for k in range(30)])

    first, again, other = once(1), once(1), once(2)
    assert np.array_equal(first, again)
    assert np.abs(first - other).max() > 1e-6
    nominal, _ = run(periods=30)
    rising = slice(4, 24)
    assert (np.abs(first[rising] - HOME_Q_RAD) <= np.abs(nominal[rising] - HOME_Q_RAD) + 1e-9).all()


def test_delay_against_a_plain_queue():
    rng = np.random.default_rng(0)
    substeps, ticks, n = 4, 3, 2
    delay = TargetDelay(n, substeps)
    delay.latency[:], delay.jitter[:], delay.loss[:] = 5, 6, 0.3
    delay.reset(np.zeros((n, 2, 6)), np.arange(n), [3, 4])
    draws = [np.random.default_rng(seed) for seed in (3, 4)]
    sent = rng.normal(size=(n, 30, ticks, 2, 6))
    held = [[(-1, np.zeros(6))] * 2 for _ in range(n)]
    queue = [[[], []] for _ in range(n)]
    number = 0
    for period in range(30):
        got = delay(sent[:, period])
        for row in range(n):
            extra = draws[row].integers(0, 7, (ticks, 2))
            lost = draws[row].random((ticks, 2)) < 0.3
            for tick in range(ticks):
                for arm in (0, 1):
                    if not lost[tick, arm]:
                        when = (period * ticks + tick) * substeps + 5 + extra[tick, arm]
                        queue[row][arm].append((when, period * ticks + tick, sent[row, period, tick, arm]))
        for step in range(ticks * substeps):
            for row in range(n):
                for arm in (0, 1):
                    for when, order, value in queue[row][arm]:
                        if when <= number and order > held[row][arm][0]:
                            held[row][arm] = (order, value)
                    assert np.array_equal(got[row, step, arm], held[row][arm][1])
            number += 1


@pytest.mark.parametrize("through", [copy.deepcopy, lambda each: pickle.loads(pickle.dumps(each))])
def test_a_copied_reference_shows_its_own_motion(through):
    reference = ServojReference(ServojProfile(), 2, 4, TICKS)
    reference.reset(np.repeat(home(), 2, axis=0), np.arange(2))
    reference(np.repeat(wave(0), 2, axis=0))
    copied = through(reference)
    shown = copied.motion  # as a cell keeps it
    for period in (1, 2):
        expected = reference(np.repeat(wave(period), 2, axis=0))
        assert copied(np.repeat(wave(period), 2, axis=0)) is shown
        for name in ("rows", "q_rad", "qd_rad_s", "qdd_rad_s2"):
            np.testing.assert_array_equal(getattr(shown, name), getattr(expected, name))
            assert np.shares_memory(getattr(shown, name), shown.rows)
            assert not np.shares_memory(getattr(shown, name), expected.rows)


def test_reference_moves_as_the_integrator_does():
    reference = ServojReference(ServojProfile(), 1, 4, TICKS)
    reference.reset(home(), np.arange(1))
    previous = None
    for period in range(5):
        motion = reference(wave(period))
        q, v, a = motion.q_rad.copy(), motion.qd_rad_s.copy(), motion.qdd_rad_s2
        joined = q[0] if previous is None else np.vstack([previous[0], q[0]])
        assert np.allclose(np.diff(joined, axis=0)[-19:], v[0, :-1][-19:] * 0.002, atol=1e-13)
        if previous is not None:
            assert np.allclose((v[0, 0] - previous[1]) / 0.002, a[0, 0], atol=1e-6)
        previous = q[0, -1:], v[0, -1]


@pytest.mark.parametrize("declared_kg", [0.0, 2.5])
@pytest.mark.parametrize("grippers", [False, True])
def test_feed_forward_is_mujocos_inverse_dynamics(declared_kg, grippers):
    """The servos' torques at the configuration in the middle, by the engine itself on a model of its own."""
    scene = SceneSettings(ArmMount((-0.6, 0.7, 0.1), 0.4), equipment=Equipment(grippers=grippers))
    forward, rng, steps, carried_kg = FeedForward(scene, 1, 5, 1), np.random.default_rng(0), 5, np.array([0.7, 0.2])
    forward.declare_payload(np.full((1, 2), declared_kg))
    kp, kv = (np.tile(each, 2) for each in (scene.gains.kp_nm_rad, scene.gains.kv_nms_rad))
    model = build_collision_model(scene)
    data = mujoco.MjData(model)
    for _ in range(20):
        motion = ReferenceMotion(np.zeros((1, 3 * steps + 3, 12)))
        for rows in (motion.q_rad, motion.qd_rad_s, motion.qdd_rad_s2):
            rows[:] = rng.normal(size=rows.shape)
        control = forward(motion, carried_kg, carried_kg)[..., :6].reshape(steps, 12)
        data.qpos[:], data.qvel[:] = motion.q_rad[0, 2], motion.qd_rad_s[0, 2]
        mujoco.mj_forward(model, data)
        inertia, gravity = np.zeros((12, 12)), np.zeros(12)
        mujoco.mj_fullM(model, data, inertia)
        bias = data.qfrc_bias.copy()
        for arm, name in enumerate(ARMS):
            for site, mass, weight in (("flange", declared_kg, 0.0), ("tcp", carried_kg[arm] * grippers, 9.81)):
                if not mass:
                    continue
                jac, rates = np.zeros((2, 3, 12))
                mujoco.mj_jacSite(model, data, jac, None, model.site(f"{name}/{site}").id)
                mujoco.mj_jacDot(
                    model, data, rates, None, data.site(f"{name}/{site}").xpos, model.body(f"{name}/wrist_3_link").id
                )
                inertia += mass * jac.T @ jac
                gravity += mass * weight * jac[2]
                if site == "flange":  # what is carried moves too slowly for its velocity terms
                    bias += mass * jac.T @ rates @ data.qvel
        for step in range(steps):
            torque = inertia @ motion.qdd_rad_s2[0, step] + bias + gravity
            expected = motion.q_rad[0, step] + (kv * motion.qd_rad_s[0, step] + torque) / kp
            assert np.abs(control[step] - expected).max() < 1e-12


def test_bases_stand_at_their_mounts():
    config = CellConfig(left=ArmMount((-0.6, 0.7, 0.1), 0.4))
    cell = MujocoCell(config, TICKS)
    state = cell.reset(Start(home())).state
    position, _ = flange_pose(HOME_Q_RAD[0], NOMINAL_DH)
    turn = np.array([[np.cos(0.4), -np.sin(0.4), 0], [np.sin(0.4), np.cos(0.4), 0], [0, 0, 1]]) @ np.diag([-1, -1, 1])
    assert np.allclose(state.flange_m[0, 0], turn @ position + (-0.6, 0.7, 0.1), atol=1e-9)


def test_closed_cells_and_bad_perturbations():
    _, cell = run(periods=1)
    cell.close()
    cell.close()
    with pytest.raises(ClosedError, match="new one"):
        cell.advance(Command(wave(0)))
    with pytest.raises(SettingsError, match="shape"):
        run(Perturbation(mass_scale=np.ones(3)), periods=1)
