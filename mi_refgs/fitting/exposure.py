"""Per-image exposure compensation: exposure and white balance that differ between training images.

View v shows encode(g_v L) of linear radiance L, with a gain g_v per channel. The parameter is log g (V, 3); a
step subtracts its mean over the views, so the scene keeps its scale.

Whether a data set requires gains is decided once, on training views: gains that are fitted to half of the
pixels of a view are judged on the other half. Three numbers do not overfit 10⁴ pixels, so the decision
requires no validation views. If gains do not improve the other half, the fit stays bit for bit what it was.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.data.dataset import Dataset
from mi_refgs.data.exposure import MAX_GAIN, fitted_gain
from mi_refgs.data.view import View, evenly_spread
from mi_refgs.fitting.optim import Adam
from mi_refgs.fitting.schedule import FitSetup
from mi_refgs.fitting.state import FitState
from mi_refgs.io.images import psnr_of
from mi_refgs.kernels.device import upload_tensor
from mi_refgs.methods.method import GAIN, CameraOptions, ExposureOptions
from mi_refgs.render.display import displayed
from mi_refgs.render.pipeline import Frame
from mi_refgs.runs.checkpoint import OPTIMISER, PARAMS
from mi_refgs.types import Float, TensorXf

JUDGES = 32
"""Views that the decision is based on, spread evenly: the mean over them has an error of a tenth of a dB."""
BLOCK = 16
"""Pixels along a side of the squares of the checkerboard that halves an image: larger than the blocks of
JPEG, 8 pixels."""
EXIF_SPREAD = 0.02  # standard deviation of log exposures below which EXIF exposures count as equal
EXPOSURE_FILE = "exposure.json"  # of a run: the decision and the gains


def initial_gains(setup: FitSetup) -> dict[str, TensorXf]:
    """The parameter log g (V, 3) at the start, by its name: from EXIF data, if every image has them."""
    log = exif_gains(setup.data)
    if setup.exposure is None or setup.method.select is not None or log is None:
        return {}
    return {GAIN: upload_tensor(log)}


def log_gain(params: Mapping[str, TensorXf], view: int) -> list[Float] | None:  # three of width 1
    """log g of a view, under AD; None if the fit has no gains."""
    table = params.get(GAIN)
    if table is None:
        return None
    mean = dr.mean(dr.detach(table), axis=0).array
    first = dr.opaque(mi.UInt32, 3 * view)
    return [dr.gather(mi.Float, table.array, first + c) - dr.gather(mi.Float, mean, c) for c in range(3)]


def gains_of(params: Mapping[str, TensorXf]) -> np.ndarray | None:
    """Gains (V, 3) of the training views, of geometric mean 1; waits for the device."""
    if GAIN not in params:
        return None
    log = params[GAIN].numpy()
    return np.asarray(np.exp(log - log.mean(axis=0)))


# ---------------- the decision ----------------

Render = Callable[[View], Frame]  # renders a view of the present state


def is_due(
    setup: FitSetup,
    state: FitState,
    options: ExposureOptions | CameraOptions | None,
    decision: dict[str, Any] | None,  # that was made
) -> bool:
    """Whether the decision about gains, or about the cameras, is to be made now.

    A method that selects components is fitted to some of the views until it has selected them: not before.
    """
    select = setup.method.select
    if options is None or decision is not None or state.iteration < options.after:
        return False
    return select is None or {*select.component} <= {row["component"] for row in state.decisions}


def checkerboard(view: View) -> np.ndarray:
    """Half of the pixels of a view, (H, W) bool: every other square of BLOCK² pixels."""
    row, column = np.indices((view.height, view.width)) // BLOCK
    return np.asarray((row + column) % 2 == 0)


def decide(setup: FitSetup, iteration: int, render: Render) -> dict[str, Any]:
    """Judge gains by rendering some training views; see the module's docstring."""
    views, options = setup.data.views, setup.exposure
    assert options is not None
    chosen = evenly_spread(len(views), JUDGES)
    without, with_it = np.mean([_judge(views[i], setup.data, render) for i in chosen], axis=0)
    return {
        "iteration": iteration,
        "gains": options.gains == "on" or bool(with_it - without >= options.worth),
        "psnr": float(without),
        "psnr_gain": float(with_it),
        "views": len(chosen),
    }


