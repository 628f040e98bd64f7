"""Registration of a camera: the rigid correction of its pose that fits renders to its image, by Levenberg's
and Marquardt's method from averaged images to whole ones; derivatives are differences of displayed renders.
[Lucas and Kanade 1981; coarse to fine: Bergen et al. 1992]"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from mi_refgs.data.view import View
from mi_refgs.io.images import blocks_within, box_downscale

STEP = 0.1  # pixels of the averaged image that the image moves by for a difference
CLOSE = 0.1  # pixels of the image that a pose may move by, each way, with the derivatives of where it began
COARSEST = 48  # pixels along the shorter side of the image that is averaged most, at least

Render = Callable[[View], np.ndarray]  # display-encoded image (H, W, 3) of a view's camera


def registered(view: View, render: Render, distance: float, where: np.ndarray) -> View:
    """The view, posed for least difference in `where` (H, W) bool; `distance` of its target, scene units."""
    view, blocks = view.load(), [1]
    while min(view.width, view.height) // (2 * blocks[0]) >= COARSEST:
        blocks.insert(0, 2 * blocks[0])
    found = view
    for block in blocks:
        found, moved = _fitted(found, render, distance, where, block)
    if moved > CLOSE:  # derivatives of a pose farther away are rough
        found, _ = _fitted(found, render, distance, where, 1)
    errors = [np.mean(_difference(one, render, where, 1) ** 2) for one in (view, found)]
    return found if errors[1] < errors[0] else view


def _difference(view: View, render: Render, where: np.ndarray, block: int) -> np.ndarray:
    """Render minus image, flat, both averaged over block² pixels, of which those `where` count: smaller
    renders differ in details."""
    shown, truth = (box_downscale(np.clip(image, 0, 1), block) for image in (render(view), view.displayed))
    return np.asarray(shown - truth, np.float64)[where].ravel()


def _fitted(view: View, render: Render, distance: float, where: np.ndarray, block: int) -> tuple[View, float]:
    """The view, its pose fitted to the image averaged over block × block pixels, and how many it moved by."""
    unit = np.repeat([1.0, distance], 3) * block / view.fx  # moves what the camera looks at by such a pixel
    where = blocks_within(where, block)

    def error(motion: np.ndarray) -> np.ndarray:
        return _difference(_moved(view, unit * motion), render, where, block)

    # Derivatives are those of the first pose: taken anew after every change, they cost most of the time.
    first = error(np.zeros(6))
    slope = np.stack([(error(STEP * axis) - first) / STEP for axis in np.eye(6)], axis=1)
    found = least_squares(error, np.zeros(6), lambda _: slope, method="lm", ftol=1e-3, max_nfev=6)
    return _moved(view, unit * found.x), abs(found.x).max()


def _moved(view: View, motion: np.ndarray) -> View:
    """The view with its camera rotated (3, radians) and moved (3, scene units) along its own axes."""
    change = np.eye(4)
    change[:3, :3], change[:3, 3] = Rotation.from_rotvec(motion[:3]).as_matrix(), motion[3:]
    return replace(view, to_world=view.to_world @ change)
