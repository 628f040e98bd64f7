"""Choice between metal and dielectric at the start of a fit, surfel by surfel, by a trial of both.

The fit that explains the images better continues; each surfel starts as what explains those around it.
"""

import time
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
from scipy.spatial import cKDTree

from mi_refgs.data.view import View, evenly_spread
from mi_refgs.fitting.decide import Row, conclude, continued
from mi_refgs.fitting.image_error import displayed_image, squared_error
from mi_refgs.fitting.per_view import gains_of
from mi_refgs.fitting.train import Trainer
from mi_refgs.io.images import psnr_of
from mi_refgs.kernels.device import upload
from mi_refgs.methods.extensions import Event, register_event
from mi_refgs.methods.fields import ITERATIONS, at_least
from mi_refgs.splat.weights import BlendedView
from mi_refgs.surfels.attributes import logit
from mi_refgs.surfels.table import Surfels

DIELECTRIC, METAL = 0.1, 0.9  # metallic during the trials: 0 and 1 have no slope to leave them by
METAL_GAIN = 1.5  # dB from which surfels start as metal: plastic gains 0.7, gold and mixed scenes 2.3 or more
MANY_VIEWS = 32  # below which more is needed: of plastic too, metal explains few images better (16: 1.9 dB)
JUDGED_VIEWS = 24  # training views whose errors decide
NEIGHBOURHOOD = 0.05  # fraction of the surfels that a surfel shares its choice with: single errors are noise
CENTRES = 5_000  # surfels that the fraction is counted in: so many sums are computed


@register_event
@dataclass(frozen=True)
class Metal(Event[Trainer]):
    """Begins a fit as dielectric and as metal, and continues one of them: as metal if it gains enough."""

    name: ClassVar[str] = "metal"
    outside: ClassVar[bool] = True
    attributes: ClassVar[tuple[str, ...]] = ("metallic",)
    trial: int = field(metadata=ITERATIONS | at_least(1))  # iterations with every surfel metal, or none

    def due(self, trainer: Trainer) -> bool:
        return trainer.iteration == 0

    def apply(self, trainer: Trainer) -> None:
        began, steps = time.perf_counter(), min(self.trial, trainer.method.iterations)
        trainer.tell(f"begins as dielectric and as metal, {steps} iterations each")
        fits = [_begun(trainer, metallic, steps) for metallic in (DIELECTRIC, METAL)]
        judged = evenly_spread(len(trainer.data.views), JUDGED_VIEWS)
        errors = [[_squared_error(fit, i) for i in judged] for fit in fits]
        dielectric, metal = (psnr_of(float(np.mean([error.mean() for error in one]))) for one in errors)
        gain = METAL_GAIN * max(MANY_VIEWS / len(trainer.data.views), 1) ** 0.5
        is_metal = metal >= dielectric + gain
        trainer.take(fits[is_metal], trainer.method)
        trainer.fit.optimiser.factors["metallic"] = 1.0

        # Each surfel starts as what has the smaller error around it.
        excess = [one - 10 ** (gain / 10) * other for one, other in zip(*errors, strict=True)]
        raw = trainer.surfels.to_numpy()
        attributed = _attributed(trainer.surfels, [*map(trainer.read, judged)], excess)
        metals = _sum_around(raw["position"], attributed) > 0
        raw["metallic"] = np.where(metals[:, None], logit(METAL), logit(DIELECTRIC)).astype(np.float32)
        trainer.fit.tables[0].replace(Surfels.from_numpy(raw), cleared=("metallic",))
        reason = (
            f"{metal:.2f} dB as metal, {dielectric:.2f} dB as dielectric, metal needs {gain:.1f} dB "
            f"more; {metals.mean():.0%} of the surfels start as metal"
        )
        row = Row(self.name, 0, bool(is_metal), reason, dielectric, metal)
        conclude(trainer, row, began, f"continues as {'metal' if is_metal else 'dielectric'}")


def _begun(trainer: Trainer, metallic: float, steps: int) -> Trainer:
    """The fit after some steps with this metallic everywhere."""
    surfels = trainer.method.surfels
    surfels = replace(surfels, initial={**surfels.initial, "metallic": metallic})
    copy = Trainer(replace(trainer.method, surfels=surfels), trainer.data, targets=trainer.targets)
    copy.fit.optimiser.factors["metallic"] = 0.0
    return continued(copy, steps, trainer)


def _squared_error(trainer: Trainer, index: int) -> np.ndarray:
    """Squared error (H, W) of a displayed training image, mean over its channels."""
    view, gains = trainer.read(index), gains_of(trainer.fit.params)
    frame = trainer.view(view.camera(), aovs=False)
    shown = displayed_image(frame, view, trainer.data, None if gains is None else gains[index])
    return np.asarray(squared_error(shown, view).mean(axis=-1))


def _attributed(surfels: Surfels, views: list[View], errors: list[np.ndarray]) -> np.ndarray:
    """The error (N,) that each surfel is responsible for: Σ w e over the pixels of maps (H, W) of views."""
    total = np.zeros(surfels.count)
    for view, error in zip(views, errors, strict=True):
        total += BlendedView.of([surfels], view.camera(), [0]).sums([upload(error)])[0]
    return total


def _sum_around(positions: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Sum (N,) of the values over the NEIGHBOURHOOD of the nearest of CENTRES surfels."""
    centres = positions[evenly_spread(len(positions), CENTRES)]
    tree = cKDTree(centres)
    _, own = tree.query(positions)
    sums = np.bincount(own, values, len(centres))
    _, nearest = tree.query(centres, max(round(NEIGHBOURHOOD * len(centres)), 1))
    return np.asarray(sums[nearest.reshape(len(centres), -1)].sum(axis=1)[own])
