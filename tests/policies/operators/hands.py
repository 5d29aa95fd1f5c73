"""Devices of tests, and a simulated cell led by them."""

import gymnasium as gym
import numpy as np

import dual_ur10  # noqa: F401  # registers the environments
from dual_ur10.envs.core.setup import EnvSetup
from dual_ur10.policies.operators.device import Reading
from dual_ur10.policies.operators.mapping import Mapping
from dual_ur10.policies.operators.operator import Operator


class Hand:
    """Device that gives what the test sets."""

    name = "a hand"

    def __init__(self, hands=2, **reading):
        self.hands, self.reading, self.closed = hands, Reading(**reading), 0

    def set(self, **reading):
        self.reading = Reading(**reading)

    def begin(self):
        pass

    def read(self):
        return self.reading

    def close(self):
        self.closed += 1


def twist(*values, clutch=(True, True), **more):
    """Return the fields of a reading: one twist for both hands, or one for each."""
    rows = np.broadcast_to(np.array(values, dtype=float), (2, 6))
    return {"twist": rows, "clutch": np.array(clutch), **more}


def operator_of(device, task, mapping=None, **keywords):
    """Return the operator of an environment with these keywords."""
    setup = EnvSetup.resolve(task, keywords)
    equipment = setup.config.equipment
    return Operator(
        device,
        Mapping(**(mapping or {})),
        timing=setup.timing,
        action_mode=setup.options.action_mode,
        action_scale=setup.options.action_scale,
        mounts=(setup.config.left, setup.config.right),
        limits=setup.step_limits,
        tools=equipment.tools,
        grippers=equipment.grippers and not equipment.welded,
        view=setup.make_task().concise_view() if setup.options.concise else None,
    )


def led(device, task="SineTracking", mapping=None, **keywords):
    """Return an environment of the echo cell, and the operator that leads it."""
    keywords = {"cell": "echo", "action_mode": "tcp_delta", **keywords}
    env = gym.make(f"DualUR10/{task}-v0", disable_env_checker=True, **keywords)
    return env, operator_of(device, task, mapping, **keywords)


def commanded(observation):
    """Return the commanded joint positions, (2, 6)."""
    return np.asarray(observation).reshape(2, -1)[:, 12:18]
