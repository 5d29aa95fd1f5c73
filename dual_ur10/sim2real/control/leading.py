"""Motion that the safety gate would refuse, led along what is in its way before the gate sees it.

The brake is always possible, so the targets of a period are the brake plus a difference. What the gate looks at is
where the brake after these targets ends. Each pair that would come too close there is a wall: the slopes of its
distance say which part of the difference leads into it. That part is removed, and the rest is scaled to the limits of
motion. The gate is asked about the result. If it would still refuse, the walls are measured again there, a few times;
then the difference is halved, a few times; and last the arms brake. What would be refused even then reaches the gate
as it was planned.

An arm gives way in proportion to its own motion, so that one that rests is never moved. Arms that hold one object
between them keep the direction of their motion, and with it their relative pose: they only slow down.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from dual_ur10.sim2real.control.adapter import ServojAdapter
from dual_ur10.sim2real.control.gate import SafetyGate
from ur_core.kernel import RowLoop, Struct
from ur_core.types import Mask

MARGIN_M: Final = 0.0005
"""Distance above the smallest legal one that led motion keeps where it ends: a wall is curved, and its slope is not."""


class Leading:
    """Leads the targets that an adapter has planned.

    Motion that the gate would release is not changed. What the gate has found out is not computed again when it gets
    the same targets.

    Args:
        adapter: Has planned the targets.
        gate: Would refuse some of them.
        held: Index of an arm whose targets will be replaced by its last one; None: neither.
    """

    def __init__(self, adapter: ServojAdapter, gate: SafetyGate, held: int | None = None) -> None:
        n = adapter.n
        self._gate = gate
        self._coupled, self._led = np.zeros((2, n), dtype=np.int64)
        kernel = Struct(
            "Lead",
            n=n,
            adapter=adapter.kernel,
            gate=gate.kernel,
            margin_m=MARGIN_M,
            held=-1 if held is None else held,
            coupled=self._coupled,
            led=self._led,
        )
        self._step = RowLoop("lead_step", kernel, n, adapter.threads)

    def __call__(self, coupled: Mask | None = None) -> Mask:
        """Lead the targets of the adapter, in place.

        Args:
            coupled: (n,) rows whose arms hold one object between them; None: none does.

        Returns:
            (n,) rows whose motion was led.
        """
        self._coupled[:] = 0 if coupled is None else coupled
        self._step()
        led: Mask = self._led != 0
        return led
