"""Perturbation: ranges, equality and shapes."""

from __future__ import annotations

import numpy as np
import pytest

from dual_ur10.errors import SettingsError, UnknownNameError
from dual_ur10.sim2real.cell.perturbation import Perturbation


def test_perturbations_of_lists_and_arrays_are_equal() -> None:
    friction = np.array([5.0, 5.0, 3.0, 1.0, 1.0, 1.0])
    made = Perturbation(friction_nm=friction)
    same = Perturbation(friction_nm=[5, 5, 3, 1, 1, 1])  # type: ignore[arg-type]
    assert made == same
    assert hash(made) == hash(same)
    assert made != Perturbation(friction_nm=friction + 1.0)
    friction[:] = 0.0  # it keeps a copy
    assert made == same


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("mass_scale", 0.0),
        ("mass_scale", 11.0),
        ("friction_nm", -1.0),
        ("lookahead_scale", 0.05),
        ("latency_s", 0.21),
        ("jitter_s", -0.001),
        ("loss", 0.95),
        ("payload_kg", 51.0),
        ("declared_payload_kg", -1.0),
        ("latency_s", float("nan")),
        ("friction_nm", np.array([0.0, 0.0, 0.0, 0.0, 0.0, np.inf])),
        ("loss", "often"),
        ("loss", [[0.0], [0.0, 0.0]]),
        ("loss", None),
    ],
)
def test_a_perturbation_out_of_range_is_refused_by_name(name: str, value: object) -> None:
    with pytest.raises(SettingsError, match=name):
        Perturbation(**{name: value})


def test_an_unknown_perturbation_is_refused_with_the_known_ones() -> None:
    with pytest.raises(UnknownNameError, match="friction_nm"):
        Perturbation.from_mapping({"friktion": 1.0})
    with pytest.raises(UnknownNameError, match="gravity"):
        Perturbation().changed(gravity=1.0)


def test_perturbations_expand_to_their_full_shape() -> None:
    values = Perturbation(friction_nm=np.arange(6.0), latency_s=[0.0, 0.01]).expanded(3)  # type: ignore[arg-type]
    assert values["friction_nm"].shape == (3, 2, 6)
    np.testing.assert_array_equal(values["friction_nm"][2, 1], np.arange(6.0))
    np.testing.assert_array_equal(values["latency_s"], [[0.0, 0.01]] * 3)
    others = {"friction_nm", "base_shift_m", "object_mass_scale"}
    assert all(value.shape == (3, 2) for name, value in values.items() if name not in others)
    assert values["base_shift_m"].shape == (3, 2, 3)
    assert values["object_mass_scale"].shape == (3,)
    values["loss"][0] = 0.5  # each is its own array
    assert values["loss"][1, 0] == 0.0


@pytest.mark.parametrize(("name", "shape"), [("mass_scale", (3,)), ("friction_nm", (2,)), ("loss", (4, 2))])
def test_a_perturbation_of_the_wrong_shape_is_refused(name: str, shape: tuple[int, ...]) -> None:
    with pytest.raises(SettingsError, match=name):
        Perturbation(**{name: np.full(shape, 0.5)}).expanded(3)
