"""Parameters with a row per training view: exposure gains, and corrections of the cameras.

View v shows encode(g_v L) of linear radiance L, with a gain g_v per channel; the parameter is log g (V, 3).

The camera of view v is rotated about the point that the cameras look at, then moved. A row of the parameter
(V, 6) is the axis times 2 tan(θ/2) of the rotation by θ, and the translation over half of the width that the
median view shows there, both along the axes of the camera: so each number moves the image about equally.
The mean over the views is subtracted when a row is read, that of corrections along the world's axes: the
scene keeps its brightness and its place."""

from collections.abc import Mapping

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.fitting.schedule import FitSetup
from mi_refgs.methods.method import GAIN, POSE
from mi_refgs.splat import Camera
from mi_refgs.types import Float, TensorXf


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


def corrected(setup: FitSetup, params: Mapping[str, TensorXf], view: int, camera: Camera) -> Camera:
    """The camera of a training view, at any resolution, with its correction if it has one, under AD."""
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
