"""ACT: a transformer imitates chunks of the scripted policy's, or a dataset's, motion of the joints.

Where images are observed, it sees them, and of the numbers the positions of both arms alone.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from dual_ur10.errors import TrainingError
from dual_ur10.policies.learned.manifest import Manifest
from dual_ur10.policies.training.act_fit import ActFit, Chunks
from dual_ur10.policies.training.folder import act_shape, read_backbone
from dual_ur10.policies.training.gather import Samples
from dual_ur10.policies.training.imitation import DemonstrationLearner, seed_of
from dual_ur10.policies.training.settings import ActSettings
from dual_ur10.policies.training.state import Tensors
from ur_core.types import Single


class ActImitator(DemonstrationLearner):
    """Learner of chunks. Its episodes are those of behaviour cloning.

    The state is saved at each progress check, and a training that continues gives the same result as one that was not
    interrupted.

    Args:
        tensors: Tensors of the state to continue from; None: begin.
        *args: As for `DemonstrationLearner`.
    """

    def __init__(self, tensors: Tensors | None, *args: Any) -> None:
        super().__init__(*args)
        if not isinstance(self._asked.settings, ActSettings):
            raise TrainingError(f"{self._asked.algorithm} learns no chunks")
        self._settings: ActSettings = self._asked.settings
        self._shape, self._tensors = act_shape(self._settings, self._view), tensors

    def _add(self, samples: Samples, begun: float) -> None:
        self._gradient_steps, self._tensors = 0, None  # with more samples the fit begins anew
        super()._add(samples, begun)

    def _fit(self, number: int, begun: float) -> None:
        """Fit a transformer to all samples, and save its policy at each check at which it is the best so far."""
        settings = self._settings
        seed = seed_of(self._asked.seed, number)
        saved = self._tensors if self._gradient_steps else None
        backbone = read_backbone(settings.backbone) if settings.backbone and not saved else None
        fit = ActFit(settings, self._shape, self._chunks(), self._blind, seed, backbone)
        if saved:
            fit.restore(saved, self._gradient_steps)

        def on_step(step: int, loss: float) -> None:
            self._tell(f"fitting, {100 * step // settings.fit_steps} %, deviation {loss:.4f}")

        while fit.done < settings.fit_steps:
            loss = fit(min(settings.check_steps, settings.fit_steps - fit.done), on_step)
            self._folder.logger.record("fit/loss", loss)
            self._folder.logger.record("fit/steps", fit.done)
            self._tell("checking")
            seconds, made = time.monotonic() - begun, fit.tensors()
            self._folder.check_progress(
                [made], lambda found: self._manifest_of(fit, found), self._progress.steps, seconds
            )
            self._gradient_steps = fit.done
            self._save(begun, fit.state())

    def _manifest_of(self, fit: ActFit, evaluation: dict[str, object] | None) -> Manifest:
        return self._stated(self._shape, fit.normalisers, evaluation, fitted=fit.done)

    def _chunks(self) -> Chunks:
        """Return the samples of all episodes, each in order."""
        parts = []
        for each in self._samples:
            order = np.argsort(each.episode, kind="stable")
            ends = np.flatnonzero(np.diff(each.episode[order], append=-1)) + 1
            left = np.repeat(ends, np.diff(ends, prepend=0)) - np.arange(len(order))
            images = [] if each.images is None else [each.images[order]]
            parts.append((each.observation[order], self._labels(each)[order], left, *images))
        return Chunks(*(np.concatenate(each) for each in zip(*parts, strict=True)))

    def _labels(self, samples: Samples) -> Single:
        """Return the samples' actions as those of chunks, (k, A), but grippers from 0, closed, to 1, open."""
        count, view = len(samples.action), self._demonstrated_view
        action = samples.action.astype(np.float64).reshape(count, 2, -1)
        adapter = view.setup.make_adapter(count)
        commanded = samples.observation[:, view.indices(["commanded_q_rad"], joint=True)]
        adapter.reset(commanded.astype(np.float64).reshape(count, 2, 6))
        found = action.copy()
        found[..., :6] = adapter.goals(action)
        if self._settings.chunk_mode == "joint_delta":
            step_rad = self._view.setup.make_adapter().joint_step_rad.reshape(2, 6)
            found[..., :6] = (found[..., :6] - adapter.commanded_q_rad) / step_rad
        if view.signature.actions.gripper:
            found[..., 6] = 0.5 * (found[..., 6] + 1.0)
        return found.reshape(count, -1).astype(np.float32)
