"""Policies that end their process: row 11 of the table of faults in `docs/reference/faults.md`."""

import pytest

from tests import soak
from tests.live.faults.lab import assert_gone, descendants

pytestmark = pytest.mark.streams

ENDINGS = {
    "exit": "os._exit(3)",
    "sys.exit": "sys.exit(3)",
    "kill": "os.kill(os.getpid(), signal.SIGKILL)",
    "segfault": "ctypes.string_at(0)",
    "abort": "os.abort()",
}

DYING = """
import ctypes, os, signal, sys
import gymnasium as gym
import dual_ur10
from dual_ur10.policies.evaluation.rollout import rollout
from tests.virtual.faults.lab import Swing

class Dying(Swing):
    def __call__(self, observation):
        if self._steps >= 20:
            {end}
        return super().__call__(observation)

rollout(gym.make("DualUR10/SineTracking-v0", cell=sys.argv[1]), Dying())
"""


@pytest.mark.parametrize("end", ENDINGS if soak.SOAK else ["segfault"])
def test_11_a_policy_that_takes_its_process_with_it_stops_both(lab, end):
    process = lab.program(code=DYING.format(end=ENDINGS[end]))
    lab.wait_until_moving(process)
    pids = descendants(process.pid)
    assert process.wait(60.0) != 0, process.stdout.read()
    lab.note()  # or some time after it
    lab.assert_at_rest()
    assert_gone(pids)
    lab.assert_nothing_more()
    for wire in lab.wires:
        wire.assert_rested(lab.fault_tick, lab.tick_s)
    if end != "sys.exit":  # that ends in order, and is no fault
        lab.assert_latched("the program that sends targets has ended")
    lab.assert_within_hard_limits()
