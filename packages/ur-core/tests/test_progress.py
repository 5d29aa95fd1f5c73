"""Line of progress."""

import types

from tests.progress import Progress


def run(count, each_s, workers=False):
    lines, now = [], [100.0]
    progress = Progress(lines.append, lambda: now[0])
    if workers:
        progress.pytest_collection_finish(types.SimpleNamespace(items=[]))
        progress.pytest_xdist_node_collection_finished(None, range(count))
    else:
        progress.pytest_collection_finish(types.SimpleNamespace(items=range(count)))
    for _ in range(count):
        now[0] += each_s
        progress.pytest_runtest_logfinish("", None)
    return lines


def test_the_time_left_is_that_at_the_present_rate():
    lines = run(100, 1.0)
    assert lines[0] == "10 of 100 tests, about 1:30 left"
    assert lines[-1] == "90 of 100 tests, about 0:10 left"
    assert len(lines) == 9
    assert run(100, 1.0, workers=True) == lines


def test_quick_tests_are_not_interrupted():
    assert run(1000, 0.001) == []


def test_slow_ones_are():
    assert len(run(5, 60.0)) == 4
