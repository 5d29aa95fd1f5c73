"""Second program on a cell: row 58 of docs/reference/faults.md."""

import os
import subprocess
import sys

import pytest

pytestmark = pytest.mark.streams


def test_58_a_second_program_is_refused_and_the_first_continues(lab):
    lab.begin(steps=3)
    lab.env.unwrapped.core.cell.finish()  # between two episodes the policy has no deadline
    arguments = ["-m", "dual_ur10", "rollout", "SineTracking", "-n", "1", "--cell", str(lab.path)]
    process = subprocess.run([sys.executable, *arguments], capture_output=True, text=True, timeout=120)
    assert process.returncode == 2
    assert f"is moved by another program (process {os.getpid()})" in " ".join(process.stderr.split())
    lab.reset(seed=0)
    lab.env.step(lab.policy())
    assert lab.latch.read() is None