def _judge(view: View, data: Dataset, render: Render) -> tuple[float, float]:
    """PSNR (dB) on half of the pixels of a view, without a gain and with one fitted to the other half."""
    frame = render(view)
    fitted = checkerboard(view)
    _, image = with_gain(frame, view, data, fitted)
    found = [psnr(shown, view, ~fitted) for shown in (image_of(displayed_of(frame, data), view), image)]
    return found[0], found[1]


def with_gains(state: Mapping[str, np.ndarray], log: np.ndarray | None) -> dict[str, np.ndarray]:
    """Replace the gains in a checkpoint's content by these log gains (V, 3), without history, or by none."""
    own = (f"{PARAMS}{GAIN}", f"{OPTIMISER}{GAIN}/")
    found = {name: value for name, value in state.items() if not name.startswith(own)}
    if log is not None:
        found[f"{PARAMS}{GAIN}"] = (log - log.mean(axis=0)).astype(np.float32)
        found |= {f"{OPTIMISER}{name}": x for name, x in Adam.fresh_state(GAIN, log.size).items()}
    return found


def record(setup: FitSetup, state: FitState) -> dict[str, Any] | None:
    """The decision and the gains by view, as a run records them; None if nothing was decided."""
    if state.exposure is None:
        return None
    gains, names = gains_of(state.params), [view.name for view in setup.data.views]
    by_view = {} if gains is None else dict(zip(names, gains.round(5).tolist(), strict=True))
    return state.exposure | {"gain": by_view}


def exif_gains(data: Dataset) -> np.ndarray | None:
    """Log gains (V, 3) from EXIF data, 0 for the median, within the limits of `fitted_gain`.

    None if a view has no such data, or all have the same.
    """
    log = [view.exposure for view in data.views]
    if any(value is None for value in log):
        return None
    values, limit = np.array(log, dtype=np.float64), np.log(MAX_GAIN)
    if values.std() < EXIF_SPREAD:
        return None
    gains = np.clip(values - np.median(values), -limit, limit)
    return np.repeat(gains[:, None], 3, axis=1).astype(np.float32)


def with_gain(
    frame: Frame, view: View, data: Dataset, where: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """The `fitted_gain` (3,) of a rendered view, and its image (H, W, 3) with that gain."""
    planes, alpha = list(frame.radiance), image_of([frame.alpha], view)[..., 0]
    if frame.background is not None:  # the image is opaque
        planes = [a + (1 - frame.alpha) * b for a, b in zip(planes, frame.background, strict=True)]
        alpha = np.ones_like(alpha)
    radiance = image_of(planes, view)
    gain = fitted_gain(radiance, alpha, view, data.background, where)
    return gain, image_of(displayed_of(frame, data, gain), view)


def displayed_of(frame: Frame, data: Dataset, gain: np.ndarray | None = None) -> list[Float]:
    """`displayed` with an opaque gain, which is not compiled into the kernel."""
    factors = None if gain is None else [dr.opaque(mi.Float, float(g)) for g in gain]
    return displayed(frame, data.background, data.is_linear_radiance, factors)


def squared_error(image: np.ndarray, view: View) -> np.ndarray:
    """Squared error (H, W, 3) of a display-encoded image (H, W, 3) of a view, both clipped to [0, 1]."""
    return np.square(np.clip(image, 0, 1) - np.clip(view.load().displayed, 0, 1))


def psnr(image: np.ndarray, view: View, where: np.ndarray | None = None) -> float:
    """PSNR (dB) of a display-encoded image (H, W, 3) of a view, over the pixels in `where` (H, W)."""
    square = squared_error(image, view)
    return psnr_of(float(square.mean() if where is None else square[where].mean() if where.any() else 0))


def sentence(decision: dict[str, Any]) -> str:
    """A decision as one sentence."""
    verdict = "one gain per image and channel" if decision["gains"] else "no gains per image"
    change = decision["psnr_gain"] - decision["psnr"]
    return f"exposure: {verdict}; tried on half of the pixels, they change the others by {change:+.2f} dB"


def image_of(planes: list[Float], view: View) -> np.ndarray:
    """Convert planes of a frame to (H, W, C)."""
    values = [np.broadcast_to(np.array(plane), view.height * view.width) for plane in planes]
    return np.stack(values, axis=-1).reshape(view.height, view.width, -1)
