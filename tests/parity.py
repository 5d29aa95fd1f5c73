"""Episodes that run in simulation and on two controllers, by the same actions or the same policy."""

import gymnasium as gym
import numpy as np

import dual_ur10  # noqa: F401  # registers the environments
from dual_ur10 import policies
from dual_ur10.policies.evaluation.rollout import rollout
from dual_ur10.sim2real.recording.reader import read_run

TASK, HANDOVER = "DualUR10/SineTracking-v0", "DualUR10/Handover-v0"
PERIOD = 5  # targets of an action


class Wild:
    """Random actions with what a scripted policy does: every limit binds at times."""

    def __init__(self, scripted, seed):
        self._scripted, self._rng = scripted, np.random.default_rng(seed)

    def reset(self):
        """Begin again."""
        self._scripted.reset()

    def __call__(self, observation):
        """An action, (12,)."""
        action = np.asarray(self._scripted(observation), dtype=np.float32)
        return (action + self._rng.uniform(-0.4, 0.4, action.shape)).astype(np.float32)


def simulated(folder, ticks, latency):
    """Run and record an episode of wild actions.

    Returns:
        Keywords of the environment; its actions; and its targets, (k, 2, 6), with k at least `ticks`.
    """
    keywords = {"duration_s": max(4.0, ticks * 0.008), "action_latency_ticks": latency, "action_mode": "joint_delta"}
    env = gym.make(TASK, record=str(folder), disable_env_checker=True, **keywords)
    policy = Wild(policies.load("scripted", TASK, **keywords), 0)
    policy.reset()
    observation, _ = env.reset(seed=3)
    actions = []
    while PERIOD * len(actions) < ticks:
        actions.append(policy(observation))
        observation, _, terminated, _, _ = env.step(actions[-1])
        assert not terminated, "the gate has refused something: choose another seed"
    env.close()
    (episode,) = read_run(next(folder.iterdir())).episodes
    targets = episode.targets_rad.reshape(-1, 2, 6)
    assert len(targets) >= ticks
    assert np.abs(np.diff(targets, axis=0)).max() > 1e-3
    return keywords, actions, targets


def handed_over(place, folder, **of_cell):
    """Hand over in simulation, and by the same policy in a recorded episode on two controllers.

    Args:
        place: Cell with `make` and `close_env`.
        folder: Folder of the recording.
        of_cell: Keywords of the policy on the cell, such as `cell`.

    Returns:
        The episode, the number of its late actions, and its record.
    """
    keywords = {"action_latency_ticks": 8}
    env = gym.make(HANDOVER, disable_env_checker=True, **keywords)
    policy = policies.load("scripted", HANDOVER, **keywords)
    assert rollout(env, policy, seed=1).success
    env.close()
    env = place.make(record=str(folder), **keywords)
    policy = policies.load("scripted", HANDOVER, **of_cell, **keywords) if of_cell else policy
    found = rollout(env, policy, seed=1)
    late = env.unwrapped.core.late_actions
    place.close_env()
    run = read_run(next(folder.iterdir()))
    assert run.complete
    assert run.header.source == "emulated"
    assert len(run.episodes[0].action) == found.steps
    assert run.episodes[0].q_rad.shape == (found.steps + 1, 2, 6)
    return found, late, run
