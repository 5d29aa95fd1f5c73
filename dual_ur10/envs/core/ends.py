"""Reasons for which episodes end, as `info["end_reason"]` names them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from dual_ur10.sim2real.control.gate import Verdict

SUCCESS: Final = "success"
"""The task was solved, with a terminal state or at the end of its time."""

TIME: Final = "time"
"""The time of the episode, or `max_episode_steps`, has run out without success."""

DIVERGED: Final = "physics"
"""The simulation diverged; `info["physics_error"]` has a message."""

BRAKED: Final = "solved_after_refusal"
"""The task was solved after a motion that the safety gate refused, which ends an episode on two controllers."""

_REFUSED: Final = "refused/"
_DETAILS: Final = ("end_reason", "safety", "physics_error")


def refusal(verdict: Verdict) -> str:
    """Return the reason of an end by the safety gate, such as "refused/distance"."""
    return f"{_REFUSED}{verdict.kind.lower().replace(' ', '_')}"


def early_end(info: Mapping[str, Any]) -> str:
    """Return a text on an early end of an episode: the verdict of the gate, or the reason; "" for any other end.

    Args:
        info: That of the last step of one environment.
    """
    reason = str(info.get("end_reason", ""))
    if reason in ("", SUCCESS, TIME, BRAKED):
        return ""
    detail = "physics_error" if reason == DIVERGED else "safety" if reason.startswith(_REFUSED) else "end_reason"
    return str(info[detail])


def details_of(info: Mapping[str, Any], row: int) -> dict[str, Any]:
    """Return what the info of a vector environment says of the end of a row's episode, as that of one environment."""
    return {name: info[name][row] for name in _DETAILS if name in info and info["_" + name][row]}
