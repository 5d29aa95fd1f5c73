"""Benchmarks that nobody runs for a while still run."""

import importlib
import pathlib

import pytest

FOLDER = pathlib.Path(__file__).parent.parent / "benchmarks"


@pytest.mark.parametrize("n", [1, 3])
def test_throughput_is_measured_over_the_end_of_an_episode(monkeypatch, n):
    monkeypatch.syspath_prepend(FOLDER)  # they import each other
    throughput = importlib.import_module("throughput")
    found = throughput.measure("DualUR10/SyncCarry-v0", n, "random", 1, 40, 1)  # which random actions end at once
    assert 0.0 < found["efficiency"] < 1.0
    assert found["env_steps_per_s"] > 0.0
