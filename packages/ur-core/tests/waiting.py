"""Waiting for a condition in tests of threads and processes."""

from ur_core.processes.system import LOCAL


def until(condition, within_s=10.0, clock=LOCAL.clock):
    """Return the first true value of a condition.

    Raises:
        AssertionError: It did not become true within the time.
    """
    end = clock.now_s() + within_s
    while not (found := condition()):
        assert clock.now_s() < end, f"not true within {within_s:g} s"
        clock.sleep(0.005)
    return found
