"""Gains of the training views: exposure and white balance that differ from picture to picture.

View v shows encode(g_v L) of linear radiance L, g_v a factor a channel. The parameter is log g (V, 3); what a
step uses has the mean over views subtracted, so the scene keeps its scale.

Whether a data set needs gains is decided once, on training views: gains that are fitted to half of the pixels
of a view are judged on the other half, which they have not seen. Three numbers fit no noise of 10⁴ pixels, so
the verdict needs no views of its own, and where gains do not pay the fit stays what it was, bit for bit.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.data.dataset import Dataset
from mi_refgs.data.exposure import MAX_GAIN, fitted_gain
from mi_refgs.data.view import View
from mi_refgs.errors import InputError
from mi_refgs.fitting.optim import Adam, Group
from mi_refgs.io.images import psnr_of
from mi_refgs.kernels.device import upload_tensor
from mi_refgs.methods.method import GAIN, ExposureOptions
from mi_refgs.render.display import displayed
from mi_refgs.render.pipeline import Frame
from mi_refgs.runs.checkpoint import OPTIMISER, PARAMS

if TYPE_CHECKING:
    from mi_refgs.fitting.train import Trainer

JUDGES = 32
"""Views that judge, spread evenly: the mean over them has an error of a tenth of a dB."""
BLOCK = 16
"""Pixels along a side of the squares of the checkerboard that parts a picture: larger than what its pixels
share, such as JPEG's 8."""
EXIF_SPREAD = 0.02
"""Standard deviation of log exposures below which EXIF tells no difference."""
EXPOSURE_FILE = "exposure.json"
"""File of a run with the decision and the gains."""


