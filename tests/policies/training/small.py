"""Trainings that take seconds."""

from __future__ import annotations

from typing import Any

from dual_ur10.policies.training.settings import Training, defaults

IMITATION: dict[str, Any] = {"hidden": (16,), "fit_steps": 30, "batch_size": 64}
ACT: dict[str, Any] = {
    "chunk_size": 4,
    "dim_model": 8,
    "n_heads": 2,
    "dim_feedforward": 16,
    "fit_steps": 20,
    "check_steps": 8,
    "batch_size": 32,
    "demonstrations": 0,
}
REINFORCEMENT: dict[str, dict[str, Any]] = {
    "ppo": {"hidden": (16,), "steps_per_update": 16, "batch_size": 16, "epochs": 2},
    "sac": {"hidden": (16,), "learning_starts": 40, "gradient_steps": 1, "batch_size": 16, "buffer_size": 500},
}
STEPS = 50
"""Steps of an episode of imitation; those of reinforcement are half as long."""


def small(algorithm: str = "dagger", agents: str = "joint", *, rounds: int = 2, **given: Any) -> Training:
    """Return a training of SineTracking in two cells, with so many episodes in each."""
    imitation = algorithm not in REINFORCEMENT
    changes = ACT if algorithm == "act" else IMITATION if imitation else REINFORCEMENT[algorithm]
    keywords = {"duration_s": 2.0 if imitation else 1.0, **given.pop("keywords", {})}
    changes = {**changes, **given.pop("changes", {})}
    given = {"envs": 2, "steps": 2 * STEPS * rounds, **given}
    asked = defaults("SineTracking", algorithm, agents, keywords=keywords, changes=changes, **given)
    object.__setattr__(asked, "checks", 2)
    return asked
