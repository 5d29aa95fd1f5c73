"""Inference beside the control loop: a chunk policy that is asked in a thread, or in a child process."""

from __future__ import annotations

import contextlib
import pickle
import queue
import threading
import weakref
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection, Pipe
from typing import Any, NamedTuple, Protocol

import numpy as np

from dual_ur10.errors import ChunkError
from dual_ur10.policies.chunks.chunk_path import ChunkPath, Splicer
from dual_ur10.policies.chunks.chunk_policy import ChunkPolicy, check_mode, checked_chunk
from dual_ur10.policies.policy import close_policy
from ur_core.processes.child_process import Child, shorten_slice
from ur_core.types import Array


class ChunkPlan(NamedTuple):
    """Chunk as it is executed.

    Attributes:
        path: Path through its joint positions, which ends at rest.
        dt_s: Time between two of its actions.
        openings: (H, 2) openings of the grippers; None: there are none.
    """

    path: ChunkPath
    dt_s: float
    openings: Array | None


class ChunkPlanner:
    """Maker of plans, which works beside the control loop.

    Args:
        splicer: Of the limits of motion.
        grippers: An action has an opening for each gripper.
        name: Name of the chunk policy, for messages.
    """

    def __init__(self, splicer: Splicer, grippers: bool, name: str) -> None:
        self._splicer, self._size, self._name = splicer, 7 if grippers else 6, name

    def __call__(self, source: ChunkPolicy, observation: Any, time_s: float, commanded: Array) -> ChunkPlan:
        """Ask a chunk policy, and return the plan.

        Args:
            source: The chunk policy.
            observation: Observation of one cell.
            time_s: Time of the observation.
            commanded: (12,) joint positions commanded then.

        Raises:
            ChunkError: It returned something else than a chunk.
            Exception: As raised by the chunk policy.
        """
        chunk = source.chunk(observation, time_s)
        dt_s, mode = source.dt_s, source.action_mode
        check_mode(mode, self._name)
        rows = checked_chunk(chunk, dt_s, self._size, self._name)
        dt_s = float(dt_s)  # sums with numbers of lower precision would be of that, too
        actions = rows[..., :6].reshape(-1, 12)
        if mode == "joint_position":
            path = ChunkPath(time_s + dt_s, dt_s, actions)
        else:
            steps = np.clip(actions, -1.0, 1.0) * (self._splicer.speed_rad_s * dt_s)
            path = ChunkPath(time_s, dt_s, commanded + np.cumsum(np.vstack([np.zeros(12), steps]), axis=0))
        self._splicer.end(path)
        return ChunkPlan(path, dt_s, rows[..., 6] if self._size == 7 else None)


@dataclass
class ChunkAnswer:
    """Chunk, or error, of a request. Whoever asks fills it, and sets `done` last.

    Attributes:
        time_s: Time of its observation.
        commanded: (12,) joint positions commanded at that time.
        ready_s: Time from which on the answer counts.
        plan: Made of the returned chunk.
        error: Raised by the chunk policy, or by a look at what it returned.
        done: The chunk policy has returned.
    """

    time_s: float
    commanded: Array
    ready_s: float = 0.0
    plan: ChunkPlan | None = None
    error: Exception | None = None
    done: bool = False


def fill(answer: ChunkAnswer, source: ChunkPolicy, observation: Any, planner: ChunkPlanner) -> None:
    """Ask a chunk policy."""
    try:
        answer.plan = planner(source, observation, answer.time_s, answer.commanded)
    except Exception as error:
        answer.error = error
    answer.done = True


class Inference(Protocol):
    """Chunk policy that is asked beside the control loop."""

    def ask(self, answer: ChunkAnswer, observation: Any) -> None:
        """Ask for a chunk, without waiting for it."""

    def reset(self) -> None:
        """Reset the chunk policy before anything that is asked from now on."""

    def poll(self) -> None:
        """Fill the answers that have arrived."""

    def close(self) -> None:
        """End. May be called twice."""