class Exposure:
    """The gains of a fit: if there are any, from when on, and what a step sees of them."""

    def __init__(self, trainer: Trainer) -> None:
        self.trainer = trainer
        self.decision: dict[str, Any] | None = None
        self.tell: Callable[[str], None] = lambda _: None

    @property
    def _options(self) -> ExposureOptions | None:
        """What the method says, unless it has no gains."""
        options = self.trainer.method.exposure
        return None if options is None or options.gains == "off" else options

    def start(self) -> dict[str, Any]:
        """The parameter at the start of a fit, by its name: of EXIF data, where all pictures have them."""
        log = exif_gains(self.trainer.data)
        if self._options is None or self.trainer.method.select is not None or log is None:
            return {}
        return {GAIN: upload_tensor(log)}

    def groups(self) -> dict[str, Group]:
        """The learning rate, by the parameter's name."""
        options = self._options
        if options is None or GAIN not in self.trainer.params:
            return {}
        return {GAIN: Group(options.rate, 0.1 * options.rate, self.trainer.method.iterations)}

    def log_gain(self, view: int) -> list[Any] | None:
        """log g of a view, three mi.Float of width 1, under AD; None where the fit has no gains."""
        table = self.trainer.params.get(GAIN)
        if table is None:
            return None
        mean = dr.mean(dr.detach(table), axis=0).array
        first = dr.opaque(mi.UInt32, 3 * view)
        return [dr.gather(mi.Float, table.array, first + c) - dr.gather(mi.Float, mean, c) for c in range(3)]

    def gains(self) -> np.ndarray | None:
        """The gains (V, 3) of the training views, their geometric mean 1; waits for the device."""
        table = self.trainer.params.get(GAIN)
        if table is None:
            return None
        log = table.numpy()
        return np.asarray(np.exp(log - log.mean(axis=0)))

    # ---------------- the decision ----------------

    def decide(self, iteration: int) -> None:
        """Once, when it falls due: judge, and go on with gains or without; see the module's docstring.

        A method that selects terms has to be done with that, since it fits a part of the views until then.
        """
        fit, options = self.trainer, self._options
        select = fit.method.select
        if options is None or self.decision is not None or iteration < options.after:
            return
        if select is not None and len(fit.decisions) < len(select.term):
            return
        views = fit.data.views
        chosen = np.unique(np.linspace(0, len(views) - 1, min(JUDGES, len(views))).round().astype(int))
        without, with_it = np.mean([self._judge(views[i]) for i in chosen], axis=0)
        on = options.gains == "on" or bool(with_it - without >= options.worth)
        self.decision = {
            "iteration": iteration,
            "gains": on,
            "psnr": float(without),
            "psnr_gain": float(with_it),
            "views": len(chosen),
        }
        self.tell(sentence(self.decision))
        if on or GAIN in fit.params:
            self._restart(np.log([self._fitted(view) for view in views]) if on else None)

    def _judge(self, view: View) -> tuple[float, float]:
        """PSNR (dB) on half of the pixels of a view, without a gain and with one fitted to the other half."""
        frame, data = self._frame(view), self.trainer.data
        row, column = np.indices((view.height, view.width)) // BLOCK
        fitted = (row + column) % 2 == 0
        _, image = with_gain(frame, view, data, fitted)
        found = [psnr(shown, view, ~fitted) for shown in (picture(displayed_of(frame, data), view), image)]
        return found[0], found[1]

    def _fitted(self, view: View) -> np.ndarray:
        return with_gain(self._frame(view), view, self.trainer.data)[0]

    def _frame(self, view: View) -> Frame:
        return self.trainer.view(view.camera(), aovs=False)

    def _restart(self, log: np.ndarray | None) -> None:
        """Go on with these log gains (V, 3), without history, or with none: as a fit that is resumed does."""
        fit = self.trainer
        fit.check()
        own = (f"{PARAMS}{GAIN}", f"{OPTIMISER}{GAIN}/")
        state = {name: value for name, value in fit.state().items() if not name.startswith(own)}
        if log is not None:
            state[f"{PARAMS}{GAIN}"] = (log - log.mean(axis=0)).astype(np.float32)
            state |= {f"{OPTIMISER}{name}": x for name, x in Adam.fresh_state(GAIN, log.size).items()}
        fit.restore(state)

    # ---------------- state ----------------

    def state(self) -> dict[str, np.ndarray]:
        """What a checkpoint holds beside the parameter."""
        if self.decision is None:
            return {}
        return {"exposure": np.frombuffer(json.dumps(self.decision).encode(), np.uint8)}

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Take over what a checkpoint holds; raises InputError if it has gains of other views."""
        found = state.get("exposure")
        self.decision = None if found is None else json.loads(found.tobytes().decode())
        gains, views = state.get(f"{PARAMS}{GAIN}"), len(self.trainer.data.views)
        if gains is not None and len(gains) != views:
            raise InputError(
                f"{self.trainer.data.path}: frames: {views} training views, but the checkpoint has gains of "
                f"{len(gains)}; resume with the data set that the run began with"
            )

    def record(self) -> dict[str, Any] | None:
        """The decision and the gains by view, as a run records them; None if nothing was decided."""
        if self.decision is None:
            return None
        gains = self.gains()
        names = [view.name for view in self.trainer.data.views]
        by_view = {} if gains is None else dict(zip(names, gains.round(5).tolist(), strict=True))
        return self.decision | {"gain": by_view}


def exif_gains(data: Dataset) -> np.ndarray | None:
    """Log gains (V, 3) by EXIF data, 0 for the median, within the limits of `fitted_gain`.

    None where a view has no such data or all have the same.
    """
    log = [view.exposure for view in data.views]
    if any(value is None for value in log):
        return None
    values = np.array(log, dtype=np.float64)
    if values.std() < EXIF_SPREAD:
        return None
    limit = np.log(MAX_GAIN)
    gains = np.clip(values - np.median(values), -limit, limit)
    return np.repeat(gains[:, None], 3, axis=1).astype(np.float32)


def with_gain(
    frame: Frame, view: View, data: Dataset, where: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """The `fitted_gain` (3,) of a rendered view, and the picture (H, W, 3) that it shows with it."""
    planes, alpha = list(frame.radiance), picture([frame.alpha], view)[..., 0]
    if frame.background is not None:  # all that is seen, nothing is cut out
        planes = [a + (1 - frame.alpha) * b for a, b in zip(planes, frame.background, strict=True)]
        alpha = np.ones_like(alpha)
    radiance = picture(planes, view)
    gain = fitted_gain(radiance, alpha, view, data.background, where)
    return gain, picture(displayed_of(frame, data, gain), view)


def displayed_of(frame: Frame, data: Dataset, gain: np.ndarray | None = None) -> list[Any]:
    """`displayed` with a gain that is no part of the kernel."""
    factors = None if gain is None else [dr.opaque(mi.Float, float(g)) for g in gain]
    return displayed(frame, data.background, data.is_linear_radiance, factors)


def psnr(image: np.ndarray, view: View, where: np.ndarray | None = None) -> float:
    """PSNR (dB) of a display-encoded picture (H, W, 3) of a view, over the pixels in `where` (H, W)."""
    square = np.square(np.clip(image, 0, 1) - np.clip(view.load().displayed, 0, 1))
    return psnr_of(float(square.mean() if where is None else square[where].mean() if where.any() else 0))


def sentence(decision: dict[str, Any]) -> str:
    """A decision as one sentence."""
    verdict = "a gain a channel of every view stays" if decision["gains"] else "no gains"
    change = decision["psnr_gain"] - decision["psnr"]
    return f"exposure: {verdict}: {change:+.2f} dB on pixels that they were not fitted to"


def picture(planes: list[Any], view: View) -> np.ndarray:
    """Planes of a frame as (H, W, C)."""
    size = view.height, view.width
    values = [np.broadcast_to(np.array(plane), view.height * view.width).reshape(size) for plane in planes]
    return np.stack(values, axis=-1)
