"""Choice between metal and dielectric at the start of a fit, by a trial of both.

Where metallic learns freely from the start, values in between explain the images under a light of another
contrast, and a prior against them decides by the initial value. So the fit begins twice, once with every
surfel metal and once with none, each with its own light and geometry; the training images decide which of
them continues. From then on metallic learns per surfel.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, replace

import numpy as np

from mi_refgs.fitting.select import Decision
from mi_refgs.fitting.train import Trainer
from mi_refgs.io.images import psnr_of

DIELECTRIC, METAL = 0.1, 0.9
"""Metallic during the trials: 0 and 1 have no slope, so that no surfel could leave them afterwards."""

METAL_GAIN = 0.5
"""Gain in dB from which a fit continues as metal: early, a metal under a light of low contrast looks like a
plastic. Over the second half of 500 steps at 100², the gain is 1.3 dB for `gold_cavities`, 1.1 dB for
`mirror_ring`, 0.1 dB for `plastic_hollows` and -0.1 dB for `studded`."""


def install_metal_trial(trainer: Trainer, tell: Callable[[str], None] = lambda _: None) -> None:
    """Let a trainer choose between metal and dielectric before its first step.

    Changes nothing if its method has no `metal_trial`. `tell` is called with a sentence about the choice.
    """
    options, earlier = trainer.method.metal_trial, trainer.before_step
    if options is None:
        return

    def before_step(trainer: Trainer) -> None:
        if earlier is not None:
            earlier(trainer)
        if trainer.iteration == 0:
            steps = min(options.until, trainer.method.iterations)
            tell(f"begins as dielectric and as metal, {steps} iterations each; the better continues")
            tell(choose_metallic(trainer, steps))

    trainer.before_step = before_step


def choose_metallic(trainer: Trainer, steps: int) -> str:
    """Begin a fit as dielectric and as metal, continue one of them, and return a sentence.

    The mean PSNR of the training images over the second half of the steps decides; both see the same views.
    Metal has to be better by METAL_GAIN.
    """
    begin = time.perf_counter()
    dielectric, metal = (_begun(trainer, metallic, steps) for metallic in (DIELECTRIC, METAL))
    is_metal = metal[0] >= dielectric[0] + METAL_GAIN
    trainer.restore((metal if is_metal else dielectric)[1].state())
    trainer.fit.optimiser.set_factor("metallic", 1.0)
    trainer.fit.seconds = time.perf_counter() - begin
    scores = f"{metal[0]:.2f} dB as metal, {dielectric[0]:.2f} dB as dielectric"
    trainer.fit.decisions.append(asdict(Decision("metal", 0, is_metal, scores)))
    return f"metallic starts as {'metal' if is_metal else 'dielectric'}: {scores}"


def _begun(trainer: Trainer, metallic: float, steps: int) -> tuple[float, Trainer]:
    """Mean PSNR (dB), and the fit after some steps with this metallic everywhere."""
    surfels = trainer.method.surfels
    surfels = replace(surfels, initial={**surfels.initial, "metallic": metallic})
    # Every step is logged, so that it evaluates its error.
    method = replace(trainer.method, surfels=surfels, log_every=1)
    copy = Trainer(method, trainer.data, targets=trainer.targets)
    copy.fit.optimiser.set_factor("metallic", 0.0)
    found = []
    for step in range(steps):
        copy.step()
        trainer.release()
        if step >= steps // 2:
            assert copy.error is not None
            found.append(psnr_of(float(copy.error[0])))
    return float(np.mean(found)), copy
