"""Order of returns: what people would call better earns more, and what is not the task earns little."""

import importlib
import pathlib
from itertools import pairwise

import numpy as np
import pytest

from dual_ur10.envs.core.core import Core

SINE, HANDOVER, CARRY = (f"DualUR10/{name}-v0" for name in ("SineTracking", "Handover", "SyncCarry"))
FLOORS = ("zero", "uniform", "normal")


@pytest.fixture
def earned(monkeypatch):
    """Function that returns mean returns of behaviours of the benchmark and means of their terms, by name.

    Returns of floors are there without the cost of refusals, too.
    """
    monkeypatch.syspath_prepend(pathlib.Path(__file__).parents[3] / "benchmarks")
    benchmark = importlib.import_module("returns")

    def measure(env_id, *names, seeds=(3,), **keywords):
        behaviours = benchmark.behaviours_of(env_id)
        found = benchmark.measure(env_id, {name: behaviours[name] for name in names}, seeds, **keywords)
        returns = {}
        for name, row in found.items():
            returns[name] = float(row["return"].mean())
            returns |= {f"{name}: {key}": float(value.mean()) for key, value in row.items()}
            if name in FLOORS:
                returns[f"{name} without refusals"] = returns[name] - returns[f"{name}: refusals"]
        return returns

    return measure


def falls(returns, *names):
    """Assert that each of these behaviours earns less than the one before."""
    assert all(returns[better] > returns[worse] for better, worse in pairwise(names)), [(n, returns[n]) for n in names]


def earns_little(returns, script):
    """Assert that doing nothing or anything earns at most a tenth of the script's return."""
    floors = {name: value for name, value in returns.items() if name.startswith(FLOORS) and ":" not in name}
    assert max(floors.values()) <= 0.1 * script, floors


def test_sine_tracking_pays_for_following(earned):
    """Doing nothing, a disturbed script, and what comes close to the reference without following it."""
    beside = [f"{each} mm beside" for each in (1, 5, 8, 20, 100)]
    partly = ["stops after 25 %", "pauses 50 %", "left arm only", "right arm only"]
    cheats = ["at the extreme", "from extreme to extreme", "the other way", "shaking at the centre"]
    more = "stops after 75 %", "stops after 50 %", "pauses 10 %", "2 periods late", "5 periods late"
    found = earned(SINE, *FLOORS, "script", *beside, *partly, *cheats, *more, duration_s=4.0, soft_start_s=0.5)
    earns_little(found, found["script"])
    falls(found, "script", *beside)
    falls(found, "script", "stops after 75 %", "stops after 50 %", "stops after 25 %")
    falls(found, "script", "pauses 10 %", "pauses 50 %")
    falls(found, "script", "2 periods late", "5 periods late")
    assert found["8 mm beside"] >= 0.5 * found["script"]
    assert max(found[name] for name in cheats) < min(found[name] for name in partly), found


@pytest.mark.parametrize("what", ["off_m", "chord"])
def test_sine_tracking_leads_from_any_distance(what):
    """The reward of arms that stay off their references falls steadily, over the whole workspace."""
    errors = np.geomspace(1e-4, 1.5, 60)
    core = Core(SINE, {}, n=len(errors), threads=1)
    core.reset([np.random.default_rng(0) for _ in errors])
    measured = core.task.measure(core._state)
    off = measured.errors._replace(**{what: np.stack([errors] * 2, axis=1)})
    for _ in range(2):  # at rest in the second
        terms = core.task.evaluate(core._state, measured._replace(errors=off)).terms
    rewards = terms.mean(axis=1) @ list(core.task.weights.values())
    core.close()
    slope = np.diff(rewards) / np.diff(errors)
    assert (slope < 0.0).all(), slope
    assert (slope[errors[1:] < 0.5] < -0.01).all(), slope
    assert (terms >= 0.0).all()  # an early end is never worth more than going on


def test_a_handover_pays_for_what_is_done(earned):
    """Doing nothing, a disturbed script, and staying in each stage in ways that lead nowhere."""
    honest = {number: f"holds at stage {number}" for number in range(1, 7)}
    cheats = {f"releases at stage {number}": number for number in (2, 4, 6)} | {
        "shakes at stage 0": 1,
        "opens and closes at stage 1": 2,  # it grasps
        "shakes at stage 4": 4,
    }
    disturbed = [
        *("10 mm beside", "100 mm beside", "left arm only", "right arm only"),
        *("waits 0.6 s at each stage", "stops after 50 %", "stops after 25 %"),
    ]
    steps = 330  # of 500
    found = earned(HANDOVER, *FLOORS, "script", *disturbed, *honest.values(), *cheats, max_episode_steps=steps)
    earns_little(found, found["script"] * steps / 500)
    falls(found, "script", "10 mm beside", "100 mm beside")
    falls(found, "script", "waits 0.6 s at each stage")
    falls(found, "script", "stops after 50 %", "stops after 25 %", "right arm only")
    falls(found, "script", "left arm only", "right arm only")
    falls(found, "script", *reversed(honest.values()), "zero")
    for name, stage in cheats.items():
        assert found[name] <= found[honest[stage]], (name, found)


def test_a_carry_pays_for_what_is_done(earned):
    """Doing nothing, a disturbed script, and what holds the bar, or follows its reference, without carrying it."""
    names = [
        *("script", "5 mm beside", "100 mm beside"),
        *("left arm only", "right arm only", "pauses 50 %"),
        *(f"stops after {share} %" for share in (25, 50, 75)),
        *("holds the bar on the table", "shakes the bar on the table", "opens and closes"),
        *("follows with open fingers", "releases half-way", "shakes half-way"),
    ]
    found = earned(CARRY, *FLOORS, *names, max_episode_steps=260)
    # The bar stays in the air for 550 steps more, each of which earns 0.94: tests/envs/tasks/test_sync_carry.py.
    earns_little(found, found["script"] + 0.94 * 550)
    falls(found, "script", "5 mm beside", "100 mm beside", "holds the bar on the table")
    falls(found, "script", "pauses 50 %", "holds the bar on the table")
    falls(found, "script", "stops after 75 %", "stops after 50 %", "stops after 25 %")
    falls(found, "holds the bar on the table", "shakes the bar on the table", "follows with open fingers", "zero")
    falls(found, "holds the bar on the table", "opens and closes", "left arm only")
    falls(found, "stops after 50 %", "releases half-way", "right arm only")
    falls(found, "stops after 50 %", "shakes half-way")
    for name in ("holds the bar on the table", "100 mm beside"):
        for term in ("orientation", "synchrony", "squeeze"):  # arms that stand still have these, too
            assert found[f"{name}: reward/{term}"] <= found[f"{name}: reward/position"]
