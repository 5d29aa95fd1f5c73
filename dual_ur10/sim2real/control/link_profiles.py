"""Settings of `servoj` for each rate at which points reach a controller, as data with reasons.

UR accepts a lookahead of 0.03 to 0.2 s and a gain of 100 to 2000. Longer lookaheads would smooth the steps of slow
targets, and delay the arm by as much. Here nothing has to be smoothed: below the controller's rate, a program on the
controller interpolates the points, so that `servoj` gets a target in every control period, whatever the rate.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

from dual_ur10.errors import SettingsError
from ur_core.servoj import ServojProfile

LinkMode = Literal["servoj", "points", "movej"]

LEAST_RATE_HZ: Final = 2.0
"""Lowest rate of points."""


@dataclass(frozen=True)
class LinkProfile:
    """Way of sending a path at one rate.

    Attributes:
        rate_hz: Targets or points per second.
        mode: "servoj": each target goes to `servoj` as it is; "points": the controller interpolates cubics; "movej":
            it moves from point to point in a fixed time, and rests at each.
        servoj: Settings of `servoj`; unused by "movej". They are checked against UR's ranges.
        reason: Reason for them.

    Raises:
        SettingsError: The rate is not one that this mode serves, or a setting is outside of UR's range.
    """

    rate_hz: float
    mode: LinkMode
    servoj: ServojProfile
    reason: str

    def __post_init__(self) -> None:
        highest = 1.0 / self.servoj.tick_s
        if not LEAST_RATE_HZ <= self.rate_hz <= highest:
            raise SettingsError(
                f"rate of the link is {self.rate_hz!r} Hz: allowed are {LEAST_RATE_HZ:g} to {highest:g} Hz"
            )
        if self.mode == "servoj" and self.rate_hz != highest:
            raise SettingsError(
                f"servoj at {self.rate_hz:g} Hz: a controller takes a target in each control period, {highest:g} Hz. "
                'Use the mode "points"'
            )

    @property
    def interval_s(self) -> float:
        """Time between two targets or points; of points, no whole number of control periods is needed."""
        return 1.0 / self.rate_hz


_FAST: Final = ServojProfile("cb3", 0.03, 2000.0)

PROFILES: Final = (
    LinkProfile(
        125.0,
        "servoj",
        _FAST,
        "shortest lookahead: the arm lags by 34 ms, which the sender compensates; at gain 2000 the law is damped by "
        "0.67, so that it neither swings nor smooths what was already checked",
    ),
    LinkProfile(
        50.0,
        "points",
        _FAST,
        "as at 125 Hz: the controller's program gives servoj a target every 8 ms. Held for 20 ms, raw targets would "
        "have steps of up to 6 mrad at 0.3 rad/s, and a longer lookahead to hide them would be a longer lag",
    ),
    LinkProfile(
        25.0, "points", _FAST, "as at 50 Hz; cubics through points 40 ms apart are exact to 0.1 µrad in a 0.5 Hz sine"
    ),
    LinkProfile(
        10.0,
        "points",
        _FAST,
        "as at 50 Hz. A lookahead of 0.3 s, as slow links are often given, is not legal: UR's longest is 0.2 s",
    ),
    LinkProfile(
        5.0, "points", _FAST, "as at 50 Hz; the error of the cubics grows with the fourth power of the interval"
    ),
    LinkProfile(
        2.0,
        "movej",
        _FAST,
        "points 0.5 s apart say too little of a path: the arms go to each in one time and rest there",
    ),
)
"""Profiles of a CB3, from the fastest."""


def profile_for(rate_hz: float, servoj: ServojProfile | None = None, *, movej: bool = False) -> LinkProfile:
    """Return the profile of a rate.

    Args:
        rate_hz: Points per second.
        servoj: Settings of `servoj` of the cell; None: those of the table.
        movej: Use fixed-time `movej` at this rate, too.

    Raises:
        SettingsError: No mode serves this rate.
    """
    servoj = _FAST if servoj is None else servoj
    mode: LinkMode = "movej" if movej or rate_hz < 5.0 else "points" if rate_hz * servoj.tick_s < 1.0 else "servoj"
    reason = next(
        (each.reason for each in PROFILES if (each.rate_hz, each.mode) == (rate_hz, mode)), "as its neighbours"
    )
    return LinkProfile(rate_hz, mode, servoj, reason)
