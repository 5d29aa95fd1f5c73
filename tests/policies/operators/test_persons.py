"""Persons who act through devices alone finish tasks; 20 of 20 in benchmarks/operators.py."""

import pytest

from dual_ur10.policies.operators import leader
from tests.policies.operators.persons import successes


@pytest.mark.parametrize("device", ["spacemouse", "leader", "page"])
@pytest.mark.parametrize(("task", "keywords"), [("Handover", {}), ("SyncCarry", {"grasp": "rigid"})])
def test_a_person_finishes_the_task(device, task, keywords, tmp_path, monkeypatch):
    monkeypatch.setattr(leader, "_WAIT_S", 0.2)  # the emulated servos answer from a thread of a busy machine
    assert successes(device, task, [1], tmp_path, **keywords) == 1
