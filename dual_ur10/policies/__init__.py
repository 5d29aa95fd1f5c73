"""Scripted and learned policies, their evaluation and their training.

    from dual_ur10.policies import evaluate, make, rollout

    env, policy = make("learned", "DualUR10/Handover-v0")
    print(rollout(env, policy, seed=0).success)
    print(evaluate("DualUR10/Handover-v0", "learned", episodes=10).success_rate)

Any object with the two methods of `Policy` can be evaluated, and so can a plain function of the observation. Importing
this package loads neither MuJoCo nor torch.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from dual_ur10.policies.policy import Policy
from dual_ur10.policies.registry import NAMES, is_path, load, make

if TYPE_CHECKING:
    from dual_ur10.policies.evaluation.evaluate import evaluate
    from dual_ur10.policies.evaluation.rollout import rollout

__all__ = ["NAMES", "Policy", "evaluate", "is_path", "load", "make", "rollout"]


def __getattr__(name: str) -> Any:
    # Imported on first use: both need the environments, and with them MuJoCo.
    if name == "evaluate":
        from dual_ur10.policies.evaluation.evaluate import evaluate

        return evaluate
    if name == "rollout":
        from dual_ur10.policies.evaluation.rollout import rollout

        return rollout
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
