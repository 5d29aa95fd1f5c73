"""Executors of chunks: late, lost, wrong and missing chunks, at any rate, from commanded positions alone."""

import itertools
import math
import threading

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import dual_ur10  # noqa: F401  # registers the environments
from dual_ur10.assets.settings import SceneSettings, home_q_rad
from dual_ur10.envs.tasks.task import Timing
from dual_ur10.errors import ChunkError, PolicyError, SettingsError
from dual_ur10.policies import evaluate, load, make, rollout
from dual_ur10.policies.chunks.executor import ChunkExecutor
from dual_ur10.sim2real.control.limits import MotionLimits
from dual_ur10.testing import check_policy
from tests.policies.chunks.sources import Arms, Once, Portable, Sway, Waiting

LIMITS = MotionLimits(speed_rad_s=(1.2,) * 6, acceleration_rad_s2=10.0, jerk_rad_s3=2000.0, tcp_speed_m_s=1.5)


def executor_of(source, period_s=0.04, **options):
    return ChunkExecutor(source, timing=Timing(period_s, period_s), limits=LIMITS, **options)


@pytest.mark.parametrize("chunks", ["joint_delta", "joint_position"])
@pytest.mark.parametrize("mode", ["joint_delta", "joint_position"])
@pytest.mark.parametrize("period_s", [0.02, 0.04, 0.056])
def test_ten_hertz_eighty_milliseconds_late_at_any_rate(chunks, mode, period_s):
    source = Sway(action_mode=chunks)
    arms = Arms(executor_of(source, period_s, latency_s=0.08, action_mode=mode), mode, period_s)
    path = arms.run(4.0)
    exact = source.q_rad(np.array(arms.times))
    settled = np.array(arms.times) > 0.6
    assert np.abs(path - exact)[settled].max() < 3e-4
    assert arms.executor.late == 0
    assert arms.executor.splices > 4


delays = st.lists(st.sampled_from([0.0, 0.02, 0.08, 0.2, 0.7, math.inf]), min_size=1, max_size=8)


@given(delays=delays, chunks=st.sampled_from(["joint_delta", "joint_position"]), seed=st.integers(0, 99))
def test_delays_and_losses_never_make_a_jump(delays, chunks, seed):
    delay = itertools.cycle([*delays, 0.1])
    arms = Arms(executor_of(Sway(action_mode=chunks), latency_s=lambda: next(delay)), seed=seed)
    arms.run(5.0)
    # Differences over a period are means of what the fades keep within nine tenths of the limits.
    assert (np.array(arms.differences()) <= [1.2, 10.0, 2000.0]).all()


def test_arms_wait_for_a_slow_first_chunk_and_then_move():
    arms = Arms(executor_of(Sway(), latency_s=0.7))
    path = arms.run(3.0)
    assert np.ptp(path[:18], axis=0).max() == 0.0
    assert np.ptp(path, axis=0).min() > 0.05


def test_a_chunk_without_a_successor_ends_at_rest_on_its_path_and_the_next_one_moves_again():
    delays = itertools.chain([0.04, 3.0], itertools.repeat(0.04))
    source = Sway(count=15, amplitude_rad=0.45)
    arms = Arms(executor_of(source, latency_s=lambda: next(delays)))
    path = arms.run(6.0)
    assert (np.array(arms.differences()) <= [1.2, 10.0, 2000.0]).all()
    last = source.q_rad(np.array([1.5]))[0]  # the last action of the first chunk
    resting = [k for k, q in enumerate(path) if np.abs(q - last).max() < 1e-6]
    assert len(resting) > 20
    assert resting == list(range(resting[0], resting[-1] + 1))
    # All joints stay on the path on which they slow down.
    for q in path[30 : resting[0]]:
        nearest = source.q_rad(np.linspace(1.0, 1.6, 6001))
        assert np.abs(nearest - q).max(axis=1).min() < 2e-4
    assert np.abs(path[-1] - last).max() > 0.01


def test_actions_whose_time_has_passed_are_dropped():
    late = itertools.chain([0.04], itertools.repeat(9.0))
    executor = executor_of(Sway(count=5), latency_s=lambda: next(late))
    arms = Arms(executor)
    with pytest.raises(ChunkError, match=r"last 10 chunks of Sway came after all of their actions, the last one 9 s"):
        arms.run(200.0)
    assert (executor.splices, executor.late) == (1, 10)
    assert np.ptp(arms.path[-50:], axis=0).max() == 0.0


@pytest.mark.parametrize("kind", [np.float32, np.float16])
def test_times_are_exact_whatever_the_precision_of_dt_s(kind):
    paths = []
    for dt_s in (0.125, kind(0.125)):
        arms = Arms(executor_of(Sway(dt_s=dt_s), latency_s=0.08, action_mode="joint_position"), "joint_position")
        arms.time_s = 7200.04
        paths.append(arms.run(1.0))
    assert np.array_equal(*paths)


