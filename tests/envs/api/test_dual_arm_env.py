import hashlib
import pickle
import re
import subprocess
import sys
import warnings

import gymnasium as gym
import numpy as np
import psutil
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import FrameStackObservation, RecordVideo, RescaleAction, TimeAwareObservation, TimeLimit

import dual_ur10
from dual_ur10 import errors, policies
from dual_ur10.envs import dm_env, parallel_env
from dual_ur10.envs.core.setup import load_task
from dual_ur10.sim2real.cell.cell_config import CellConfig
from dual_ur10.sim2real.cell.perturbation import Perturbation
from tests import rollout_hashes
from tests.soak import scaled
from ur_core.kinematics import flange_pose
from ur_core.kinematics.frames import ArmMount
from ur_core.kinematics.ur10 import ARMS, JOINTS, NOMINAL_DH
from ur_core.tools.robotiq_2f85 import ROBOTIQ_2F85 as TOOL

IDS = dual_ur10.ENV_IDS
SINE = "DualUR10/SineTracking-v0"


def actions(env, steps, seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform(-1, 1, (steps, *env.action_space.shape)).astype(np.float32)


def rollout(env, steps, seed=3):
    """Everything that an episode's steps return, as one array per step; begins a new episode where one ends."""
    observation, _ = env.reset(seed=seed)
    trace = [observation]
    for action in actions(env, steps):
        observation, reward, terminated, truncated, info = env.step(action)
        trace.append(np.concatenate([observation, [reward, terminated, truncated], info["q_rad"].ravel()]))
        if terminated or truncated:
            observation, _ = env.reset()
            trace.append(observation)
    return trace


def same(left, right):
    return len(left) == len(right) and all(np.array_equal(a, b) for a, b in zip(left, right, strict=True))


@pytest.mark.parametrize("env_id", IDS)
def test_gymnasium_checks_it_without_a_warning(env_id):
    env = gym.make(env_id)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # The check draws for a person, too: MuJoCo's web viewer leaves its sockets to the garbage collector.
        warnings.simplefilter("ignore", ResourceWarning)
        check_env(env.unwrapped, skip_render_check=env_id != SINE)
    env.close()


@pytest.mark.parametrize("env_id", IDS)
def test_stable_baselines_checks_it_without_a_warning(env_id):
    checker = pytest.importorskip("stable_baselines3.common.env_checker", reason="needs the extra train")
    env = gym.make(env_id)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        checker.check_env(env.unwrapped, warn=True)
    env.close()


def test_importing_the_package_loads_nothing_heavy():
    code = (
        "import sys, dual_ur10; heavy = {'mujoco', 'torch', 'rtde_control', 'rtde_receive', 'matplotlib', 'dm_control',"
        " 'pinocchio'} & set(sys.modules); sys.exit(str(heavy) if heavy else 0)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


def test_make_by_module_prefix_needs_no_import_and_prints_nothing():
    code = "import gymnasium; gymnasium.make('dual_ur10:DualUR10/SineTracking-v0').reset(seed=0)"
    result = subprocess.run([sys.executable, "-c", code], check=True, timeout=120, capture_output=True, text=True)
    assert result.stdout == ""
    assert result.stderr == ""


def test_a_simulation_loads_no_opengl_and_no_code_of_real_arms():
    code = (
        "import sys, gymnasium, dual_ur10; e = gymnasium.make('DualUR10/Handover-v0'); e.reset(seed=0); "
        "e.step(e.action_space.sample()); print(*sys.modules)"
    )
    result = subprocess.run([sys.executable, "-c", code], check=True, timeout=120, capture_output=True, text=True)
    loaded = set(result.stdout.split())
    assert not {"mujoco.egl", "mujoco.osmesa", "OpenGL.GL", "pydantic"} & loaded
    own = [name for name in loaded if name.split(".")[0] in ("dual_ur10", "ur_core", "ur_emulator")]
    assert len(own) <= 105
    rooms = {name.split(".")[2] for name in own if name.startswith("dual_ur10.sim2real.")}
    assert rooms == {"cell", "control"}
    assert not {"ur_core.links", "ur_core.protocol", "ur_emulator"} & loaded


@pytest.mark.parametrize("env_id", IDS)
def test_same_seed_is_bit_equal_after_other_episodes(env_id):
    fresh, used = gym.make(env_id), gym.make(env_id)
    for seed in range(3):
        rollout(used, 40, seed=seed)
    assert same(rollout(fresh, scaled(2000)), rollout(used, scaled(2000)))


def test_same_seed_is_bit_equal_in_another_process():
    code = (
        "import hashlib, gymnasium, numpy as np, dual_ur10\n"
        "from tests.envs.api.test_dual_arm_env import rollout\n"
        f"trace = rollout(gymnasium.make({SINE!r}), {scaled(2000)})\n"
        "print(hashlib.sha256(b''.join(np.ascontiguousarray(x).tobytes() for x in trace)).hexdigest())"
    )
    other = subprocess.run([sys.executable, "-c", code], check=True, timeout=600, capture_output=True, text=True)
    trace = rollout(gym.make(SINE), scaled(2000))
    here = hashlib.sha256(b"".join(np.ascontiguousarray(x).tobytes() for x in trace)).hexdigest()
    assert other.stdout.strip() == here


def test_different_seeds_start_differently_and_no_observation_is_constant():
    env = gym.make(SINE)
    starts = np.array([env.reset(seed=seed)[0] for seed in range(8)])
    assert np.ptp(starts[:, 18:21], axis=0).min() > 0.01  # flange positions
    trace = np.array([x[:80] for seed in range(3) for x in rollout(env, 20, seed=seed)])
    assert np.ptp(trace, axis=0).min() > 0


def test_observations_share_no_memory_and_are_not_changed_later():
    env = gym.make(SINE)
    first, info = env.reset(seed=0)
    kept, kept_q = first.copy(), info["q_rad"].copy()
    second, *_ = env.step(np.full(12, 0.5, dtype=np.float32))
    env.step(np.full(12, 0.5, dtype=np.float32))
    assert np.array_equal(first, kept)
    assert np.array_equal(info["q_rad"], kept_q)
    assert not np.shares_memory(first, second)


@pytest.mark.parametrize("env_id", IDS)
def test_rollout_hash(env_id):
    rollout_hashes.check(env_id, lambda: rollout_hashes.digest(*rollout(gym.make(env_id), 50, seed=11)))


@pytest.mark.parametrize("when", ["before", "during", "after"])
def test_pickling(when):
    env = gym.make(SINE, cell=CellConfig(perturbation=Perturbation(mass_scale=1.02, latency_s=0.004)))
    policy_actions = actions(env, 30)
    if when != "before":
        env.reset(seed=4)
        for action in policy_actions[:10]:
            env.step(action)
    if when == "after":
        env.reset()
    copy = pickle.loads(pickle.dumps(env))
    if when == "before":
        first, second = env.reset(seed=4), copy.reset(seed=4)
        assert np.array_equal(first[0], second[0])
    for action in policy_actions[10:]:
        ours, theirs = env.step(action), copy.step(action)
        assert np.array_equal(ours[0], theirs[0])
        assert ours[1:4] == theirs[1:4]
    assert np.array_equal(env.reset()[0], copy.reset()[0])  # the generator went along


def test_many_episodes_and_environments_leave_nothing_behind():
    process = psutil.Process()

    def cycle(count):
        for k in range(count):
            env = gym.make(SINE)
            env.reset(seed=k)
            env.step(env.action_space.sample())
            env.close()
            env.close()

    cycle(20)
    memory, files, threads = process.memory_info().rss, process.num_fds(), process.num_threads()
    cycle(scaled(1000))
    assert process.memory_info().rss - memory < 20 * 2**20
    # Fewer is no leak: what an earlier test of this process left may end meanwhile.
    assert process.num_fds() <= files
    assert process.num_threads() <= threads


def test_wrappers_of_gymnasium():
    env = FrameStackObservation(RescaleAction(gym.make(SINE), np.float32(-0.5), np.float32(0.5)), 3)
    observation, _ = env.reset(seed=0)
    assert observation.shape == (3, 94)
    assert env.step(env.action_space.sample())[0].shape == (3, 94)


def test_record_video(tmp_path):
    env = RecordVideo(gym.make(SINE, render_mode="rgb_array", width=160, height=120), str(tmp_path / "video"))
    env.reset(seed=0)
    for _ in range(3):
        env.step(env.action_space.sample())
    env.close()
    assert [path.suffix for path in (tmp_path / "video").iterdir()] == [".mp4"]
    assert next((tmp_path / "video").iterdir()).stat().st_size > 500


def test_rendering_shows_the_arms_move():
    env = gym.make(SINE, render_mode="rgb_array", width=200, height=150)
    env.reset(seed=0)
    before = env.render()
    for _ in range(15):
        env.step(np.full(12, 0.3, dtype=np.float32))
    after = env.render()
    assert before.shape == after.shape == (150, 200, 3)
    assert np.std(before) > 10
    assert (np.abs(before.astype(int) - after).max(axis=2) > 20).mean() > 0.005


def table_rows(task, heading):
    section = re.split(r"\n *## ", task.__doc__.split(f"## {heading}")[1])[0]  # Python 3.13 removes the indentation
    return [
        [cell.strip() for cell in line.strip().strip("|").split("|")]
        for line in section.splitlines()
        if re.match(r"\s*\| \d", line)
    ]


@pytest.mark.parametrize("name", IDS)
def test_docstring_tables_match_the_spaces(name):
    env, task = gym.make(name).unwrapped, load_task(name)
    model, _ = env.core.cell_data(0)
    kinds = ((model.njnt, model.joint), (model.nsite, model.site), (model.nbody, model.body))
    names = {kind(i).name for count, kind in kinds for i in range(count)}
    rows = table_rows(task, "Action Space")
    driven = [*JOINTS, "gripper"] if env.action_space.shape == (14,) else JOINTS
    assert [int(row[0]) for row in rows] == list(range(len(driven)))
    assert [row[4] for row in rows] == [f"left/{name}" for name in driven]
    assert [float(row[2]) for row in rows] * 2 == env.action_space.low.tolist()
    assert [float(row[3]) for row in rows] * 2 == env.action_space.high.tolist()
    step = task.limits.speed_rad_s[0] * env.core.timing.period_s
    opening = "-1 is 0, 1 is 0.085 (m)"
    assert all(row[6] == (opening if "gripper" in row[4] else f"fraction of {step:.3f} (rad)") for row in rows)
    lines = task.__doc__.split("## Observation Space")[1].split("## Rewards")[0].splitlines()
    concise = env.task.concise_view().layout
    rows = [*task.layout.table(), *concise.table()]
    assert [line.strip() for line in lines if re.match(r"\s*\| \d", line)] == rows
    assert f"Box(-1.0, 1.0, ({2 * concise.size},), float32)" in "".join(lines)
    for field in task.layout.fields:
        for each in field.mujoco.format(arm="right", other="left").split(" ... "):
            assert each in names | {"-"}
    assert np.array_equal(env.observation_space.low, task.layout.low)
    assert np.array_equal(env.observation_space.high, task.layout.high)
    arguments = re.findall(r"\n *\| `(\w+)` \|", task.__doc__)
    assert arguments == list(task.settings_type.__dataclass_fields__)
    weights = {name: float(value) for name, value in re.findall(r"- \*(\w+)\* \(([\d.]+)\)", task.__doc__)}
    assert weights == task.weights


def test_observations_match_the_table():
    cell = CellConfig(left=ArmMount((-0.7, 0.6, 0.02), 0.3), right=ArmMount((-0.9, -0.5, 0.05), -0.2))
    env = gym.make(SINE, cell=cell, randomize=False)
    env.reset(seed=0)
    for action in actions(env, 7) * 0.3:
        observation, _, _, _, info = env.step(action)
    arms = env.unwrapped.task.layout.split(observation)
    assert np.array_equal(arms["q_rad"], info["q_rad"])
    position, rotation = flange_pose(arms["q_rad"], NOMINAL_DH)
    assert np.allclose(arms["flange_base_m"], position, atol=1e-9)
    for arm, mount in enumerate((cell.left, cell.right)):
        from_base = np.array(
            [
                [np.cos(mount.yaw_rad), -np.sin(mount.yaw_rad), 0],
                [np.sin(mount.yaw_rad), np.cos(mount.yaw_rad), 0],
                [0, 0, 1],
            ]
        ) @ np.diag([-1, -1, 1])
        assert np.allclose(from_base @ arms["flange_base_m"][arm] + mount.position_m, info["flange_m"][arm], atol=1e-9)
        assert np.allclose(
            from_base @ arms["reference_base_m"][arm] + mount.position_m, info["reference_m"][arm], atol=1e-9
        )
        # The observed rotation vector leads from the flange to the tool pointing straight down.
        w, x, y, z = arms["flange_base_quat"][arm]
        assert np.allclose(
            rotation[arm][2], [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], atol=1e-9
        )
        down = np.diag([1.0, -1.0, -1.0]) @ rotation[arm].T
        vector = np.array([down[2, 1] - down[1, 2], down[0, 2] - down[2, 0], down[1, 0] - down[0, 1]]) / 2
        assert np.allclose(arms["rotation"][arm], vector, atol=1e-3)


def test_reward_is_the_weighted_sum_of_its_terms():
    env = gym.make(SINE)
    env.reset(seed=0)
    task = load_task("SineTracking")
    for action in actions(env, 10) * 0.2:
        _, reward, _, _, info = env.step(action)
        assert reward == pytest.approx(sum(w * info[f"reward/{name}"] for name, w in task.weights.items()), abs=1e-12)
        assert 0 < reward < 1


def test_one_arm_alone_earns_neither_synchrony_nor_success():
    env, whole = (gym.make(SINE, duration_s=4.0, randomize=False) for _ in range(2))
    policy = policies.load("scripted", SINE)
    env.reset(seed=0)
    observation, _ = whole.reset(seed=0)
    over, synchrony = False, []
    while not over:
        action = policy(observation)
        observation, *_ = whole.step(action)
        _, _, terminated, over, info = env.step(np.r_[action[:6], np.zeros(6, action.dtype)])
        assert not terminated
        synchrony.append(info["reward/synchrony"])
    assert info["flange_error_m"][0] < 1e-5  # the arm that moves is where it should be
    assert not info["is_success"]
    assert min(synchrony) < 1e-4


def test_an_action_of_one_arm_moves_only_that_arm():
    env = gym.make(SINE, randomize=False)
    _, info = env.reset(seed=0)
    start = info["q_rad"]
    for _ in range(10):
        _, _, _, _, info = env.step(np.r_[np.full(6, 0.3), np.zeros(6)].astype(np.float32))
    moved = np.abs(info["q_rad"] - start).max(axis=1)
    assert moved[0] > 0.01
    assert moved[1] < 1e-6


def test_latency_holds_the_motion_back_by_whole_ticks():
    traces = {}
    for latency in (0, 3, 5, 8):
        env = gym.make(SINE, randomize=False, action_latency_ticks=latency, policy_rate_hz=125)
        env.reset(seed=0)
        rng = np.random.default_rng(1)
        traces[latency] = np.array([env.step(rng.uniform(-1, 1, 12) * 0.2)[4]["q_rad"] for _ in range(40)])
    for latency in (3, 5, 8):
        assert np.allclose(traces[latency][latency:], traces[0][:-latency], atol=2e-7)
        assert np.abs(traces[latency] - traces[0]).max() > 1e-4


def test_a_refused_motion_ends_the_episode_with_its_reason():
    env = gym.make(SINE, action_mode="joint_position", randomize=False, on_refusal="terminate", at_limits="refuse")
    _, info = env.reset(seed=0)
    down = info["q_rad"].copy()
    down[:, 1] += 1.2  # both arms into the table
    for _ in range(60):
        _, _, terminated, _, info = env.step(down.reshape(12).astype(np.float32))
        if terminated:
            break
    assert terminated
    assert info["safety"].kind == "distance"
    assert info["end_reason"] == "refused/distance"
    assert "table" in info["safety"].subject
    assert "allowed at least 0.02 m" in str(info["safety"])
    assert info["flange_m"][:, 2].min() > 0.02
    _, info = env.reset(seed=1)
    for _ in range(3):
        _, _, terminated, _, info = env.step(info["q_rad"].reshape(12).astype(np.float32))
        assert not terminated
        assert "safety" not in info


def test_diverged_physics_ends_the_episode_and_returns_no_nan():
    env = gym.make(SINE)
    env.reset(seed=0)
    observation, *_ = env.step(np.zeros(12, dtype=np.float32))
    env.unwrapped.core.cell._physics._arms_qd[0, 0, 3] = np.nan
    after, reward, terminated, _, info = env.step(np.zeros(12, dtype=np.float32))
    assert terminated
    assert "diverged" in info["physics_error"]
    assert info["end_reason"] == "physics"
    assert np.isfinite(reward)
    assert np.isfinite(after).all()
    assert np.allclose(after[:6], observation[:6])
    env.reset(seed=0)
    _, _, terminated, _, info = env.step(np.zeros(12, dtype=np.float32))
    assert not terminated
    assert "physics_error" not in info


@pytest.mark.parametrize("env_id", IDS)
def test_the_spec_has_the_horizon_at_which_the_task_ends_an_episode(env_id):
    assert gym.spec(env_id).max_episode_steps is None
    default = gym.make(env_id)
    horizons = {
        "Sine": 750,
        "Sync": 900,
        "Hand": 500,
        "Free": None,
        "PegI": 750,
        "Tray": 750,
        "BoxL": 875,
        "LidA": 1125,
    }
    assert default.spec.max_episode_steps == horizons[env_id.split("/")[1][:4]]
    if default.spec.max_episode_steps is None:
        return
    fast = gym.make(env_id, **({"duration_s": 60.0} if "Sync" in env_id else {"duration_s": 45.0}), policy_rate_hz=12.5)
    assert fast.spec.max_episode_steps > 500
    assert not isinstance(fast, TimeLimit)
    for env in (default, fast, gym.make(env_id, max_episode_steps=10)):
        env.close()


def test_the_horizon_follows_the_settings_and_serves_gymnasiums_wrapper():
    made = gym.make(SINE, duration_s=0.4)
    for env in (made, gym.make(made.spec), pickle.loads(pickle.dumps(made))):
        aware = TimeAwareObservation(env, normalize_time=True)
        assert env.spec.max_episode_steps == 10
        assert env.spec.kwargs["duration_s"] == 0.4
        aware.reset(seed=0)
        steps = [aware.step(np.zeros(12, dtype=np.float32)) for _ in range(10)]
        assert [each[3] for each in steps] == [False] * 9 + [True]
        assert steps[4][0][-1] == 0.5
        assert steps[-1][0][-1] == 1.0
    assert gym.make(SINE, max_episode_steps=4).spec.max_episode_steps == 4


@pytest.mark.parametrize(
    "keywords", [{"observation_dtype": "float32"}, {"observation": "goals"}], ids=["single", "goals"]
)
@pytest.mark.parametrize("env_id", IDS)
def test_every_interface_rounds_and_shows_the_same_numbers(env_id, keywords):
    single = np.float32
    control, env, dm = gym.make(env_id), gym.make(env_id, **keywords), dm_env(env_id, seed=3, **keywords)
    envs = gym.make_vec(env_id, num_envs=1, **keywords)
    two, two_control = parallel_env(env_id, **keywords), parallel_env(env_id)
    found = {"gym": env.reset(seed=3)[0], "dm_env": dm.reset().observation, "vector": envs.reset(seed=3)[0][0]}
    expected, agents, agents_control = control.reset(seed=3)[0], two.reset(seed=3)[0], two_control.reset(seed=3)[0]
    view = control.unwrapped.task.concise_view()

    def shown(both):
        return both.astype(single) if "observation_dtype" in keywords else view(both[None])[0]

    assert env.observation_space.dtype == envs.single_observation_space.dtype == dm.observation_spec().dtype == single
    for action in actions(env, 3):
        by_agent = dict(zip(two.agents, action.reshape(2, -1), strict=True))
        for name, observation in {**found, "state": two.state()}.items():
            assert observation.dtype == single, name
            assert np.array_equal(observation, shown(expected)), name
        for agent, observation in agents.items():
            assert observation in two.observation_space(agent)
            assert observation.dtype == two.observation_space(agent).dtype == single
            half = shown(two_control.state()).reshape(2, -1)[ARMS.index(agent)]
            assert np.array_equal(observation, half)
            assert np.array_equal(agents_control[agent], two_control.state().reshape(2, -1)[ARMS.index(agent)])
        expected, *rest = control.step(action)
        found = {
            "gym": env.step(action)[0],
            "dm_env": dm.step(action).observation,
            "vector": envs.step(action[None])[0][0],
        }
        agents, agents_control = two.step(by_agent)[0], two_control.step(by_agent)[0]
    assert found["gym"] in env.observation_space
    assert rest[1] is False


BAD_ACTIONS = {
    "shape": np.zeros(11),
    "rank": np.zeros((12, 1)),
    "nan": np.full(12, np.nan),
    "inf": np.r_[np.zeros(11), np.inf],
    "object": np.array([None] * 12),
    "text": np.array(["0"] * 12),
    "complex": np.zeros(12, dtype=complex),
}


@pytest.mark.parametrize("kind", list(BAD_ACTIONS))
def test_malformed_actions_are_refused_and_nothing_moves(kind):
    env, control = gym.make(SINE, disable_env_checker=True), gym.make(SINE, disable_env_checker=True)
    env.reset(seed=0)
    control.reset(seed=0)
    with pytest.raises(errors.ActionError):
        env.step(BAD_ACTIONS[kind])
    action = np.full(12, 0.1, dtype=np.float32)
    assert np.array_equal(env.step(action)[0], control.step(action)[0])


LOW = {"axis": "z", "center_m": ((0, 0.6, 0.15), (0, -0.6, 0.15))}
BAD_KEYWORDS = [
    ({"amplitud_m": 0.1}, errors.UnknownNameError, "amplitude_m"),
    ({"amplitude_m": 0.9}, errors.WorkspaceError, "cannot reach"),
    ({"frequency_hz": 2.0}, errors.WorkspaceError, "rad/s"),
    (
        {**LOW, "amplitude_m": 0.15, "frequency_hz": 0.3},
        errors.WorkspaceError,
        "table",
    ),
    ({"center_m": ((0, 0.6, 0.066), (0, -0.6, 0.066)), "amplitude_m": 0.01}, errors.WorkspaceError, "table"),
    ({"center_m": "abc"}, errors.SettingsError, "center_m"),
    ({"axis": ("a", "b", "c")}, errors.SettingsError, "axis"),
    ({"randomize": "no"}, errors.SettingsError, "randomize"),
    ({"policy_rate_hz": 0.01}, errors.RateError, "0.5"),
    ({"policy_rate_hz": "25"}, errors.RateError, "number"),
    ({"amplitude_m": float("nan")}, errors.SettingsError, "amplitude_m"),
    ({"amplitude_m": "0.1"}, errors.SettingsError, "amplitude_m"),
    ({"axis": "w"}, errors.UnknownNameError, "'x'"),
    ({"axis": (0, 0, 0)}, errors.SettingsError, "axis"),
    ({"center_m": (0, 0, 0)}, errors.SettingsError, "center_m"),
    ({"policy_rate_hz": 30}, errors.RateError, "31.25 Hz"),
    ({"policy_rate_hz": 1000}, errors.RateError, "125 Hz"),
    ({"action_mode": "torque"}, errors.UnknownNameError, "joint_delta"),
    ({"action_latency_ticks": -1}, errors.SettingsError, "whole number"),
    ({"action_latency_ticks": "x"}, errors.SettingsError, "whole number"),
    ({"action_latency_ticks": True}, errors.SettingsError, "whole number"),
    ({"action_latency_ticks": 0.5}, errors.SettingsError, "whole number"),
    ({"render_mode": "ansi"}, errors.UnknownNameError, "rgb_array"),
    ({"camera": "nose"}, errors.UnknownNameError, "perspective"),
    ({"cell": "gazebo"}, errors.UnknownNameError, "mujoco"),
    ({"duration_s": 10**400}, errors.SettingsError, "too large"),
    ({"reward_weights": {"position": 10**400}}, errors.SettingsError, "too large"),
    ({"progress_weight": 10**400}, errors.SettingsError, "too large"),
]


@pytest.mark.filterwarnings("ignore")  # Gymnasium warns of a render mode before the environment refuses it
@pytest.mark.parametrize(("keywords", "error", "text"), BAD_KEYWORDS, ids=lambda x: str(x)[:40])
def test_bad_keywords_are_refused_by_name(keywords, error, text):
    with pytest.raises(error, match=re.escape(text)):
        gym.make(SINE, **keywords)


def test_bad_cells_are_refused():
    with pytest.raises(errors.RateError, match="divide"):
        CellConfig(timestep_s=0.003)
    with pytest.raises(errors.SettingsError, match="apart"):
        CellConfig(left=ArmMount((-0.75, 0.1, 0.0)), right=ArmMount((-0.75, -0.1, 0.0)))
    crossed = CellConfig(left=ArmMount((-0.75, 0.25, 0.0)), right=ArmMount((-0.75, -0.25, 0.0)))
    center = ((0.0, -0.02, 0.4), (0.0, 0.02, 0.4))
    with pytest.raises(errors.WorkspaceError, match=r"left/.* and right/"):
        gym.make(SINE, cell=crossed, center_m=center, randomize=False, amplitude_m=0.01)


def test_unknown_id_and_use_after_close_and_before_reset():
    with pytest.raises(gym.error.Error):
        gym.make("DualUR10/Nothing-v0")
    env = gym.make(SINE).unwrapped
    with pytest.raises(errors.ResetNeededError, match="reset"):
        env.step(np.zeros(12, dtype=np.float32))
    env.close()
    with pytest.raises(errors.ClosedError, match="new one"):
        env.reset(seed=0)


@pytest.mark.parametrize("mode", ["joint_position", "tcp_delta"])
def test_other_action_modes(mode):
    env = gym.make(SINE, action_mode=mode, randomize=False)
    _, info = env.reset(seed=0)
    start = info["flange_m"].copy()
    if mode == "joint_position":
        action = info["q_rad"].reshape(12).astype(np.float32)
        for _ in range(5):
            info = env.step(action)[4]
        assert np.abs(info["flange_m"] - start).max() < 1e-5
        return
    action = np.zeros(12, dtype=np.float32)
    action[[2, 8]] = 0.5, -0.5  # left up, right down, 0.125 m/s for 0.4 s
    for _ in range(10):
        info = env.step(action)[4]
    for _ in range(20):
        info = env.step(np.zeros(12, dtype=np.float32))[4]
    moved = info["flange_m"] - start
    assert np.abs(moved[:, :2]).max() < 0.01
    assert 0.03 < moved[0, 2] < 0.06
    assert -0.06 < moved[1, 2] < -0.03


@pytest.mark.parametrize(("env_id", "tcp_m"), [(SINE, 0.0), ("DualUR10/Handover-v0", TOOL.tcp_m)])
def test_tcp_delta_rotates_about_the_tool_centre_point_of_the_task(env_id, tcp_m):
    env = gym.make(env_id, action_mode="tcp_delta")
    _, info = env.reset(seed=0)
    before, start = flange_pose(info["q_rad"], NOMINAL_DH)
    action = np.zeros(env.action_space.shape, dtype=np.float32).reshape(2, -1)
    action[:, 3:6] = [[0.5, 0.2, -0.5], [-0.5, 0.4, 0.3]]
    for k in range(30):
        info = env.step((action if k < 20 else 0.0 * action).reshape(-1))[4]
    after, end = flange_pose(info["q_rad"], NOMINAL_DH)
    assert np.linalg.norm(end - start, axis=(1, 2)).min() > 0.2
    assert np.abs(after + tcp_m * end[..., 2] - before - tcp_m * start[..., 2]).max() < 5e-4
    env.close()


@pytest.mark.parametrize("rate", [125, 62.5, 25, 5])
def test_every_whole_rate_works(rate):
    env = gym.make(SINE, policy_rate_hz=rate, duration_s=2.0)
    policy = policies.load("scripted", SINE, policy_rate_hz=rate)
    observation, _ = env.reset(seed=0)
    steps = 0
    over = False
    while not over:
        observation, _, terminated, over, info = env.step(policy(observation))
        assert not terminated
        steps += 1
    assert steps == 2 * rate
    assert info["is_success"]


def test_e_series_runs_at_its_own_tick():
    from ur_core.servoj import ServojProfile

    cell = CellConfig(servoj=ServojProfile("e-series"), timestep_s=0.001)
    env = gym.make(SINE, cell=cell, duration_s=1.0)
    policy = policies.load("scripted", SINE, cell=cell)
    observation, _ = env.reset(seed=0)
    for _ in range(25):
        observation, _, _, over, info = env.step(policy(observation))
    assert over
    assert info["flange_error_m"].max() < 1e-4


def test_a_step_after_termination_is_refused_until_a_reset():
    env = gym.make(SINE)
    env.reset(seed=0)
    env.unwrapped.core.cell._physics._arms_qd[0, 0, 3] = np.nan
    still = np.zeros(12, dtype=np.float32)
    assert env.step(still)[2]
    with pytest.raises(errors.ResetNeededError, match="reset"):
        env.unwrapped.step(still)
    env.reset()
    assert not env.step(still)[2]
