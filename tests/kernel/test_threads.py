"""Threads of kernel and physics: shared by callers, and begun anew in a forked process."""

from __future__ import annotations

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from ur_core.kernel import RowLoop, Struct

N, CALLS = 400, 300

_FORKED = """
import os, psutil, signal, sys
import numpy as np
from dual_ur10.envs.api.vector_env import DualArmVectorEnv
from ur_core.errors import ClosedError
from tests.kernel.test_threads import Distances

def begun(threads):
    env = DualArmVectorEnv(8, "Free", threads=threads)
    env.reset(seed=0)
    return env

def moved(env):
    return env.step(np.full(env.action_space.shape, 0.5, np.float32))[0]

def refused(act):
    try:
        act()
    except ClosedError as error:
        return "3 threads in the process" in str(error)

before, after, env, single = Distances(3), Distances(3), begun(3), begun(1)
before()
moved(env)
child = os.fork()
if child == 0:
    signal.alarm(30)
    after()
    threads = psutil.Process().num_threads()
    held = refused(lambda: moved(env)) and refused(lambda: env.reset(seed=1))
    same = (moved(begun(3)) == moved(single)).all()
    del env
    sys.exit(threads if after.is_right() and held and same else 99)
after()
print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), before.is_right(), after.is_right(), len(moved(env)))
"""


class Distances:
    """A kernel function of N rows, each of which computes a distance of its own."""

    def __init__(self, threads: int) -> None:
        self.found = np.zeros(N)
        frames, others = np.zeros((N, 12)), np.zeros((N, 12))
        frames[:, 3::4] = others[:, 3::4] = 1.0
        frames[:, 0] = np.arange(N)
        counts = {"n": N, "frame_count": 1, "pairs": 1, "of": np.zeros(1, dtype=np.int64)}
        results = {"moved_m": self.found, "chord": np.zeros(N), "axis_rad": np.zeros(N)}
        struct = Struct("FrameDistances", **counts, frames=frames, others=others, **results)
        self._compute = RowLoop("frame_distances", struct, N, threads)

    def __call__(self) -> None:
        """Compute all rows."""
        self.found[:] = -1.0
        self._compute()

    def is_right(self) -> bool:
        """Return True if every row was computed."""
        return bool((self.found == np.arange(N)).all())


def _called(threads: int) -> int:
    right, distances = 0, Distances(threads)
    for _ in range(CALLS):
        distances()
        right += distances.is_right()
    return right


def test_every_row_is_computed_by_the_end_of_a_call() -> None:
    assert [_called(threads) for threads in (1, 2, 3, 8)] == [CALLS] * 4


def test_several_callers_share_the_threads() -> None:
    with ThreadPoolExecutor(4) as callers:
        assert list(callers.map(_called, [1, 2, 3, 4])) == [CALLS] * 4


def test_a_forked_process_has_threads_of_its_own_and_refuses_those_of_others() -> None:
    command = [sys.executable, "-W", "ignore", "-c", _FORKED]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.split() == ["3", "True", "True", "8"]