def test_measured_positions_have_no_effect():
    paths = [Arms(executor_of(Sway(), latency_s=0.1), seed=seed).run(2.0) for seed in (1, 2)]
    assert np.array_equal(*paths)


def spoiled(rows, value):
    rows = np.array(rows)
    rows[-1, -1] = value
    return rows


def raising(rows):
    raise ConnectionError("the server is gone")


@pytest.mark.parametrize(
    ("then", "error", "text"),
    [
        (lambda rows: spoiled(rows, np.nan), ChunkError, "number 5 of arm 1 in action 14 of a chunk of Once is nan"),
        (lambda rows: spoiled(rows, np.inf), ChunkError, "must be finite"),
        (lambda rows: spoiled(rows, -1e60), ChunkError, r"is -1e\+60: all must be finite, of 1e\+06 at most"),
        (lambda rows: rows[:, :7], ChunkError, r"\(15, 7\): a chunk is 1 to 1000 actions of 12 numbers"),
        (lambda rows: rows[:0], ChunkError, "returned 0 actions"),
        (lambda rows: np.zeros((1001, 12)), ChunkError, "returned 1001 actions"),
        (lambda rows: rows[0], ChunkError, r"of shape \(12,\)"),
        (lambda rows: "go on", ChunkError, "a chunk is"),
        (lambda rows: None, ChunkError, "a chunk is"),
        (lambda rows: [[1.0], [1.0, 2.0]], ChunkError, "which is no array"),
        (raising, ConnectionError, "the server is gone"),
    ],
)
def test_wrong_chunks_are_errors_once_both_arms_rest_on_their_path(then, error, text):
    source = Once(then)
    arms = Arms(executor_of(source, latency_s=0.04))
    with pytest.raises(error, match=text):
        arms.run(9.0)
    assert arms.time_s < 2.0  # the first chunk lasts 1.5 s
    assert arms.path[-1] == pytest.approx(source.q_rad(np.array([1.5]))[0], abs=1e-6)
    assert (np.array(arms.differences()) <= [1.2, 10.0, 2000.0]).all()
    arms.executor.reset()
    arms.step()  # a new episode


def test_other_steps_are_refused():
    source = Sway()
    for name, value, text in (
        ("dt_s", 0.0, "0.001 to 10 s"),
        ("dt_s", math.nan, "dt_s"),
        ("action_mode", "tcp", "tcp"),
    ):
        setattr(source, name, value)
        with pytest.raises(ChunkError, match=text):
            Arms(executor_of(source, latency_s=0.0)).step()
        source = Sway()


def test_arms_that_were_led_elsewhere_come_back_without_a_jump():
    arms = Arms(executor_of(Sway(), latency_s=0.08))
    arms.run(1.0)
    for away in np.linspace(0.0, 0.2, 12)[1:]:  # as by a person
        arms.step()
        arms.q = arms.path[-1] = arms.path[-1] + away / 12
    led = len(arms.path)
    path = arms.run(3.0)
    assert np.abs(np.diff(path[led:], 2, axis=0)).max() / 0.04**2 <= 10.0
    assert np.abs(path[-1] - arms.executor.source.q_rad(np.array(arms.times[-1:]))[0]).max() < 3e-4


def test_grippers_are_resampled_and_not_blended():
    arms = Arms(executor_of(Sway(size=7), latency_s=0.08, grippers=True))
    arms.run(2.0)
    openings = np.array(arms.openings)
    assert set(openings.reshape(-1).tolist()) == {-1.0, 1.0}
    closed = openings[:, 0] < 0.0
    assert closed[closed.argmax() :].all()
    assert 0.9 <= arms.times[closed.argmax()] <= 1.0  # within an action before it is to be closed


class Slow(Sway):
    """It returns only when it is let."""

    def __init__(self, **options):
        super().__init__(**options)
        self.begun, self.let = threading.Semaphore(0), threading.Semaphore(0)

    def chunk(self, observation, time_s):
        self.begun.release()
        assert self.let.acquire(timeout=30.0)
        return super().chunk(observation, time_s)


def test_where_the_time_of_day_is_kept_no_action_waits_for_a_chunk():
    source = Slow()
    executor = executor_of(source, real_time=True)
    arms = Arms(executor)
    for _ in range(5):
        arms.step()
    assert source.begun.acquire(timeout=30.0)  # it is asked, once
    assert np.ptp(arms.path, axis=0).max() == 0.0
    source.let.release()
    while not executor._rows[0].pending.done:
        threading.Event().wait(0.001)
    for _ in range(40):
        arms.step()
    assert source.asked == [0.0]
    assert executor.splices == 1
    assert np.abs(arms.path[-1] - source.q_rad(np.array([1.5]))[0]).max() < 1e-6  # the next one has not come
    with pytest.raises(ChunkError, match="no chunk for 10 s"):
        arms.run(16.0)
    source.let.release()
    executor.close()
    executor.close()


