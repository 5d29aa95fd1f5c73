"""Deferral of interrupts around critical sections."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading

import pytest

from ur_core.processes.interrupts import interrupts_deferred


def test_an_interrupt_comes_after_the_block():
    done = []
    with pytest.raises(KeyboardInterrupt):  # noqa: PT012  # the order is what is tested
        with interrupts_deferred():
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGINT)
            done.append("whole")
        done.append("behind")
    assert done == ["whole"]
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)


def test_nested_blocks_defer_to_the_end_of_the_outer_one():
    done = []
    with pytest.raises(KeyboardInterrupt), interrupts_deferred():  # noqa: PT012
        with interrupts_deferred():
            signal.raise_signal(signal.SIGINT)
        done.append("whole")
    assert done == ["whole"]


def test_an_error_passes_and_restores_the_handler():
    with pytest.raises(ValueError, match="inside"), interrupts_deferred():
        raise ValueError("inside")
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_in_another_thread_it_does_nothing():
    found = []

    def work():
        with interrupts_deferred():
            found.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert found == [signal.default_int_handler]


def test_the_default_action_of_a_signal_is_kept():
    program = (
        "import signal\nfrom ur_core.processes.interrupts import interrupts_deferred\n"
        "signal.signal(signal.SIGINT, signal.SIG_DFL)\n"
        "with interrupts_deferred():\n    signal.raise_signal(signal.SIGINT)\n    print('whole', flush=True)\n"
        "print('behind')\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout) == (-signal.SIGINT, "whole\n")
