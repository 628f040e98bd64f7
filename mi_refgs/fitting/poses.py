"""Corrections of the training cameras: a small rigid motion of each camera, fitted together with the scene.

The camera of view v is rotated about the point that the cameras look at, then moved. A row of the parameter
(V, 6) is the axis times 2 tan(θ/2) of the rotation by θ, and the translation over half of the width that the
median view shows there, both along the axes of the camera: so each number moves the image about equally. A
step subtracts the mean over the views, along the world's axes, so the scene stays where it is. Gradients are
exact but for what `render.pipeline` lists: visibility and traced rays have none.

Whether a data set requires corrections is decided once, on training views: poses that are registered with
half of the pixels of a view are judged on the other half, as gains are (`fitting.exposure`). If they do not
improve the other half, the fit stays bit for bit what it was.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.data.registration import registered
from mi_refgs.data.view import View, evenly_spread
from mi_refgs.fitting.exposure import checkerboard, psnr
from mi_refgs.fitting.optim import Adam
from mi_refgs.fitting.schedule import FitSetup
from mi_refgs.fitting.state import FitState
from mi_refgs.methods.method import POSE
from mi_refgs.runs.checkpoint import OPTIMISER, PARAMS
from mi_refgs.splat import Camera
from mi_refgs.types import TensorXf

JUDGES = 8
"""Views that the decision is based on, spread evenly; each takes some dozens of renders."""


def corrected(setup: FitSetup, params: Mapping[str, TensorXf], view: int, camera: Camera) -> Camera:
    """The camera of a training view, at any resolution, with its correction, under AD.

    Itself if the fit has no corrections.
    """
    table = params.get(POSE)
    if table is None:
        return camera
    # All rows along the world's axes, and their mean.
    number = dr.arange(mi.UInt32, dr.width(table.array))
    three, axis = number // 3, number % 3  # rows of three numbers, two per view
    matrix, world = three // 2 * 9 + axis * 3, mi.Float(0)
    for i in range(3):
        entry = dr.gather(mi.Float, setup.camera_axes, matrix + i)
        world += entry * dr.gather(mi.Float, table.array, 3 * three + i)
    mean = dr.mean(mi.TensorXf(dr.detach(world), shape=table.shape), axis=0).array

    # The motion of this camera.
    first = dr.opaque(mi.UInt32, 6 * view)
    row = [dr.gather(mi.Float, world, first + i) - dr.gather(mi.Float, mean, i) for i in range(6)]
    rotation = dr.quat_to_matrix(mi.Matrix3f, dr.normalize(mi.Quaternion4f(*(0.5 * x for x in row[:3]), 1)))
    centre = mi.Point3f(*(dr.opaque(mi.Float, x) for x in setup.focus))
    return camera.displaced(rotation, centre, dr.opaque(mi.Float, setup.reach) * mi.Vector3f(*row[3:]))


def camera_of(setup: FitSetup, params: Mapping[str, TensorXf], view: int) -> Camera:
    """The corrected camera of a training view, without derivatives."""
    with dr.suspend_grad():
        return corrected(setup, params, view, setup.data.views[view].camera())


def decide(setup: FitSetup, iteration: int, shown: Callable[[int, View], np.ndarray]) -> dict[str, Any]:
    """Judge corrections by registering some training views; see the module's docstring.

    `shown(i, view)` renders the display-encoded image (H, W, 3) of training view i with the camera of `view`.
    """
    options, views = setup.cameras, setup.data.views
    assert options is not None
    chosen, extent, found = evenly_spread(len(views), JUDGES), setup.data.scene_extent, []
    for i in chosen:
        view, fitted = views[i].load(), checkerboard(views[i])
        moved = registered(view, lambda camera, i=i: shown(i, camera), extent, fitted)  # type: ignore[misc]
        found.append([psnr(shown(i, one), view, ~fitted) for one in (view, moved)])
    without, with_it = np.mean(found, axis=0)
    return {
        "iteration": iteration,
        "corrected": options.corrections == "on" or bool(with_it - without >= options.worth),
        "psnr": float(without),
        "psnr_registered": float(with_it),
        "judges": len(chosen),
    }


def with_corrections(setup: FitSetup, state: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Add corrections of zero, without history, to a checkpoint's content."""
    rows = np.zeros((len(setup.data.views), 6), np.float32)
    history = {f"{OPTIMISER}{name}": x for name, x in Adam.fresh_state(POSE, rows.size).items()}
    return {**state, f"{PARAMS}{POSE}": rows, **history}


def record(setup: FitSetup, state: FitState) -> dict[str, Any] | None:
    """The decision and the corrected poses, as a run records them; None if nothing was decided."""
    if state.cameras is None:
        return None
    poses = {}
    if POSE in state.params:
        for i, view in enumerate(setup.data.views):
            poses[view.name] = camera_of(setup, state.params, i).pose().tolist()
    return state.cameras | {"to_world": poses}


def sentence(decision: Mapping[str, Any]) -> str:
    """A decision as one sentence."""
    verdict = "corrected" if decision["corrected"] else "not corrected"
    change = decision["psnr_registered"] - decision["psnr"]
    return (
        f"cameras: {verdict}; registered with half of the pixels, they change the others by {change:+.2f} dB"
    )
