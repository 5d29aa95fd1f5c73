"""Long adversarial policies: packets to both controllers keep every limit."""

import itertools

import numpy as np
import pytest

from tests import soak

TICKS, PARTS = (5_000, 10) if soak.SOAK else (300, 1)
"""Of both arms together, and how often for each kind of policy: 200,000 in a soak."""

_COLLECTED = 100  # steps: a sender remembers 4096 targets


def at_random(rng):
    """Return random actions."""
    while True:
        yield rng.uniform(-1.0, 1.0, 12)


def extreme(rng):
    """Return corners of the action space."""
    while True:
        yield rng.choice([-1.0, 1.0], 12)


def beyond(rng):
    """Return actions far outside the action space."""
    while True:
        yield rng.choice([-1.0, 1.0], 12) * 10.0 ** rng.integers(0, 30)


def alternating(rng):
    """Return actions that alternate between bounds at every rate, all joints or some."""
    for steps in itertools.cycle((1, 2, 3, 5, 8, 13)):
        way = rng.choice([-1.0, 0.0, 1.0], 12)
        for k in range(6):
            for _ in range(steps):
                yield way * (-1.0) ** k


KINDS = (at_random, extreme, beyond, alternating)


@pytest.mark.parametrize("part", range(PARTS))
@pytest.mark.parametrize("kind", KINDS, ids=[each.__name__ for each in KINDS])
def test_5_6_nothing_that_a_policy_does_gets_past_the_limits(lab, kind, part):
    lab.make()
    lab.env.reset(seed=part)
    actions = kind(np.random.default_rng([KINDS.index(kind), part]))
    for step in range(TICKS // len(lab.wires) // lab.env.unwrapped.core.cell.ticks):
        if lab.env.step(next(actions))[2]:
            lab.reset(seed=step)
        if step % _COLLECTED == 0:
            for wire in lab.wires:
                wire.collect()
    assert lab.latch.read() is None
    assert sum(lab.assert_within_limits()) >= TICKS
    for wire in lab.wires:
        assert np.ptp(wire.packages()[1], axis=0).max() > 1e-3, f"{wire.arm} has not moved"
