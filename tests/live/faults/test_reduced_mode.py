"""Reduced mode where the cell file allows it: row 35 of the table in `docs/explanation/safety.md`."""

import numpy as np
import pytest

from dual_ur10.errors import StartError
from dual_ur10.sim2real.runtime.safety_monitor import REDUCED_SCALING

pytestmark = pytest.mark.streams


@pytest.mark.parametrize("arm", ["left", "right"])
def test_35_reduced_mode_slows_both_alike_where_it_is_allowed(lab, arm):
    lab.rewrite('kind = "emulated"', 'kind = "emulated"\nallow_reduced_mode = true')
    lab.begin()
    memories = lab.runner.arms
    first = [memory.sent_count for memory in memories]
    lab.turn("reduce", {"on": False}, arm=arm, on=True)
    for _ in range(12):
        lab.env.step(lab.policy())
        apart = [np.abs(np.subtract(memory.status.q_rad, memory.status.target_q_rad)).max() for memory in memories]
        assert max(apart) < 0.01  # no error builds up
    slow = [memory.sent_count for memory in memories]
    lab.cell.ask("reduce", arm=arm, on=False)
    for _ in range(25):
        lab.env.step(lab.policy())
    assert lab.latch.read() is None
    sent = [memory.sent(begin)[0] for memory, begin in zip(memories, first, strict=True)]
    rates = [np.diff(each.index) / np.diff(each.period) for each in sent]
    for rate, begin, end in zip(rates, first, slow, strict=True):
        assert float(np.median(rate[end - begin - 20 : end - begin - 1])) == pytest.approx(REDUCED_SCALING, abs=1e-3)
        assert float(rate[-1]) == pytest.approx(1.0, abs=1e-2)
    left, right = (np.interp(np.arange(20, 120), each.period - sent[0].period[0], each.index) for each in sent)
    assert np.abs(left - right).max() < 0.35
    lab.assert_within_limits()


def test_35_other_stops_stop_both_where_reduced_mode_is_allowed(lab):
    lab.rewrite('kind = "emulated"', 'kind = "emulated"\nallow_reduced_mode = true')
    lab.begin()
    lab.turn("reduce", {"on": False}, arm="left", on=True)
    for _ in range(5):
        lab.env.step(lab.policy())
    lab.do("stop", arm="left", mode=3)
    lab.assert_stopped(lab.step_until_faulted(), "left: ")
    lab.latch.clear()
    with pytest.raises(StartError, match="safety mode"):  # a start needs normal mode in any case
        lab.make()
