"""Memory shared by a program that moves arms and the process of its live page.

Each number has one writer. A row, a text or a set of handles is complete before the counter that announces it, and
stays whole until the ring comes round to it, so that nobody waits for a reader.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from dual_ur10.envs.rendering.live.buttons import BUTTONS
from dual_ur10.errors import LinkError
from ur_core.processes.shared_memory import Layout, SharedBlock
from ur_core.types import Array, Mask

COMMANDERS: Final = ("policy", "operator", "nobody")
"""Who leads an arm, by the number in a row."""

STALE_S: Final = 0.25
"""Age of the page's last sign of life from which on its clutch counts as released."""

RING: Final = 512
"""Rows kept: 20 s at 25 Hz."""

_SLOTS: Final = 8
_PRESSES: Final = 64
_TEXT: Final = 32_768
_LONGEST: Final = 400  # characters of a line
_TRIES: Final = 1000
_ROWS, _WORDS, _HANDLES, _PRESSED, _BEAT, _READY, _CLOSING, _PAGES, _ATTACHED, _STOPS = range(10)
_HANDLE_SIZE: Final = 2 * 7 + 2 + 2 + 1

SCALARS: Final = (
    "at_s",
    "time_s",
    "episode",
    "step",
    "late_s",
    "gated",
    "spare_m",
    "scaling",
    "reward",
    "success",
    "left_width_m",
    "right_width_m",
    "left_commander",
    "right_commander",
)
"""Names of the first numbers of a row. `at_s` is on the system's clock, `time_s` in task time."""

_Q: Final = len(SCALARS)
_COMMANDED: Final = _Q + 12
_SCENE: Final = _COMMANDED + 12


class Row(NamedTuple):
    """State of both arms after a step.

    Attributes:
        scalars: Numbers by the names in `SCALARS`; NaN: unknown.
        q_rad: (2, 6) measured joint positions.
        commanded_rad: (2, 6) joint positions commanded last.
        qpos: (nq,) positions of MuJoCo's model of the cell.
        mocap: (nmocap, 7) poses of its props that somebody else places: position, quaternion (w, x, y, z).
    """

    scalars: Mapping[str, float]
    q_rad: Array
    commanded_rad: Array
    qpos: Array
    mocap: Array


class Handles(NamedTuple):
    """Drag handles of the page.

    Attributes:
        poses: (2, 7) wanted poses of the tool centre points in the cell frame: position (m), quaternion (w, x, y, z).
        clutch: (2,) True while a person drags the handle.
        gripper: (2,) 0 closed to 1 open; NaN: as it is.
        at_s: Time of the last change on the system's clock.
    """

    poses: Array
    clutch: Mask
    gripper: Array
    at_s: float


NO_HANDLES: Final = Handles(np.zeros((2, 7)), np.zeros(2, dtype=bool), np.full(2, np.nan), 0.0)
"""Handles that nobody drags."""


