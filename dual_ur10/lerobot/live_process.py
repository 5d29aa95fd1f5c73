"""Process that steps an environment at its own rate, with the newest positions that another process commands."""

from __future__ import annotations

import contextlib
import pickle
import queue
import signal
import threading
import time
from collections.abc import Mapping, Sequence
from multiprocessing.connection import Connection
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from dual_ur10.envs.api.dual_arm_env import DualArmEnv
from dual_ur10.envs.core.ends import early_end
from dual_ur10.envs.core.options import MOVE_TO_START
from dual_ur10.errors import ClosedError
from dual_ur10.lerobot.positions import Positions
from dual_ur10.policies.learned.signature import view_of_env
from ur_core.processes.shared_memory import SharedBlock
from ur_core.processes.system import LOCAL
from ur_core.types import Array, Single

Shapes = Mapping[str, tuple[int, ...]]

_TARGET, _OBSERVED = 0, 1  # versions, which are odd while what they count is written
_TRIES: Final = 1000
_POLL_S: Final = 0.05


class Exchange:
    """Memory that the program and the process share: what is commanded, and what is observed. Nobody waits in it.

    Args:
        shapes: Shapes of "target", "observation" and "images".
        name: Name of memory that exists; None: new memory.

    Attributes:
        name: Name under which the other process finds it.
    """

    def __init__(self, shapes: Shapes, name: str | None = None) -> None:
        types: dict[str, type[np.generic]] = {"target": np.float32, "observation": np.float64, "images": np.uint8}
        layout = {key: (types[key], shape) for key, shape in shapes.items()}
        self._block = SharedBlock({"versions": (np.int64, (2,)), **layout}, name)
        self._versions, self.name = self._block.counters("versions"), self._block.name

    def _write(self, number: int, values: Mapping[str, NDArray[Any]]) -> None:
        odd = self._versions[number] | 1  # it is odd already after a write that Ctrl-C interrupted
        self._versions[number] = odd
        for key, each in values.items():
            self._block[key][...] = each
        self._versions[number] = odd + 1

    def _read(self, number: int, *keys: str) -> list[NDArray[Any]] | None:
        """Return copies of arrays that belong together; None: they are being written."""
        before = self._versions[number]
        found = [self._block[key].copy() for key in keys]
        return None if before % 2 or self._versions[number] != before else found

    def command(self, target: Single) -> None:
        """Write what is commanded."""
        self._write(_TARGET, {"target": target})

    def commanded(self, before: Single) -> Single:
        """Return what is commanded; `before`, if nothing is yet, or while it is written."""
        found = self._read(_TARGET, "target") if self._versions[_TARGET] else None
        return before if found is None else found[0]

    def show(self, observation: Array, images: Sequence[NDArray[np.uint8]]) -> None:
        """Write what is observed."""
        values: dict[str, NDArray[Any]] = {"observation": observation}
        self._write(_OBSERVED, {**values, "images": np.stack(images)} if images else values)

    def observed(self) -> tuple[Array, list[NDArray[np.uint8]]]:
        """Return what was observed last.

        Raises:
            ClosedError: Its writer ended while it wrote.
        """
        for _ in range(_TRIES):
            found = self._read(_OBSERVED, "observation", "images")
            if found is not None:
                return found[0], list(found[1])
            time.sleep(1e-4)
        raise ClosedError("the process that moves the arms ended in mid-step: start them again")

    def close(self) -> None:
        """Release the memory."""
        self._block.close()


class _Program:
    """The program at the other end of a connection, whose end interrupts the main thread.

    Args:
        connection: The connection, which gets answers, and None once the arms are needed no more.
        parent: Process id of the program.

    Attributes:
        ended: Set once the program has ended, or needs the arms no more.
    """

    def __init__(self, connection: Connection, parent: int) -> None:
        self._connection, self._parent = connection, parent
        self._answers: queue.SimpleQueue[bool] = queue.SimpleQueue()
        self.ended = threading.Event()
        threading.Thread(target=self._watch, name="program", daemon=True).start()

    def _watch(self) -> None:
        try:
            # Forked workers of the program keep the other end open.
            while not LOCAL.is_orphan(self._parent):
                if self._connection.poll(_POLL_S):
                    answer = self._connection.recv()
                    if answer is None:
                        break
                    self._answers.put(bool(answer))
        except (EOFError, OSError):
            pass
        finally:
            self.ended.set()
            # To that thread, so that its sleep ends, too.
            signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)

    def confirm(self, text: str) -> bool:
        """Ask a person, whom only the program can reach."""
        self._connection.send(("confirm", text))
        return self._answers.get()


def run(
    number: int,
    name: str,
    shapes: Shapes,
    env_id: str,
    keywords: Mapping[str, Any],
    cameras: Sequence[str],
    parent: int,
) -> None:
    """Step an environment until the program ends, or needs the arms no more; both arms then stop on their path.

    Args:
        number: Open file of the connection, which gets ("ready", None), ("confirm", question) or ("error", error).
        name: Name of the `Exchange`.
        shapes: Its shapes.
        env_id: Id of the environment.
        keywords: Its keywords.
        cameras: Cameras whose images are observed.
        parent: Process id of the program.
    """
    signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored, if the program runs in the background
    with Connection(number) as connection:
        env: DualArmEnv | None = None
        program = _Program(connection, parent)
        try:
            env = DualArmEnv(env_id, **{"confirm": program.confirm, **keywords})
            _step(env, Exchange(shapes, name), connection, program, cameras)
        except (KeyboardInterrupt, BrokenPipeError):  # the program has ended, or needs the arms no more
            pass
        except BaseException as error:
            LOCAL.ignore_interrupts()  # of a program that knows the error, and so needs the arms no more
            _report(connection, error)
        finally:
            with contextlib.suppress(KeyboardInterrupt):
                LOCAL.ignore_interrupts()  # nothing cuts the stop of both arms short
            if env is not None:
                env.close()


def _step(
    env: DualArmEnv, exchange: Exchange, connection: Connection, program: _Program, cameras: Sequence[str]
) -> None:
    core = env.core
    positions, period_s = Positions(view_of_env(env)), core.timing.period_s

    def show(observation: Any) -> Array:
        state: Array = observation["state"] if cameras else observation
        exchange.show(state, [observation["pixels"][each] for each in cameras])
        return state

    observation, _ = env.reset(seed=0, options={MOVE_TO_START: True})
    LOCAL.ignore_interrupts()  # from here on, each step looks for the end
    action: Any = positions.action(positions.state(show(observation)[None])[0])
    if positions.stroke_m is not None:
        action[6::7] = 1.0  # as commanded: measured widths would creep
    connection.send(("ready", None))
    due = time.monotonic()
    while not program.ended.is_set():
        if not core.setup.keeps_time:
            due = max(due + period_s, time.monotonic())
            time.sleep(max(0.0, due - time.monotonic()))
        action = exchange.commanded(action)
        observation, _, terminated, truncated, info = env.step(action)
        show(observation)
        if terminated or truncated:
            raise ClosedError(f"the motion of both arms has ended: {early_end(info) or 'its time is over'}")
    core.finish()


def _report(connection: Connection, error: BaseException) -> None:
    """Send an error, or its text if it cannot be sent."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        error = ClosedError(f"{type(error).__name__}: {error}")
    with contextlib.suppress(OSError):
        connection.send(("error", error))
