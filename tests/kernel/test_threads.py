"""Threads of the kernel: shared by callers, and begun anew in a forked process."""

from __future__ import annotations

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from dual_ur10.envs.tasks.tool_goals import approach
from dual_ur10.kernel import RowLoop, Struct

N, CALLS = 400, 300

_FORKED = """
import os, psutil
from tests.kernel.test_threads import Stages
before, after = Stages(3), Stages(3)
before()
child = os.fork()
after()
if child == 0:
    os._exit(psutil.Process().num_threads() if after.is_right() else 0)
print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), before.is_right(), after.is_right())
"""


class Stages:
    """A kernel function of N rows, each of which counts its calls: stages are passed in their order."""

    def __init__(self, threads: int) -> None:
        self.stage = np.zeros(N, dtype=np.int64)
        facts, terms = np.zeros((N, 13)), np.zeros((N, 14))
        self.conditions = np.zeros((N, 7))
        sizes = {"lifted_m": 0.08, "meeting_m": 0.1, "approach": approach(0.04)}
        arrays = {"facts": facts, "conditions": self.conditions, "stage": self.stage, "terms": terms}
        self._advance = RowLoop("stages_advance", Struct("Stages", n=N, **sizes, **arrays), N, threads)

    def __call__(self) -> None:
        """Let every row pass the stages below a number of its own."""
        self.conditions[:] = np.arange(7) < (np.arange(N) % 8)[:, None]
        self._advance()

    def is_right(self) -> bool:
        """Return True if every row was computed."""
        return bool((self.stage == np.arange(N) % 8).all())


def _called(threads: int) -> int:
    right, stages = 0, Stages(threads)
    for _ in range(CALLS):
        stages.stage[:] = 0
        stages()
        right += stages.is_right()
    return right


def test_every_row_is_computed_by_the_end_of_a_call() -> None:
    assert [_called(threads) for threads in (1, 2, 3, 8)] == [CALLS] * 4


def test_several_callers_share_the_threads() -> None:
    with ThreadPoolExecutor(4) as callers:
        assert list(callers.map(_called, [1, 2, 3, 4])) == [CALLS] * 4


def test_a_forked_process_has_threads_of_its_own() -> None:
    command = [sys.executable, "-W", "ignore", "-c", _FORKED]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.split() == ["3", "True", "True"]