class LiveMemory:
    """Memory of one page.

    Args:
        nq: Number of positions of MuJoCo's model of the cell.
        nmocap: Number of its props that somebody else places.
        name: Name of existing memory; None: create it.

    Attributes:
        name: Name by which another process opens it.
    """

    def __init__(self, nq: int, nmocap: int, name: str | None = None) -> None:
        self._nq, self._nmocap = nq, nmocap
        self._width = _SCENE + nq + 7 * nmocap
        layout: Layout = {
            "ints": (np.int64, (16,)),
            "beat": (np.float64, (1,)),
            "rows": (np.float64, (RING, self._width)),
            "handles": (np.float64, (_SLOTS, _HANDLE_SIZE)),
            "presses": (np.int64, (_PRESSES,)),
            "page": (np.uint8, (_TEXT,)),
            "attached": (np.uint8, (_TEXT,)),
            **{f"words {slot}": (np.uint8, (_TEXT,)) for slot in range(_SLOTS)},
        }
        self._block = SharedBlock(layout, name)
        self.name = self._block.name
        self._view()
        self._said = ""

    def _view(self) -> None:
        self._ints = self._block.counters("ints")
        self._beat: Array = self._block["beat"]
        self._rows: Array = self._block["rows"]
        self._handles: Array = self._block["handles"]
        self._presses = self._block["presses"]

    # Written by the program.

    def put(self, scalars: Mapping[str, float], q_rad: Array, commanded_rad: Array, qpos: Array, mocap: Array) -> None:
        """Write a row; see `Row`. Scalars without a value are NaN."""
        count = self._ints[_ROWS]
        row = self._rows[count % RING]
        row[:_Q] = [scalars.get(name, np.nan) for name in SCALARS]
        row[_Q:_COMMANDED] = q_rad.reshape(12)
        row[_COMMANDED:_SCENE] = commanded_rad.reshape(12)
        row[_SCENE : _SCENE + self._nq] = qpos
        row[_SCENE + self._nq :] = mocap.reshape(-1)
        self._ints[_ROWS] = count + 1

    def say(self, words: Mapping[str, str]) -> None:
        """Write the state in words, by the names of the page's lines, if it has changed."""
        text = json.dumps({name: line[:_LONGEST] for name, line in words.items()}, ensure_ascii=False)
        if text == self._said:
            return
        count = self._ints[_WORDS]
        self._block.set_text(f"words {count % _SLOTS}", text)
        self._ints[_WORDS] = count + 1
        self._said = text

    def attach(self, view: Sequence[str]) -> None:
        """Name the view of arms of controllers, and what it is made of, once they are connected; see `ArmsView`."""
        self._block.set_text("attached", json.dumps(list(view)))
        self._ints[_ATTACHED] = 1

    def end(self) -> None:
        """Ask the process of the page to end."""
        self._ints[_CLOSING] = 1

    # Written by the process of the page.

    def enter_ready(self, answer: Mapping[str, Any]) -> None:
        """Answer the program, once: with `url`, or with `error`."""
        self._block.set_text("page", json.dumps(dict(answer)))
        self._ints[_READY] = 1

    def put_handles(self, handles: Handles) -> None:
        """Write the handles."""
        count = self._ints[_HANDLES]
        row = self._handles[count % _SLOTS]
        row[:14], row[14:16], row[16:18] = handles.poses.reshape(14), handles.clutch, handles.gripper
        row[18] = handles.at_s
        self._ints[_HANDLES] = count + 1

    def press(self, button: str) -> None:
        """Write a press of a button. Those of "stop" are counted apart: no later press overwrites one."""
        if button == "stop":
            self._ints[_STOPS] += 1
            return
        count = self._ints[_PRESSED]
        self._presses[count % _PRESSES] = BUTTONS.index(button)
        self._ints[_PRESSED] = count + 1

    def beat(self, now_s: float) -> None:
        """Record a sign of life of the page."""
        self._beat[0] = now_s
        self._ints[_BEAT] += 1

    def note_pages(self, count: int) -> None:
        """Record the number of open pages."""
        self._ints[_PAGES] = count

    # Read by both.

    @property
    def count(self) -> int:
        """Number of rows written."""
        return self._ints[_ROWS]

    def rows(self, since: int = 0) -> tuple[list[Row], int]:
        """Return the whole rows from number `since` on, as far as they are kept, and the next number."""
        count = self._ints[_ROWS]
        first = max(since, count - RING // 2, 0)
        found = self._rows[np.arange(first, count) % RING]
        torn = max(0, self._ints[_ROWS] - RING + 1 - first)  # overwritten meanwhile: the reader has stalled
        return [self._row(each) for each in found[torn:]], count

    def _row(self, row: Array) -> Row:
        return Row(
            dict(zip(SCALARS, row[:_Q].tolist(), strict=True)),
            row[_Q:_COMMANDED].reshape(2, 6),
            row[_COMMANDED:_SCENE].reshape(2, 6),
            row[_SCENE : _SCENE + self._nq],
            row[_SCENE + self._nq :].reshape(-1, 7),
        )

    @property
    def words(self) -> dict[str, str]:
        """State in words; empty: nothing was said yet.

        Raises:
            LinkError: It is written faster than it can be read.
        """
        for _ in range(_TRIES):
            count = self._ints[_WORDS]
            if not count:
                return {}
            text = self._block.text(f"words {(count - 1) % _SLOTS}")
            if self._ints[_WORDS] - count < _SLOTS - 1:
                found: dict[str, str] = json.loads(text)
                return found
        raise LinkError("the words of a live page are written faster than they can be read: check what writes them")

    def handles(self, now_s: float) -> Handles:
        """Return the handles; nobody drags them once the page shows no sign of life.

        Raises:
            LinkError: They are written faster than they can be read.
        """
        if not self._ints[_BEAT] or now_s - self._beat[0] > STALE_S:
            return NO_HANDLES
        for _ in range(_TRIES):
            count = self._ints[_HANDLES]
            if not count:
                return NO_HANDLES
            row = self._handles[(count - 1) % _SLOTS].copy()
            if self._ints[_HANDLES] - count < _SLOTS - 1:
                return Handles(row[:14].reshape(2, 7), row[14:16] > 0.5, row[16:18], float(row[18]))
        raise LinkError("the handles of a live page are written faster than they can be read: check what writes them")

    @property
    def stops(self) -> int:
        """Number of presses of "stop"."""
        return self._ints[_STOPS]

    def pressed(self, since: int) -> tuple[list[str], int]:
        """Return the names of the other buttons pressed from number `since` on, and the next number."""
        count = self._ints[_PRESSED]
        first = max(since, count - _PRESSES + 1)
        return [BUTTONS[self._presses[number % _PRESSES]] for number in range(first, count)], count

    @property
    def answer(self) -> dict[str, Any]:
        """Answer of the page's process; empty: none yet."""
        if not self._ints[_READY]:
            return {}
        found: dict[str, Any] = json.loads(self._block.text("page"))
        return found

    @property
    def attached(self) -> tuple[str, ...]:
        """View of the arms, as `attach` was given it; empty: none yet."""
        return tuple(json.loads(self._block.text("attached"))) if self._ints[_ATTACHED] else ()

    @property
    def beat_s(self) -> float:
        """Time of the page's last sign of life; 0: none yet."""
        return float(self._beat[0])

    @property
    def pages(self) -> int:
        """Number of open pages."""
        return self._ints[_PAGES]

    @property
    def ending(self) -> bool:
        """True once the program asked the page to end."""
        return bool(self._ints[_CLOSING])

    def close(self) -> None:
        """Release the memory. May be called twice."""
        self._block.close()
        self._view()
