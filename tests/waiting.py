"""Waiting for a condition in tests of threads and processes."""

import time


def until(condition, within_s=10.0):
    """Return the first true value of a condition.

    Raises:
        AssertionError: It did not become true within the time.
    """
    end = time.monotonic() + within_s
    while not (found := condition()):
        assert time.monotonic() < end, f"not true within {within_s:g} s"
        time.sleep(0.005)
    return found
