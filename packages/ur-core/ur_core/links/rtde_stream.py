"""Data stream of an RTDE connection after its start: bytes in, samples out, no sockets."""

from __future__ import annotations

import logging
import math
import struct
from collections.abc import Mapping, Sequence
from itertools import accumulate
from operator import itemgetter
from typing import Any, Final, NamedTuple

from ur_core.errors import ProtocolError
from ur_core.protocol.rtde import HEADER, DataType, FrameReader, Kind, Value

log = logging.getLogger(__name__)

TIMESTAMP: Final = "timestamp"
"""Variable of the controller's own time, s since it was started."""

_LARGEST_TEXT: Final = HEADER.size + 1 + 255 + 1 + 255 + 1  # two texts, whose lengths have one byte
_MOST_TEXTS: Final = 20  # logged messages, so that a controller cannot fill the log


class Sample(NamedTuple):
    """One data package.

    Attributes:
        values: Numbers, or tuples of them, by RTDE's names.
        arrival_s: Time of reading, on the clock of the reader.
    """

    values: Mapping[str, Value]
    arrival_s: float

    @property
    def timestamp_s(self) -> float:
        """Controller's own time, s."""
        time_s: Any = self.values[TIMESTAMP]
        return float(time_s)


class RtdeStream:
    """Decoder of the stream, which begins with the answer to the start, into samples with advancing time.

    Args:
        recipe: Number of the output recipe, from the controller.
        variables: Names and types in the order of the recipe; `timestamp` is one of them.
        start_s: Beginning of the stream, on the clock of the reader.
        where: Arm and address, for the log.

    Attributes:
        latest: Newest sample, or None.
        alive_s: Time at which the controller's time last advanced; before that, the start.
        count: Number of samples so far.
        started: True once the controller has answered the start.
        size: Bytes of a data package.
    """

    def __init__(self, recipe: int, variables: Sequence[tuple[str, DataType]], start_s: float, where: str = "") -> None:
        self.latest: Sample | None = None
        self._latest_s = -math.inf
        self.alive_s = start_s
        self.count = 0
        self.started = False
        self._recipe, self._where, self._texts = recipe, where, 0
        self._struct = struct.Struct(">" + "".join(f"{kind.count}{kind.code}" for _, kind in variables))
        self._names = [name for name, _ in variables]
        ends = accumulate(kind.count for _, kind in variables)
        places = [
            end - 1 if kind.count == 1 else slice(end - kind.count, end)
            for (_, kind), end in zip(variables, ends, strict=True)
        ]
        # With one place, `itemgetter` returns no tuple.
        self._pick = itemgetter(*places) if len(places) > 1 else lambda flat: (flat[places[0]],)
        self.size = HEADER.size + 1 + self._struct.size
        self._frames = FrameReader(max(self.size, _LARGEST_TEXT))

    def feed(self, data: bytes, arrival_s: float) -> list[Sample]:
        """Return the samples that `data` completes.

        Args:
            data: Bytes of the stream, cut anywhere.
            arrival_s: Time of reading.

        Raises:
            ProtocolError: A package is not of this recipe, or the controller's time went back. Samples before it
                count: the newest is `latest`.
        """
        samples = []
        for kind, payload in self._frames.feed(data):
            if kind == Kind.DATA_PACKAGE:
                samples.append(self._sample(payload, arrival_s))
            elif kind == Kind.TEXT_MESSAGE:
                self._log_text(payload)
            elif kind == Kind.START and payload == b"\1" and not self.started:
                self.started = True
            else:
                raise ProtocolError(f"RTDE package of kind {kind} with {payload[:8]!r}, which does not belong here")
        return samples

    def _sample(self, payload: bytes, arrival_s: float) -> Sample:
        if not payload or payload[0] != self._recipe or len(payload) != 1 + self._struct.size:
            number = payload[0] if payload else "no"
            raise ProtocolError(
                f"RTDE data package of recipe {number} with {len(payload)} bytes: expected are those of recipe "
                f"{self._recipe}, {1 + self._struct.size} bytes"
            )
        found: tuple[Value, ...] = self._pick(self._struct.unpack_from(payload, 1))
        sample = Sample(dict(zip(self._names, found, strict=True)), arrival_s)
        time_s, before_s = sample.timestamp_s, self._latest_s
        if not math.isfinite(time_s):
            raise ProtocolError(f"the controller's timestamp is {time_s}")
        if time_s > before_s:
            self.alive_s = arrival_s
        elif time_s < before_s:
            raise ProtocolError(
                f"the controller's timestamp went back from {before_s:.3f} to {time_s:.3f} s, as after a restart"
            )
        self.latest, self._latest_s = sample, time_s
        self.count += 1
        return sample

    def _log_text(self, payload: bytes) -> None:
        self._texts += 1
        if self._texts <= _MOST_TEXTS:
            text = payload[1 : 1 + payload[0]] if payload else b""
            log.warning("%s sent: %r", self._where, text.decode("utf-8", "replace"))
