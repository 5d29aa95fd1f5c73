"""One policy, in a process without environment and cell, on both kinds of cells."""

import subprocess
import sys

import gymnasium as gym
import numpy as np

LATENCY = 16  # ticks: two alternating processes need more than one

POLICY = """
import sys
import numpy as np
from dual_ur10 import policies

policy = policies.load("scripted", "DualUR10/SineTracking-v0", action_latency_ticks=int(sys.argv[2]))
size = int(sys.argv[1])
while True:
    data = sys.stdin.buffer.read(8 * size)
    if len(data) < 8 * size:
        break
    action = np.asarray(policy(np.frombuffer(data)), dtype=np.float32)
    sys.stdout.buffer.write(action.tobytes())
    sys.stdout.buffer.flush()
for name in ("mujoco", "rtde_control", "dual_ur10.sim2real.runtime.rtde_cell"):
    if name in sys.modules:
        sys.exit(f"{name} was imported")
"""


class Remote:
    """Policy that asks a process for actions over its pipes."""

    def __init__(self, size):
        self.process = subprocess.Popen(
            [sys.executable, "-c", POLICY, str(size), str(LATENCY)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )

    def __call__(self, observation):
        self.process.stdin.write(np.asarray(observation, dtype=np.float64).tobytes())
        self.process.stdin.flush()
        data = self.process.stdout.read(4 * 12)
        if len(data) < 4 * 12:
            raise EOFError(f"the policy's process has ended: {self.process.stderr.read().decode()}")
        return np.frombuffer(data, dtype=np.float32)

    def __enter__(self):
        return self

    def __exit__(self, kind, error, trace):
        if kind is not None:
            self.process.kill()
        text = self.process.communicate()[1].decode()
        assert kind is not None or self.process.returncode == 0, text


def test_a_remote_policy_acts_on_both_kinds_of_cells(lab):
    errors, keywords = [], {"action_latency_ticks": LATENCY}
    for cell in ("mujoco", None):
        if cell is None:
            env = lab.make(**keywords)
        else:
            env = gym.make("DualUR10/SineTracking-v0", cell=cell, disable_env_checker=True, **keywords)
        found = []
        with Remote(env.observation_space.shape[0]) as policy:
            observation, _ = env.reset(seed=3)
            for _ in range(40):
                observation, _, terminated, _, info = env.step(policy(observation))
                assert not terminated
                found.append(info["flange_error_m"])
        errors.append(np.array(found))
        if cell is None:
            assert not env.unwrapped.core.late_actions
        else:
            env.close()
    assert lab.latch.read() is None
    simulated, emulated = (each[20:].max() for each in errors)
    assert simulated < 2e-3
    assert emulated < 5e-3
