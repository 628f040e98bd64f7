"""Registration of a camera: the rigid correction of its pose that fits renders to its image.

Gauss-Newton from coarse images to fine ones, on differences as displayed; derivatives are differences of
renders. [Lucas and Kanade 1981; coarse to fine: Bergen et al. 1992]
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from mi_refgs.data.view import View

STEP = 0.1
"""Pixels that the image moves by for a difference."""
COARSEST = 48  # pixels along the shorter side of the coarsest image at least
ROUNDS = 5  # Gauss-Newton steps per image size
DAMPING = 1e-3
"""Of the diagonal [Levenberg 1944]: a flat scene hardly distinguishes rotation from translation."""
ENOUGH = 1e-3  # relative decrease of the squared error below which a size is finished

Render = Callable[[View], np.ndarray]  # display-encoded image (H, W, 3) of a view's camera


def registered(view: View, render: Render, distance: float, where: np.ndarray | None = None) -> View:
    """The view with the pose whose render differs least from its image.

    `distance`: of what the camera looks at, scene units. `where` (H, W) bool: pixels that count, by default
    all. `render` is called with views of smaller images too. The pose stays if no other is better.
    """
    view, block = view.load(), 1
    pixels = np.ones((view.height, view.width), bool) if where is None else where
    while min(view.width, view.height) // (2 * block) >= COARSEST:
        block *= 2
    while block:
        level = view if block == 1 else view.averaged(block)
        chosen = pixels[::block, ::block][: level.height, : level.width]
        view = replace(view, to_world=_fitted(level, render, distance, chosen).to_world)
        block //= 2
    return view


def _fitted(view: View, render: Render, distance: float, where: np.ndarray) -> View:
    """The view with its pose fitted at the size of its image."""
    truth = np.clip(view.displayed[where], 0, 1)

    def difference(moved: View) -> np.ndarray:
        return (np.clip(render(moved)[where], 0, 1) - truth).ravel().astype(np.float64)

    unit = np.repeat([1.0, distance], 3) / view.fx  # moves what the camera looks at by a pixel
    now = difference(view)
    for _ in range(ROUNDS):
        shifts = [difference(_moved(view, STEP * unit * axis)) - now for axis in np.eye(6)]
        slope = np.stack(shifts, axis=1) / STEP
        normal = slope.T @ slope
        change, *_ = np.linalg.lstsq(normal + DAMPING * np.diag(np.diag(normal)), -slope.T @ now, rcond=None)
        candidate = _moved(view, unit * change)
        after = difference(candidate)
        before, now_squared = float(now @ now), float(after @ after)
        if not now_squared < before:
            break
        view, now = candidate, after
        if now_squared > (1 - ENOUGH) * before:
            break
    return view


def _moved(view: View, motion: np.ndarray) -> View:
    """The view with its camera rotated (3, radians) and moved (3, scene units) along its own axes."""
    from scipy.spatial.transform import Rotation

    change = np.eye(4)
    change[:3, :3], change[:3, 3] = Rotation.from_rotvec(motion[:3]).as_matrix(), motion[3:]
    return replace(view, to_world=view.to_world @ change)
