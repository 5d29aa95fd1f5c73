"""The networks of learned policies, on numpy alone."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from dual_ur10.errors import CheckpointError
from dual_ur10.policies.learned.network import Network, NetworkShape, Normaliser
from tests.soak import scaled


def layers(shape: NetworkShape, seed: int = 0) -> list[Any]:
    rng = np.random.default_rng(seed)
    return [
        ((rng.normal(size=(out, into)) / np.sqrt(into)).astype(np.float32), rng.normal(size=out).astype(np.float32))
        for into, out in shape.pairs
    ]


def bounds(size: int) -> tuple[Any, Any]:
    return np.linspace(-2, -1, size, dtype=np.float32), np.linspace(0.5, 1.5, size, dtype=np.float32)


@pytest.mark.parametrize("activation", ["tanh", "relu"])
@pytest.mark.parametrize("squashing", ["clip", "tanh"])
@pytest.mark.parametrize("sizes", [(7, 3), (80, 256, 256, 12), (47, 33, 65, 7), (3, 4096, 2), (4096, 5, 1)])
def test_outputs_equal_those_of_torch(activation: Any, squashing: Any, sizes: tuple[int, ...]) -> None:
    torch = pytest.importorskip("torch")
    shape = NetworkShape(sizes, activation, squashing)
    weights, (low, high) = layers(shape), bounds(sizes[-1])
    rng = np.random.default_rng(1)
    mean, var = rng.normal(size=sizes[0]), rng.uniform(0.1, 2, size=sizes[0])
    own = Network(shape, weights, low, high, Normaliser(tuple(mean), tuple(var), clip=1.5))
    observation = rng.normal(size=(scaled(2000), sizes[0])) * 2
    x = torch.as_tensor(np.clip((observation - mean) / np.sqrt(var + 1e-8), -1.5, 1.5).astype(np.float32))
    for k, (weight, bias) in enumerate(weights):
        x = torch.nn.functional.linear(x, torch.as_tensor(weight), torch.as_tensor(bias))
        if k < len(weights) - 1:
            x = torch.tanh(x) if activation == "tanh" else torch.relu(x)
    expected = x.numpy()
    if squashing == "tanh":
        expected = low + (high - low) * (np.tanh(expected) + 1) / 2
    found = own(observation)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, np.clip(expected, low, high), atol=2e-5)
    assert not np.allclose(found[0], found[1])


@pytest.mark.parametrize("sizes", [(80, 256, 256, 12), (112, 64, 64, 14), (47, 300, 7)])
def test_a_row_of_a_batch_gives_the_bits_of_a_single_one(sizes: tuple[int, ...]) -> None:
    shape = NetworkShape(sizes, "tanh", "clip")
    network = Network(shape, layers(shape), *bounds(sizes[-1]), None)
    batch = np.random.default_rng(0).normal(size=(64, sizes[0]))
    together = network(batch)
    for row in range(64):
        assert network(batch[row : row + 1]).tobytes() == together[row].tobytes()
        assert network(batch[row:])[0].tobytes() == together[row].tobytes()


def test_actions_stay_within_their_bounds() -> None:
    shape = NetworkShape((3, 8, 4), "relu", "clip")
    low, high = bounds(4)
    found = Network(shape, layers(shape), low, high, None)(np.random.default_rng(0).normal(size=(500, 3)) * 1e3)
    assert (found >= low).all()
    assert (found <= high).all()
    assert (found == low).any()
    assert (found == high).any()


def test_overflow_gives_no_warning_and_stays_within_bounds() -> None:
    shape = NetworkShape((1, 1, 1), "relu", "clip")
    huge = [(np.float32([[3e38]]), np.float32([0])), (np.float32([[3e38]]), np.float32([0]))]
    found = Network(shape, huge, np.float32([-1]), np.float32([1]), None)(np.array([[100.0]]))
    assert found.tolist() == [[1.0]]


def test_the_observation_is_not_changed() -> None:
    shape = NetworkShape((2, 2), "tanh", "clip")
    network = Network(shape, layers(shape), *bounds(2), Normaliser((1.0, 2.0), (1.0, 1.0)))
    observation = np.array([[5.0, -50.0]])
    network(observation)
    assert observation.tolist() == [[5.0, -50.0]]


@pytest.mark.parametrize(
    "sizes", [(), (3,), (3, 0), (3, -1, 2), (5000, 2), (4000, 4000), tuple([2] * 10), (2, 10**12), (4096,) * 5]
)
def test_impossible_sizes_are_refused(sizes: tuple[int, ...]) -> None:
    with pytest.raises(CheckpointError, match="the network has"):
        NetworkShape(sizes, "tanh", "clip")


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"mean": (1.0,), "var": (1.0, 2.0)}, "one each"),
        ({"mean": (1.0,), "var": (-1.0,)}, "variance of -1"),
        ({"mean": (1.0,), "var": (1.0,), "clip": 0.0}, "above 0"),
        ({"mean": (1.0,), "var": (1.0,), "epsilon": 0.0}, "above 0"),
    ],
)
def test_impossible_normalisers_are_refused(values: Any, message: str) -> None:
    with pytest.raises(CheckpointError, match=message):
        Normaliser(**values)
