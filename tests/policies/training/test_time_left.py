"""How long a training takes yet."""

from __future__ import annotations

import pytest

from dual_ur10.policies.training.time_left import TimeLeft


def test_it_counts_what_is_gathered_and_every_fit_to_come():
    now = [0.0]
    left = TimeLeft(lambda: now[0])
    left.gathered(100, 10.0)
    assert left(300, 100.0, refits=True) is None
    left.fit_begins()
    now[0] = 30.0
    left.fit_ends()
    # Three rounds of 10 s, with two fits between them and one after the last.
    assert left(300, 100.0, refits=True) == pytest.approx(3 * 10.0 + 3 * 30.0)
    left.gathered(200, 30.0)  # slower
    assert left(50, 100.0, refits=True) == pytest.approx(50 * 0.15 + 30.0)
    assert left(0, 100.0, refits=True) == pytest.approx(30.0)  # the last fit
    assert left(300, 100.0, refits=False) == pytest.approx(300 * 0.15 + 30.0)


def test_it_goes_on_while_it_fits():
    now = [0.0]
    left = TimeLeft(lambda: now[0])
    left.gathered(100, 10.0)
    left.fit_begins()
    now[0] = 30.0
    left.fit_ends()
    left.fit_begins()
    now[0] = 42.0
    assert left(200, 100.0, refits=True) == pytest.approx(20.0 + 2 * 30.0 + 18.0)
    assert left(0, 100.0, refits=True) == pytest.approx(18.0)
    now[0] = 100.0
    assert left(0, 100.0, refits=True) == 0.0
