"""What a busy machine spoils is tried again: emulated controllers and their clients run in real time."""

import threading
import time

import pytest

_TOLD = (
    "this machine is too busy",
    "no longer responds",
    "stood still",
    "stalled",
    "RTDE jitter",
    "RTDE rate",
    "round trip",
)
_PULSE_S = 0.01
_STILL_S = 0.03  # four control periods of a CB3, fifteen of an e-Series
_RERUNS = 7
_REST_S = 2.0  # what keeps the machine busy may be over then
_LONGER = 1.5  # each time


class _Pulse(threading.Thread):
    """Notices when this machine stands still: what is asked to wake up soon then wakes up late."""

    def __init__(self):
        super().__init__(name="pulse", daemon=True)
        self.misses = 0
        self.ended = threading.Event()

    def run(self):
        clock = time.monotonic  # tests put another in its place
        before = clock()
        while not self.ended.wait(_PULSE_S):
            now = clock()
            self.misses += now - before > _STILL_S
            before = now


class BusyMachine:
    """Plugin of pytest: where this machine was too busy, tests that bear `mark` are tried again, with new fixtures.

    It was, where it stood still meanwhile, where an error says so, or where a `tests.live.faults.lab.Lab` says that
    arms were stopped because of it. What fails for another reason fails at once. What was sent to an arm that must not
    be (`ViolationError`) is never tried again.
    """

    def __init__(self):
        self._pulse = _Pulse()

    @staticmethod
    def mark():
        """The marker."""
        return pytest.mark.flaky(
            reruns=_RERUNS,
            reruns_delay=_REST_S,
            reruns_delay_backoff_factor=_LONGER,
            condition=_is_spoiled,
            rerun_except=["^ViolationError"],
        )

    def pytest_sessionstart(self):
        """Begin to watch."""
        self._pulse.start()

    def pytest_sessionfinish(self, session):
        """End it."""
        self._pulse.ended.set()

    def _watched(self, item):
        """Note on what a test that may be tried again raises that the machine was busy, if it was."""
        if item.get_closest_marker("flaky") is None:
            return (yield)
        labs = _labs(item)  # those that there are: one that is made meanwhile has not been starved by that
        missed, starved = self._pulse.misses, [lab.busy() for lab in labs]
        try:
            return (yield)
        except Exception as error:
            time.sleep(2 * _PULSE_S)  # until it is noticed
            starved = [lab.busy() for lab in labs] != starved
            if self._pulse.misses > missed or starved or any(map(_is_told, _faults(labs))):
                error.add_note(_TOLD[0])
            raise

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_setup(self, item):
        """Watch while fixtures are made."""
        return (yield from self._watched(item))

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_call(self, item):
        """Watch while the test runs. Where it fails, what was not safe is told first."""
        try:
            return (yield from self._watched(item))
        except Exception:
            for lab in _labs(item):
                lab.audit()
            raise

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_teardown(self, item):
        """Watch while fixtures end."""
        return (yield from self._watched(item))


def _labs(item):
    return [each for each in (getattr(item, "funcargs", None) or {}).values() if hasattr(each, "busy")]


def _faults(labs):
    return [fault.text for fault in (lab.latch.read() for lab in labs) if fault is not None]


def _is_told(text):
    return any(word in text for word in _TOLD)


def _is_spoiled(error):
    return any(map(_is_told, [str(error), *getattr(error, "__notes__", ())]))
