"""Error budget: how the squared error of test images divides among silhouettes, creases and smooth surfaces.
Pixels are classified by ground truth alone, so that the classes of two runs on one data set are the same."""

from dataclasses import dataclass, field
from typing import Any

import mitsuba as mi
import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter

from mi_refgs.data.view import View
from mi_refgs.evaluation.images import RenderedView
from mi_refgs.evaluation.metrics import FOREGROUND_ALPHA, angle_deg, foreground
from mi_refgs.evaluation.scores import PIXEL_CLASSES
from mi_refgs.evaluation.surface import TrueSurface
from mi_refgs.kernels.device import upload

OUTLINE_PIXELS = 2  # distance from the object's outline, along rows or columns, of silhouette pixels
CREASE_DEGREES = 25.0  # turn of the normal between neighbouring pixels from which a surface is creased
CLASSES = tuple(PIXEL_CLASSES)


def classify(view: View, surface: TrueSurface | None) -> np.ndarray | None:
    """Index in CLASSES (H, W) of each pixel of a loaded view; None without true depth and normals."""
    if view.depth is None or view.normal is None:
        return None
    camera, covered, shape = view.camera(), view.covered(), view.depth.shape
    hit = foreground(view.normal, covered) & (view.depth > 0)
    ray = camera.rays()
    point = camera.origin + ray * upload(view.depth)
    smooth = np.full(shape, CLASSES.index("smooth"))
    if surface is not None:
        normal = mi.Vector3f(view.normal.reshape(-1, 3).T)
        mirrored = ray - 2 * mi.Vector3f(normal * (normal @ ray))
        free = surface.occluder.visible(mi.Point3f(point), mirrored, normal, upload(hit, mi.Bool)).numpy()
        unblocked = free.reshape(shape) > 0
        smooth = np.where(unblocked, CLASSES.index("mirror_free"), CLASSES.index("mirror_blocked"))
    window = 2 * OUTLINE_PIXELS + 1
    outline = maximum_filter(covered, window) - minimum_filter(covered, window) > FOREGROUND_ALPHA
    found = np.where(hit, smooth, CLASSES.index("background"))
    found[_creased(point.numpy().T.reshape(*shape, 3), view.normal, hit)] = CLASSES.index("crease")
    found[outline] = CLASSES.index("silhouette")
    return found


def _creased(point: np.ndarray, normal: np.ndarray, hit: np.ndarray) -> np.ndarray:
    """Find pixels (H, W) on either side of a crease or depth edge; points and unit normals (H, W, 3)."""
    found = np.zeros(hit.shape, bool)
    most = np.radians(CREASE_DEGREES)
    for axis in (0, 1):
        p, n, h, out = (np.swapaxes(values, 0, axis) for values in (point, normal, hit, found))
        chord = p[1:] - p[:-1]
        chord = chord / np.maximum(np.linalg.norm(chord, axis=-1, keepdims=True), 1e-30)
        rise = np.maximum(*(np.abs(np.sum(chord * side, axis=-1)) for side in (n[1:], n[:-1])))
        turned = np.sum(n[1:] * n[:-1], axis=-1) < np.cos(most)
        edge = h[1:] & h[:-1] & (turned | (rise > np.sin(most)))
        out[1:] |= edge
        out[:-1] |= edge
    return found


@dataclass
class ErrorBudget:
    """Accumulates pixels, squared errors and normal errors per class over views."""

    sums: np.ndarray = field(default_factory=lambda: np.zeros((4, len(CLASSES))))
    """Pixels; squared errors of displayed colours; angles of normals in degrees; pixels with an angle."""

    def add(self, rendered: RenderedView, view: View, classes: np.ndarray | None) -> None:
        """Add the pixels of a loaded view with the classes (H, W) that `classify` returned."""
        if classes is None or view.normal is None:
            return
        ours, true = (np.clip(image, 0, 1).astype(np.float64) for image in (rendered.image, view.displayed))
        known = foreground(view.normal, view.covered())
        angle = np.where(known, angle_deg(rendered.normal, view.normal), 0)
        values = np.ones(classes.shape), np.sum((ours - true) ** 2, axis=-1), angle, known
        self.sums += [np.bincount(classes.ravel(), x.ravel(), len(CLASSES)) for x in values]

    def result(self) -> dict[str, Any]:
        """Return `error_budget` of metrics.json: per class the shares of `pixels` and of `squared_error`, and
        `normal_mae_deg`. None, with a reason, if no view has ground truth."""
        pixels, squared, angle, known = self.sums
        if not pixels.any():
            reason = "the data set has no ground-truth depth and normals"
            return {"error_budget": None, "error_budget_reason": reason}
        budget = {
            name: {
                "pixels": float(pixels[i] / pixels.sum()),
                "squared_error": float(squared[i] / max(squared.sum(), 1e-30)),
                "normal_mae_deg": float(angle[i] / known[i]) if known[i] else None,
            }
            for i, name in enumerate(CLASSES)
            if pixels[i]
        }
        return {"error_budget": budget, "error_budget_reason": None}
