"""Functions that compute in a child process, so that they hold no thread of this one back."""

from __future__ import annotations

import importlib
import threading
from collections.abc import Callable
from multiprocessing.connection import Connection, Pipe
from typing import Any, Final, Generic, TypeVar

from ur_core.errors import LinkError
from ur_core.processes.child_process import Child, shorten_slice

T = TypeVar("T")

_ORDINARY_SLICE_S: Final = 0.0


class RemoteFunction(Generic[T]):
    """Function of this package that computes in a child process, with the niceness of this one and longer time slices.

    The process starts with `prepare` or the first call, and again with the next one after it has ended. It ends with
    this process.
    Calls wait for their result, one after the other, without Python's global lock.

    Args:
        function: The function. Its arguments and its result are pickled.
        name: Text that a list of processes shows after the command.
    """

    def __init__(self, function: Callable[..., T], name: str) -> None:
        self.function, self._name = function, name
        self._lock = threading.Lock()
        self._process: Child | None = None
        self._connection: Connection | None = None

    def __call__(self, *arguments: Any) -> T:
        """Call the function.

        Raises:
            LinkError: The process ended before it answered.
        """
        with self._lock:
            try:
                connection = self._connection or self._start()
                connection.send(arguments)
                result: T = connection.recv()
            except (OSError, EOFError) as error:
                self._end()
                raise LinkError(f"{self._name}: the process ended before it answered") from error
        return result

    def prepare(self) -> None:
        """Start the process, so that the first call need not wait for that."""
        with self._lock:
            if self._connection is None:
                self._start()

    def _start(self) -> Connection:
        self._connection, theirs = Pipe()
        with theirs:
            number, function = theirs.fileno(), self.function
            where = function.__module__, function.__qualname__
            self._process = Child(_serve, number, *where, files=[number], name=self._name)
        return self._connection

    def _end(self) -> None:
        if self._process is not None:
            self._process.kill()
        if self._connection is not None:
            self._connection.close()
        self._process = self._connection = None

    def close(self) -> None:
        """End the process. A call that waits for it raises its error."""
        process = self._process
        if process is not None:
            process.kill()
        with self._lock:
            self._end()


def _serve(number: int, module: str, name: str) -> None:
    """Answer calls until the other end is closed."""
    shorten_slice(_ORDINARY_SLICE_S, inherited=True)  # those with deadlines interrupt it
    function = getattr(importlib.import_module(module), name)
    with Connection(number) as connection:
        while True:
            try:
                arguments = connection.recv()
            except (OSError, EOFError):
                return
            connection.send(function(*arguments))
