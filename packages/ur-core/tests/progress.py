"""Progress of a run of tests, and the time left."""

import sys
import time

import pytest

_PARTS = 10  # lines
_LEAST_S = 2.0  # between two of them
_MOST_S = 20.0


class Progress:
    """Plugin of pytest that writes a line now and then: tests so far, and the time left at the present rate."""

    def __init__(self, write=None, clock=time.monotonic):
        self._write = write or (lambda text: print(f" {text}", file=sys.__stderr__, flush=True))
        self._clock = clock
        self._all = self._done = self._parts = 0
        self._begin_s = self._told_s = clock()

    def _begin(self, count):
        self._all, self._begin_s = count, self._clock()
        self._told_s = self._begin_s

    def pytest_collection_finish(self, session):
        """Count the tests."""
        self._begin(len(session.items))

    @pytest.hookimpl(optionalhook=True)
    def pytest_xdist_node_collection_finished(self, node, ids):
        """Count those of the workers, each of which finds all."""
        self._begin(len(ids))

    def pytest_runtest_logfinish(self, nodeid, location):
        """Note that a test has ended."""
        self._done += 1
        now = self._clock()
        quiet_s, part = now - self._told_s, _PARTS * self._done // max(self._all, 1)
        if self._done < self._all and ((part > self._parts and quiet_s > _LEAST_S) or quiet_s > _MOST_S):
            self._told_s, self._parts = now, part
            left_s = int((now - self._begin_s) * (self._all - self._done) / self._done)
            self._write(f"{self._done} of {self._all} tests, about {left_s // 60}:{left_s % 60:02d} left")