def test_a_portable_chunk_policy_is_asked_in_a_child_process_whose_end_is_an_error():
    executor = executor_of(Portable(), real_time=True)
    arms = Arms(executor)
    arms.step()
    assert executor._inference._connection.poll(30.0)
    while executor._rows[0].error is None:
        arms.step()
        executor._inference._connection.poll(30.0 if executor._rows[0].pending else 0.0)
    with pytest.raises(ChunkError, match="the process that asks the chunk policy has ended"):
        arms.run(4.0)
    assert executor.splices == 1
    assert executor.source.asked == []  # it was asked elsewhere
    assert (np.array(arms.differences()) <= [1.2, 10.0, 2000.0]).all()
    executor.close()
    executor.close()


class Pictured(Arms):
    """Arms whose observations do not fit into a pipe."""

    def observation(self):
        return {"state": super().observation(), "pixels": {"front": np.zeros((480, 640, 3), dtype=np.uint8)}}


def test_no_action_waits_for_a_child_process_that_is_still_asked_for_the_episode_before(tmp_path):
    """Its long chunk fits into no pipe either: both processes would wait for each other."""
    executor = executor_of(Waiting(tmp_path, count=1000, dt_s=0.04), real_time=True, silent_s=math.inf)
    connection = executor._inference._connection
    for _ in range(2):
        arms = Pictured(executor)
        executor.reset()
        arms.step()
        while not (tmp_path / "begun").exists():
            threading.Event().wait(0.01)
            arms.step()
    assert not (tmp_path / "late").exists()
    (tmp_path / "let").touch()
    while not executor.splices:
        assert connection.poll(30.0)
        arms.step()
    executor.close()


class Stateless(Sway):
    """It declares that rows may share it."""

    stateless = True


class Remembering:
    """It tells its requests since the last reset apart."""

    dt_s, action_mode, latency_s = 0.04, "joint_delta", 0.0

    def reset(self):
        self.count = 0

    def chunk(self, observation, time_s):
        self.count += 1
        return np.full((10, 12), 0.2 * np.sin(self.count))


def test_episodes_share_no_state_of_a_chunk_policy_whatever_their_number():
    found = [
        evaluate("SineTracking", Remembering(), episodes=3, num_envs=envs, env_kwargs={"duration_s": 1.0}).episodes
        for envs in (1, 3)
    ]
    assert found[0] == found[1]


def test_rows_of_a_batch_act_as_alone():
    env_id, keywords = "DualUR10/SineTracking-v0", {"duration_s": 1.0}
    both = evaluate(env_id, Stateless(), episodes=2, num_envs=2, env_kwargs=keywords)
    one = evaluate(env_id, Sway(), episodes=2, num_envs=1, env_kwargs=keywords)
    rewards = [[each.total_reward for each in found.episodes] for found in (both, one)]
    assert rewards[0] != pytest.approx([0.0, 0.0])
    assert rewards[0][0] == pytest.approx(rewards[1][0], abs=0.5)


class Seeing(Stateless):
    """It looks at an image, too."""

    def chunk(self, observation, time_s):
        assert observation["pixels"]["front"].shape == (8, 12, 3)
        return super().chunk(observation["state"], time_s)


def test_images_reach_the_chunk_policy_alone_and_in_batches():
    keywords = {"observation": "both", "cameras": ("front",), "width": 12, "height": 8, "duration_s": 0.4}
    for envs in (1, 2):
        found = evaluate("SineTracking", Seeing(), episodes=2, num_envs=envs, env_kwargs=keywords)
        assert [each.ended_by for each in found.episodes] == ["", ""]


@pytest.mark.parametrize("keywords", [{}, {"action_mode": "joint_position"}, {"observation": "goals"}])
def test_chunk_policies_are_made_and_rolled_out_as_others(keywords):
    source = Sway(home=home_q_rad(SceneSettings().mounts).reshape(12)) if "observation" in keywords else Sway()
    env, policy = make(source, "SineTracking", duration_s=1.0, **keywords)
    assert isinstance(policy, ChunkExecutor)
    for actor in (policy, source):
        found = rollout(env, actor, seed=0)
        assert found.ended_by == ""
        assert np.ptp(found.q_rad, axis=0).min() > 0.05
    env.close()


def test_a_class_of_chunks_is_loaded_by_name():
    policy = load("tests.policies.chunks.sources:Sway", "SineTracking")
    assert isinstance(policy, ChunkExecutor)


def test_what_is_no_chunk_policy_is_refused():
    with pytest.raises(ChunkError, match="is no chunk policy"):
        executor_of(lambda observation: observation)
    with pytest.raises(SettingsError, match="chunks are executed as joint positions"):
        make(Sway(), "SineTracking", action_mode="tcp_delta")
    with pytest.raises(SettingsError, match="observation is 'pixels'"):
        make(Sway(), "SineTracking", observation="pixels")
    with pytest.raises(SettingsError, match="latency_s is -1"):
        executor_of(Sway(), latency_s=-1)
    with pytest.raises(PolicyError, match="found a chunk policy, of which `make` makes a policy"):
        check_policy(Sway(), "SineTracking")
