"""The loss of a step: its terms, weighted as the method says."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from mi_refgs.fit import config
from mi_refgs.fit.config import LossWeights
from mi_refgs.fit.data import load
from mi_refgs.fit.objective import objective
from mi_refgs.fit.train import Trainer


def test_the_weight_of_normals_rises_linearly(data: Path, method: Path) -> None:
    views = load(data, "train", truth=False)
    trainer = Trainer(config.load(str(method), "quick", ["surfels.count=200", "loss.alpha=0"]), views)
    target = trainer.targets[0]
    frame = trainer.view(target.camera)

    def loss(iteration: int, **weights: Any) -> float:
        return float(objective(frame, target, views, LossWeights(ssim=0, **weights), iteration)[0][0])

    rest, full = loss(1, normal=0), loss(1, normal=0.2)
    assert full - rest > 1e-3
    rise: dict[str, Any] = {"normal": 0.2, "normal_rise": 100}
    for iteration, share in ((1, 0.01), (50, 0.5), (100, 1), (1000, 1)):
        assert loss(iteration, **rise) - rest == pytest.approx(share * (full - rest), rel=1e-3)
