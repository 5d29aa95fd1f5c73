"""The runs that the demonstration and the accuracy benchmark are made of, and what comes of one."""

from __future__ import annotations

from dataclasses import dataclass, replace

from dual_ur10.assets.scene import ArmMount
from dual_ur10.policies.accuracy import Accuracy
from dual_ur10.policies.rollout import Record
from dual_ur10.sim2real.cell import TYPICAL_PERTURBATION, CellConfig

ASYMMETRIC_CELL = CellConfig(left=ArmMount((-0.75, 0.6, 0.0)), right=ArmMount((-0.92, -0.45, 0.08)))
"""Where accuracy is measured. In a symmetric cell both arms make the same errors, and the distance between them is
exactly right whatever the controller does."""

PERTURBED_CELL = replace(ASYMMETRIC_CELL, perturbation=TYPICAL_PERTURBATION)

LATENCY_TICKS = 5


@dataclass(frozen=True)
class Run:
    """One way to run the sine.

    Attributes:
        name: Short name.
        title: For people.
        cell: Plant and bases.
        learn: Whether the policy learns the arms' deviation.
        compensate_lag: Whether the adapter takes the lag of `servoj` out.
        arms: Which arms follow the sine.
        latency_ticks: Ticks between an observation and the first target of its action.
        axis: Direction of the sine; y is the line between the flanges.
    """

    name: str
    title: str
    cell: CellConfig = ASYMMETRIC_CELL
    learn: bool = True
    compensate_lag: bool = True
    arms: str = "both"
    latency_ticks: int = 0
    axis: str = "y"


RUNS = (
    Run("nominal", "nominal"),
    Run("perturbed", "perturbed", PERTURBED_CELL),
    Run("perturbed_fixed", "perturbed, without learning", PERTURBED_CELL, learn=False),
    Run("perturbed_late", f"perturbed, L = {LATENCY_TICKS} ticks", PERTURBED_CELL, latency_ticks=LATENCY_TICKS),
    Run("single", "single arm, nominal", arms="left"),
    Run("single_perturbed", "single arm, perturbed", PERTURBED_CELL, arms="left"),
    Run("lagging", "nominal, lag not compensated", learn=False, compensate_lag=False),
)


@dataclass(frozen=True)
class Result:
    """What came of a run.

    Attributes:
        run: How it was run.
        record: What was measured.
        accuracy: Figures of the whole episode.
        lag_s: How far the slower of the tracking arms is behind its reference.
        skew_s: How far the left arm is behind the right one; NaN if only one moves.
    """

    run: Run
    record: Record
    accuracy: Accuracy
    lag_s: float
    skew_s: float
