"""Profiles of rates: within UR's ranges, one per rate, and the table of the documentation."""

import pathlib
import re

import pytest

from dual_ur10.errors import SettingsError
from dual_ur10.sim2real.control.link_profiles import PROFILES, LinkProfile, profile_for
from ur_core.servoj import ServojProfile

PAGE = pathlib.Path(__file__).parents[3] / "docs" / "how-to" / "slow-links-and-serial-arms.md"


def test_the_table_covers_the_named_rates_from_the_fastest():
    assert [each.rate_hz for each in PROFILES] == [125.0, 50.0, 25.0, 10.0, 5.0, 2.0]
    assert [each.mode for each in PROFILES] == ["servoj", "points", "points", "points", "points", "movej"]
    assert all(len(each.reason) > 40 for each in PROFILES)


@pytest.mark.parametrize("profile", PROFILES, ids=lambda each: f"{each.rate_hz:g} Hz")
def test_each_row_is_that_of_its_rate_and_of_the_documentation(profile):
    assert profile_for(profile.rate_hz) == profile
    rows = re.findall(r"^\| ([\d, ]+) Hz \|.*\| ([\d.]+) s, (\d+) \|", PAGE.read_text(), re.MULTILINE)
    settings = {float(rate): (float(a), float(b)) for rates, a, b in rows for rate in rates.split(",")}
    if profile.mode != "movej":
        assert settings[profile.rate_hz] == (profile.servoj.lookahead_s, profile.servoj.gain)


@pytest.mark.parametrize("rate_hz", [0.0, 1.9, 126.0, float("nan"), -5.0])
def test_other_rates_are_refused(rate_hz):
    with pytest.raises(SettingsError, match="rate of the link"):
        profile_for(rate_hz)


def test_direct_targets_need_the_rate_of_the_controller():
    with pytest.raises(SettingsError, match="points"):
        LinkProfile(50.0, "servoj", ServojProfile(), "as many do")
    assert profile_for(500.0, ServojProfile("e-series")).mode == "servoj"
    assert profile_for(125.0, ServojProfile("e-series")).mode == "points"


@pytest.mark.parametrize(("lookahead_s", "gain"), [(0.3, 2000.0), (0.5, 300.0), (0.03, 0.3), (0.1, 3000.0)])
def test_settings_beyond_urs_ranges_are_refused(lookahead_s, gain):
    with pytest.raises(SettingsError, match="accepts"):
        ServojProfile("cb3", lookahead_s, gain)


def test_moves_can_be_asked_for_at_higher_rates():
    assert profile_for(5.0, movej=True).mode == "movej"
    assert profile_for(3.0).mode == "movej"
