"""Fits to images and from lights nobody would wish for: numbers stay finite, or one sentence ends them."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mi_refgs.data.dataset import Dataset, View
from mi_refgs.errors import InputError
from mi_refgs.fitting.train import Trainer
from mi_refgs.io.images import linear_from_srgb
from mi_refgs.kernels.device import upload_tensor
from mi_refgs.methods.method import LIGHT
from tests.helpers import with_pixels
from tests.scenes.highlight import ball, small_method

STEPS = 14
"""Into the deferred stage, with the first mesh, a reset and two rounds of densifying."""
SIZE = (24, 24)


def changed(
    image: Callable[[View], np.ndarray] | None = None,
    linear: bool = False,
    views: int = 6,
    **alpha: np.ndarray | None,
) -> Dataset:
    """The ball with other images, or other alpha."""
    data, found = ball(views=views), []
    for view in data.views:
        pixels = alpha if image is None else {"image": image(view), **alpha}
        found.append(replace(with_pixels(view, **pixels), is_linear_radiance=linear))
    return replace(data, views=tuple(found), is_linear_radiance=linear)


def radiance(view: View, peak: float) -> np.ndarray:
    """The ball in linear, premultiplied radiance on white; its highlight reaches `peak`."""
    linear = linear_from_srgb(view.image).astype(np.float32)
    assert view.alpha is not None
    linear[(view.alpha > 0) & (view.image.min(axis=-1) > 0.5)] = peak
    return linear


CASES: dict[str, Callable[[], Dataset]] = {
    "black": lambda: changed(lambda view: 0 * view.image),
    "white": lambda: changed(lambda view: np.ones_like(view.image)),
    "under-exposed": lambda: changed(lambda view: np.round(view.image * 3) / 255),
    "over-exposed": lambda: changed(lambda view: np.minimum(50 * view.image, 1)),
    "opaque everywhere": lambda: changed(alpha=np.ones(SIZE, np.float32)),
    "without alpha": lambda: changed(alpha=None),
    "black without alpha": lambda: changed(lambda view: 0 * view.image, alpha=None),
    "two views": lambda: changed(views=2),
    "peak of 1e6": lambda: changed(lambda view: radiance(view, 1e6), linear=True),
    "peak of 1e30": lambda: changed(lambda view: radiance(view, 1e30), linear=True),
}

LIGHTS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "a texel of the light starts at 1e6": lambda raw: np.concatenate([[np.full_like(raw[0], 1e6)], raw[1:]]),
    "the whole light starts at 1e6": lambda raw: np.full_like(raw, 1e6),
    "the light starts black": lambda raw: np.full_like(raw, -80),
}


@pytest.mark.parametrize("name", [*CASES, *LIGHTS])
def test_fit_stays_finite(name: str, tmp_path: Path) -> None:
    method = replace(small_method(tmp_path), iterations=STEPS)
    trainer = Trainer(method, CASES.get(name, ball)(), warn=pytest.fail)
    if name in LIGHTS:
        raw = trainer.fit.params[LIGHT].numpy()
        trainer.fit.params[LIGHT] = upload_tensor(LIGHTS[name](raw.reshape(-1, 3)).reshape(raw.shape))
        trainer.fit.optimiser.reset(LIGHT)
    trainer.train()
    assert trainer.iteration == STEPS and trainer.health.skipped == 0
    for key, values in trainer.fit.arrays().items():
        assert np.all(np.isfinite(values)), key
    frame = trainer.view(trainer.data.views[0].camera())
    assert all(np.all(np.isfinite(plane.numpy())) for plane in [*frame.radiance, frame.alpha])


@pytest.mark.parametrize("data", [changed(alpha=np.zeros(SIZE, np.float32)), changed(views=1)])
def test_what_cannot_be_begun_is_one_sentence(data: Dataset, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"^\w+: [^.]*; [^.]*$"):
        Trainer(small_method(tmp_path), data)
