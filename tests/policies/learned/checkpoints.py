"""Small checkpoints, and changes of their files."""

from __future__ import annotations

import copy
import hashlib
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

import dual_ur10
from dual_ur10.policies.learned.manifest import Manifest
from dual_ur10.policies.learned.network import NetworkShape, Normaliser
from dual_ur10.policies.learned.signature import view_of

SINE, CARRY, HANDOVER = dual_ur10.ENV_IDS[:3]
KINDS = ("joint", "shared", "independent")


def parts(env_id: str = SINE, agents: str = "joint", hidden: int = 4, **keywords: Any) -> tuple[list[Any], Manifest]:
    rng = np.random.default_rng(KINDS.index(agents))
    view = view_of(env_id, keywords)
    signature = view.signature
    size = signature.observation.shape[0] if agents == "joint" else view.layout.size
    shape = NetworkShape((size, hidden, signature.action.shape[0] // (1 if agents == "joint" else 2)), "tanh", "clip")
    count = 2 if agents == "independent" else 1
    networks = [
        [
            (rng.normal(size=(out, into)).astype(np.float32) / 8, rng.normal(size=out).astype(np.float32) / 8)
            for into, out in shape.pairs
        ]
        for _ in range(count)
    ]
    made = Manifest(
        signature=signature,
        agents=agents,  # type: ignore[arg-type]  # one of KINDS
        network=shape,
        normalisers=tuple(
            Normaliser(tuple(rng.normal(size=size).tolist()), tuple(rng.random(size).tolist())) for _ in range(count)
        ),
        training={"algorithm": "ppo", "steps": 100, "rates": [0.1, 1e-300], "nested": {"clip": None, "ok": True}},
        seed=3,
        evaluation={"success": 0.1 + 0.2},
    )
    return networks, made


def sealed(value: dict[str, Any]) -> bytes:
    """Return a manifest's text with a valid checksum."""
    value = {name: each for name, each in value.items() if name != "sha256"}
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=True)
    return json.dumps({**value, "sha256": hashlib.sha256(text.encode()).hexdigest()}).encode()


def content(folder: Path) -> dict[str, Any]:
    value: dict[str, Any] = json.loads((folder / "manifest.json").read_text())
    return value


def edit(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    value = content(folder)
    change(value)
    (folder / "manifest.json").write_bytes(sealed(value))


def exchange_weights(folder: Path, data: bytes) -> None:
    (folder / "policy.safetensors").write_bytes(data)
    edit(folder, lambda value: value.update(weights_sha256=hashlib.sha256(data).hexdigest()))


def leaves(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    yield path
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for name, each in items:
        yield from leaves(each, (*path, name))


def at(value: Any, path: tuple[Any, ...]) -> Any:
    for name in path:
        value = value[name]
    return value


def put(value: Any, path: tuple[Any, ...], new: Any) -> Any:
    result = copy.deepcopy(value)
    at(result, path[:-1])[path[-1]] = new
    return result
