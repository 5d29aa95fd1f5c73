"""Chunk policies of tests."""

import math
import os
import time

import numpy as np

SPEED_RAD_S = 1.2  # limit of SineTracking, in which steps are stated


class Sway:
    """Chunks of one smooth motion of all joints, known from the time alone, from where both arms begin.

    Args:
        dt_s: Time between two actions.
        count: Actions in a chunk.
        action_mode: Of the chunks.
        size: Numbers of an arm: with 7 a gripper closes after 1 s.
        amplitude_rad: Of the motion.
        home: (12,) joint positions at which it begins; None: those commanded in the first observation.
    """

    def __init__(self, dt_s=0.1, count=15, action_mode="joint_position", size=6, amplitude_rad=0.15, home=None):
        self.dt_s, self.count, self.action_mode, self.size = dt_s, count, action_mode, size
        self.amplitude_rad = amplitude_rad
        self.given, self.home, self.asked = home, home, []

    def reset(self):
        self.home, self.asked = self.given, []

    def q_rad(self, time_s):
        """Return joint positions, (k, 12), that begin at rest."""
        phase = 2.0 * np.maximum(time_s, 0.0)[:, None]
        return self.home + self.amplitude_rad * np.sin(phase) * (1.0 - np.exp(-(phase**2)))

    def chunk(self, observation, time_s):
        self.asked.append(time_s)
        if self.home is None:
            self.home = commanded_of(observation)
        times = time_s + self.dt_s * np.arange(self.count + 1)
        joints = self.q_rad(times)
        rows = joints[1:] if self.action_mode == "joint_position" else np.diff(joints, axis=0) / SPEED_RAD_S / self.dt_s
        if self.size == 6:
            return rows
        closed = np.where(times[1:] > 1.0, -1.0, 1.0)[:, None, None]
        return np.concatenate([rows.reshape(-1, 2, 6), np.tile(closed, (1, 2, 1))], axis=2).reshape(len(rows), -1)


class Once(Sway):
    """Its first chunks are those of `Sway`, and then something else."""

    def __init__(self, then, first=1, **options):
        super().__init__(**options)
        self.then, self.first = then, first

    def chunk(self, observation, time_s):
        found = super().chunk(observation, time_s)
        if len(self.asked) <= self.first:
            return found
        return self.then(found)


class Portable(Sway):
    """It is asked in a child process where the time of day is kept, and the second time that one ends."""

    portable = True

    def chunk(self, observation, time_s):
        if self.asked:
            os._exit(1)
        return super().chunk(observation, time_s)


class Waiting(Sway):
    """Its first chunk, in a child process, waits for a file "let" in a folder, and leaves "begun" and "late" there."""

    portable = True

    def __init__(self, folder, **options):
        super().__init__(**options)
        self.folder = folder

    def chunk(self, observation, time_s):
        (self.folder / "begun").touch()
        for _ in range(500):
            if (self.folder / "let").exists():
                break
            time.sleep(0.01)
        else:
            (self.folder / "late").touch()
            raise TimeoutError("nobody let it go on")
        return super().chunk(observation["state"], time_s)


def commanded_of(observation):
    """Return the commanded joint positions, (12,), in the observation of one cell."""
    return np.asarray(observation, dtype=np.float64).reshape(2, -1)[:, 12:18].reshape(12)


class Arms:
    """Stand-in for an environment: commands are exactly where the actions lead, measured positions are noise."""

    def __init__(self, executor, mode="joint_delta", period_s=0.04, begins=0.3, seed=0):
        self.executor, self.mode, self.period_s = executor, mode, period_s
        self.q, self.time_s, self._rng = np.full(12, begins), 0.0, np.random.default_rng(seed)
        self.path, self.times, self.openings = [self.q.copy()], [0.0], []

    def observation(self):
        noise = self._rng.uniform(-3.0, 3.0, (2, 6))
        speeds = (self.path[-1] - self.path[-2]) / self.period_s if len(self.path) > 1 else np.zeros(12)
        parts = [noise, speeds.reshape(2, 6), self.q.reshape(2, 6), np.zeros((2, 7))]
        return np.concatenate(parts, axis=1).reshape(-1)

    def step(self):
        self.executor.observed_at(np.array([self.time_s]))
        action = self.executor(self.observation()).astype(np.float64).reshape(2, -1)
        if action.shape[1] == 7:
            self.openings.append(action[:, 6])
        joints = action[:, :6].reshape(12)
        if self.mode == "joint_delta":
            assert np.abs(joints).max() <= 1.0
            self.q = self.q + joints * SPEED_RAD_S * self.period_s
        else:
            self.q = joints
        self.time_s += self.period_s
        self.path.append(self.q.copy())
        self.times.append(self.time_s)

    def run(self, duration_s):
        for _ in range(math.ceil(duration_s / self.period_s - 1e-9)):
            self.step()
        return np.array(self.path)

    def differences(self):
        """Return the largest speed, acceleration and jerk of the commanded path."""
        path = np.array(self.path)
        return [float(np.abs(np.diff(path, order, axis=0)).max() / self.period_s**order) for order in (1, 2, 3)]
