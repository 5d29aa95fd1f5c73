"""Fitting networks to samples."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from dual_ur10.policies.learned.network import Network  # noqa: E402
from dual_ur10.policies.training.regression import Fit, Scatter, normaliser_of, reproducible  # noqa: E402
from dual_ur10.policies.training.settings import Imitation  # noqa: E402

SETTINGS = Imitation(hidden=(32, 32), batch_size=256)


def samples(count=2000, seed=0):
    rng = np.random.default_rng(seed)
    observation = (rng.standard_normal((count, 5)) * [1, 0.1, 10, 1, 0] + [0, 1, 2, 3, 4]).astype(np.float32)
    action = np.stack([np.tanh(observation[:, 0]), 0.2 * observation[:, 1] * observation[:, 3]], axis=1)
    return observation, (0.5 * action + [0.1, -0.2]).astype(np.float32)


def fitted(seed=0, steps=600, **given):
    observation, action = samples()
    with reproducible(seed):
        fit = Fit(SETTINGS, **given)
        loss = fit(observation, action, steps, np.random.default_rng(seed))
    return fit, loss


def network(fit):
    one = np.ones(2, dtype=np.float32)
    return Network(fit.shape(), fit.layers(), -one, one, fit.normaliser)


def test_the_fitted_layers_reproduce_the_actions():
    fit, loss = fitted()
    observation, action = samples(500, seed=1)
    found = network(fit)(observation.astype(np.float64))
    shares = ((found - action) ** 2).mean(axis=0) / action.var(axis=0)
    assert shares.max() < 0.03
    assert loss < 0.05
    assert fit.shape().layers == (5, 32, 32, 2)


def test_nearly_constant_values_are_not_amplified():
    observation, _ = samples()
    normaliser = normaliser_of(observation)
    assert normaliser.mean[4] == 4.0
    assert normaliser.var[4] == (2e-3) ** 2
    assert normaliser.var[2] == pytest.approx(100, rel=0.1)


def nearly_together(count, seed):
    """Two values that move together, and an action that follows their small difference."""
    rng = np.random.default_rng(seed)
    first, apart = rng.standard_normal(count), 0.004 * rng.standard_normal(count)
    observation = np.stack([first, first + apart, np.full(count, 2.0)], axis=1).astype(np.float32)
    return observation, (-50.0 * apart[:, None]).astype(np.float32)


def test_small_differences_of_correlated_values_are_learned():
    fit = Fit(SETTINGS)
    with reproducible(0):
        fit(*nearly_together(2000, 0), 400, np.random.default_rng(0))
    one = np.ones(1, dtype=np.float32)
    act = Network(fit.shape(), fit.layers(), -one, one, fit.normaliser)
    observation, action = nearly_together(500, 1)
    found = act(observation.astype(np.float64))
    assert ((found - action) ** 2).mean() < 0.02 * action.var()
    # A value that never varied in the samples has no effect when it does.
    moved = observation.astype(np.float64) + np.array([0, 0, 0.1])
    np.testing.assert_allclose(act(moved), found, atol=0.2)


def test_unseen_values_have_no_effect():
    observation, action = samples()
    fit = Fit(SETTINGS, unseen=[1, 3])
    with reproducible(0):
        fit(observation, action, 300, np.random.default_rng(0))
    other = observation.astype(np.float64)
    other[:, [1, 3]] += 5.0
    assert network(fit)(other).tobytes() == network(fit)(observation.astype(np.float64)).tobytes()
    other[:, 0] += 0.5
    assert np.abs(network(fit)(other) - network(fit)(observation.astype(np.float64))).max() > 0.1


@pytest.mark.parametrize("std_rad", [0.0, 0.02])
def test_scattered_samples_lead_back_to_the_demonstrated_path(std_rad):
    """A joint moves with the place of an object, and a gripper closes where it has arrived."""
    rng = np.random.default_rng(0)
    place, step_rad = rng.uniform(-1.0, 1.0, 1000), 0.04
    observation = np.stack([place, 0.1 * place], axis=1).astype(np.float32)  # object, commanded joint
    action = np.stack([np.full(1000, 0.25), np.where(place > 0.0, -1.0, 1.0)], axis=1).astype(np.float32)
    fit = Fit(SETTINGS, scatter=Scatter(std_rad, [1], [0], [step_rad]) if std_rad else None)
    with reproducible(0):
        fit(observation, action, 700, np.random.default_rng(0))
    places = np.array([-0.6, 0.5])
    on, off = (np.stack([places, 0.1 * places + away], axis=1) for away in (0.0, 0.01))
    found, displaced = network(fit)(on), network(fit)(off)
    np.testing.assert_allclose(found, [[0.25, 1.0], [0.25, -1.0]], atol=0.05)
    gain = (displaced[:, 0] - found[:, 0]) / (-0.01 / step_rad)
    if std_rad:
        np.testing.assert_allclose(gain, 1.0, atol=0.2)
    else:
        assert np.abs(gain).max() < 0.2


def test_the_correction_of_a_displacement_keeps_the_bounds_of_actions():
    action = np.tile(np.array([[0.5, -0.25, 1.0]], dtype=np.float32), (400, 1))
    scatter = Scatter(0.1, [3, 4], [0, 1], [0.04, 0.08])
    off, corrected = scatter(action, np.random.default_rng(0))
    assert not off[:200].any()  # half of them show the demonstration as it is
    np.testing.assert_array_equal(corrected[:200], action[:200])
    np.testing.assert_array_equal(corrected[:, 2], action[:, 2])
    wanted = np.clip(action[:, :2] - off / [0.04, 0.08], -1.0, 1.0)
    np.testing.assert_allclose(corrected[:, :2], wanted, atol=1e-6)
    assert np.abs(corrected).max() == 1.0
    assert 0.03 < off[200:].std() < 0.08


def test_the_same_seed_gives_the_same_bits():
    first, second, other = (fitted(seed, 20)[0].layers() for seed in (3, 3, 4))
    for (a, b), (c, d) in zip(first, second, strict=True):
        assert a.tobytes() == c.tobytes()
        assert b.tobytes() == d.tobytes()
    assert first[0][0].tobytes() != other[0][0].tobytes()


def test_a_fit_begins_with_the_initial_layers():
    before, _ = fitted(steps=200)
    after, _ = fitted(steps=0, seed=9, layers=before.layers(), normaliser=before.normaliser)
    for (a, b), (c, d) in zip(before.layers(), after.layers(), strict=True):
        np.testing.assert_allclose(a, c, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(b, d, rtol=1e-5, atol=1e-6)


def test_the_state_of_torch_is_restored():
    before = torch.get_num_threads(), torch.are_deterministic_algorithms_enabled(), torch.get_rng_state()
    strict = []

    def fails():
        with reproducible(7):
            torch.rand(3)
            strict.append(torch.are_deterministic_algorithms_enabled())
            raise RuntimeError("x")

    with pytest.raises(RuntimeError, match="x"):
        fails()
    assert strict == [True]
    after = torch.get_num_threads(), torch.are_deterministic_algorithms_enabled(), torch.get_rng_state()
    assert before[:2] == after[:2]
    assert torch.equal(before[2], after[2])
