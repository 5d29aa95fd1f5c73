"""Chunk policies that play a shipped policy's episode, which they have run in a simulation of their own."""

import numpy as np

from dual_ur10.policies import make
from dual_ur10.policies.chunks.chunk_path import ChunkPath


class Planned:
    """Chunks of the joint positions that a policy commands in a simulated episode, by the time alone.

    Args:
        env_id: Id of the environment.
        policy: Name of the policy.
        seed: Seed of the first episode; each reset goes on to the next one.
        dt_s: Time between two actions.
        count: Actions in a chunk.
        action_mode: Of the chunks.
        **keywords: Keywords of the environment.
    """

    def __init__(self, env_id, policy="scripted", seed=0, dt_s=0.1, count=25, action_mode="joint_position", **keywords):
        self.dt_s, self.count, self.action_mode = dt_s, count, action_mode
        self._made, self._seed, self._next = (policy, env_id, keywords), seed, seed
        self._plan(seed)

    def reset(self):
        if self._next != self._seed:
            self._plan(self._next)
        self._next += 1

    def _plan(self, seed):
        policy, env_id, keywords = self._made
        env, actor = make(policy, env_id, **keywords)
        core = env.unwrapped.core
        observation, _ = env.reset(seed=seed)
        actor.reset()
        joints, openings = [core.pipeline.adapter.commanded_q_rad.reshape(12)], []
        over = False
        while not over:
            action = actor(observation)
            observation, _, terminated, truncated, _ = env.step(action)
            over = terminated or truncated
            joints.append(core.pipeline.adapter.commanded_q_rad.reshape(12))
            openings.append(np.asarray(action).reshape(2, -1)[:, 6:])
        self._seed, self.period_s = seed, core.timing.period_s
        self._joints, self._openings = np.array(joints), np.array(openings)
        self._path = ChunkPath(0.0, self.period_s, self._joints)
        self._step_rad = np.tile(np.asarray(core.setup.step_limits.speed_rad_s), 2) * self.dt_s
        env.close()

    def chunk(self, observation, time_s):
        times = time_s + self.dt_s * np.arange(self.count + 1)
        joints = self._path(times)[0]
        rows = joints[1:] if self.action_mode == "joint_position" else np.diff(joints, axis=0) / self._step_rad
        k = np.clip(np.ceil(times[1:] / self.period_s - 1e-6).astype(int) - 1, 0, len(self._openings) - 1)
        return np.concatenate([rows.reshape(-1, 2, 6), self._openings[k]], axis=2).reshape(self.count, -1)