class ThreadInference:
    """Chunk policy that a thread asks.

    Args:
        source: The chunk policy.
        planner: Maker of plans.
    """

    def __init__(self, source: ChunkPolicy, planner: ChunkPlanner) -> None:
        self._planner = planner
        self._tasks: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        thread = threading.Thread(target=self._work, args=(self._tasks,), name="chunks", daemon=True)
        thread.start()
        self._source, self.close = source, weakref.finalize(self, self._tasks.put, None)

    @staticmethod
    def _work(tasks: queue.SimpleQueue[Callable[[], None] | None]) -> None:
        shorten_slice(inherited=False)  # while it holds Python's global lock, the control loop waits for it
        while (task := tasks.get()) is not None:
            task()
            del task  # or this thread would keep its inference from being collected

    def ask(self, answer: ChunkAnswer, observation: Any) -> None:
        """See `Inference`."""
        source, planner = self._source, self._planner
        self._tasks.put(lambda: fill(answer, source, observation, planner))

    def reset(self) -> None:
        """See `Inference`."""
        source = self._source

        def run() -> None:
            with contextlib.suppress(Exception):  # the next chunk shows what is wrong
                source.reset()

        self._tasks.put(run)

    def poll(self) -> None:
        """Do nothing: the thread fills its answers."""


class ChildInference:
    """Chunk policy that a child process asks, so that nothing of it holds the control loop's process up.

    Args:
        source: The chunk policy. It is pickled, and closed in this process.
        planner: Maker of plans.
    """

    def __init__(self, source: ChunkPolicy, planner: ChunkPlanner) -> None:
        close_policy(source)  # its server may take one client only
        self._connection, theirs = Pipe()
        # A request is sent once the child waits for it: images fill the pipe, and the control loop would wait, too.
        self._waiting: deque[tuple[ChunkAnswer, Any]] = deque()
        self._asked: ChunkAnswer | None = ChunkAnswer(0.0, np.zeros(12))  # the child begins with an answer
        self._begins = False
        with theirs:
            self._child = Child(_answer, theirs.fileno(), source, planner, files=[theirs.fileno()], name="chunks")

    def ask(self, answer: ChunkAnswer, observation: Any) -> None:
        """See `Inference`."""
        self._waiting.append((answer, (self._begins, observation, answer.time_s, answer.commanded)))
        self._begins = False
        self.poll()

    def reset(self) -> None:
        """See `Inference`."""
        self._waiting.clear()  # of an episode that has ended
        self._begins = True

    def poll(self) -> None:
        """See `Inference`."""
        try:
            if self._asked is not None and self._connection.poll():
                self._asked.plan, self._asked.error = self._connection.recv()
                self._asked.done, self._asked = True, None
            if self._asked is None and self._waiting:
                self._asked, request = self._waiting.popleft()
                self._connection.send(request)
        except (OSError, EOFError):
            self._lose()

    def _lose(self) -> None:
        """Let all requests fail, since the process is gone."""
        lost = [answer for answer, _ in self._waiting] + ([] if self._asked is None else [self._asked])
        self._waiting.clear()
        for answer in lost:
            answer.error = ChunkError("the process that asks the chunk policy has ended: see what it printed")
            answer.done = True

    def close(self) -> None:
        """See `Inference`."""
        self._connection.close()
        self._child.kill()


def _answer(number: int, source: ChunkPolicy, planner: ChunkPlanner) -> None:
    """ChunkAnswer requests of `ChildInference` until its end is closed."""
    with Connection(number) as connection, contextlib.suppress(OSError, EOFError):
        connection.send((None, None))
        while True:
            begins, observation, time_s, commanded = connection.recv()
            if begins:
                with contextlib.suppress(Exception):  # the next chunk shows what is wrong
                    source.reset()
            answer = ChunkAnswer(time_s, commanded)
            fill(answer, source, observation, planner)
            connection.send((answer.plan, _portable(answer.error)))


def _portable(error: Exception | None) -> Exception | None:
    """Return an error, or another one with its text if it cannot be sent."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return ChunkError(f"{type(error).__name__}: {error}")
    return error
