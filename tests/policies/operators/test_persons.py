"""Persons who act through devices alone finish tasks; 20 of 20 in benchmarks/operators.py."""

import pytest

from dual_ur10.policies.operators import leader
from tests.policies.operators.persons import successes
from tests.soak import SOAK

DEVICES = ["spacemouse", "leader", "page"]
WAYS = [("Handover", {}, device) for device in DEVICES]
WAYS += [("SyncCarry", {"grasp": "rigid"}, device) for device in (DEVICES if SOAK else DEVICES[:1])]


@pytest.mark.parametrize(("task", "keywords", "device"), WAYS)
def test_a_person_finishes_the_task(device, task, keywords, tmp_path, monkeypatch):
    monkeypatch.setattr(leader, "_WAIT_S", 5.0)  # the emulated servos answer from a thread of a busy machine
    assert successes(device, task, [1], tmp_path, **keywords) == 1
