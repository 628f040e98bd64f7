"""A few dozen training steps under extreme lights and pictures: is everything still finite?"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks.step import make_trainer, sphere_data
from mi_refgs.fitting.state import FitSetup
from mi_refgs.kernels.device import upload_tensor
from mi_refgs.methods.method import LIGHT

SURFELS, SIZE, VIEWS, STEPS = 300, 32, 3, 24


def measure() -> list[dict[str, Any]]:
    """One row a case: loss of the first and the last step, values that are not finite."""
    return [fit(name) for name in CASES]


def _with_peak(view: Any) -> dict[str, Any]:
    image = view.image.copy()
    image[SIZE // 2, SIZE // 2] = 1e6
    return {"image": image, "is_linear_radiance": True}


CASES: dict[str, dict[str, Any]] = {
    "plain": {},
    "a texel of the light starts at 1e6": {"light": lambda raw: np.where(np.arange(raw.size) < 3, 1e6, raw)},
    "the whole light starts at 1e6": {"light": lambda raw: np.full_like(raw, 1e6)},
    "the light starts black (raw -80)": {"light": lambda raw: np.full_like(raw, -80.0)},
    "a pixel of 1e6 in linear pictures": {"view": _with_peak},
    "over-exposed pictures": {"view": lambda v: {"image": np.ones_like(v.image)}},
    "under-exposed pictures": {"view": lambda v: {"image": 1 - v.alpha[..., None] + 0 * v.image}},
    "all-transparent pictures": {
        "view": lambda v: {"image": np.ones_like(v.image), "alpha": np.zeros_like(v.alpha)}
    },
}


def fit(name: str) -> dict[str, Any]:
    """STEPS steps in each stage of the full method; pictures change after the start, which needs masks."""
    trainer, method = make_trainer(SURFELS, sphere_data(SIZE, VIEWS, np.random.default_rng(0)))
    case = CASES[name]
    if "view" in case:
        views = tuple(replace(view, **case["view"](view)) for view in trainer.data.views)
        data = replace(trainer.data, views=views, is_linear_radiance=views[0].is_linear_radiance)
        trainer.adopt(FitSetup(method, data), trainer.state())
    if "light" in case:
        raw = trainer.params[LIGHT].numpy()
        trainer.params[LIGHT] = upload_tensor(case["light"](raw.ravel()).reshape(raw.shape))
        trainer.fit.optimiser.reset(LIGHT)
    losses = []
    for _, stage in method.stages():
        if stage.shading.at == "pixel":
            trainer.extract_mesh()
        for _ in range(STEPS):
            trainer.step()
            losses.append(float(trainer.loss[0]))
        trainer.iteration = stage.until  # the next stage
    values = [*(x.numpy() for x in trainer.params.values()), np.array(losses)]
    return {
        "name": name,
        "steps": len(losses),
        "first": losses[0],
        "last": losses[-1],
        "non_finite": sum(int(np.sum(~np.isfinite(x))) for x in values),
    }
