"""World frame of a capture: +z against gravity, the region of interest is the unit ball around the origin.
Rotation, position and scale are estimated from how cameras are held and where they look."""

from dataclasses import replace
from functools import partial

import numpy as np

from mi_refgs.capture.colmap import Solved
from mi_refgs.data.hull import axis_projectors
from mi_refgs.data.object_region import object_region
from mi_refgs.data.region import CAMERA_SHARE, Region, region_radius, weighted_quantile
from mi_refgs.errors import InputError

ROUNDS = 50  # iterations of reweighted least squares, which converge to the least sum of absolute values
SEEN_SHARE = 0.5  # fraction of the cameras whose images must show a point; other points are background


def up_direction(solved: Solved, up: np.ndarray) -> np.ndarray:
    """The direction (3,) against gravity; `up` (V, 2): (right, down) of the upward direction in each image.
    It is orthogonal to the right-hand directions of all images, by least absolute values, which is robust to
    rolled ones; if all look the same way, it is the mean upward direction."""
    right = np.stack([-up[:, 1], up[:, 0]], axis=1)
    to_world = solved.rotation.transpose(0, 2, 1)[:, :, :2]
    rights, ups = np.einsum("vij,vj->vi", to_world, right), np.einsum("vij,vj->vi", to_world, up)
    mean = ups.mean(axis=0)
    weight = np.ones(len(rights))
    for _ in range(ROUNDS):
        values, vectors = np.linalg.eigh(np.einsum("v,vi,vj->ij", weight, rights, rights) / weight.sum())
        weight = 1 / np.maximum(abs(rights @ vectors[:, 0]), 1e-3)
    if values[1] < 0.02 * values.sum():  # within ± 8° of one line, which spans no plane
        line = vectors[:, 2]
        direction = mean - (mean @ line) * line
    else:
        direction = vectors[:, 0] * (1 if vectors[:, 0] @ mean >= 0 else -1)
    return direction / max(float(np.linalg.norm(direction)), 1e-12)


def focus_of(solved: Solved) -> np.ndarray:
    """The point (3,) with the least sum of distances to the view axes; the median point for parallel axes."""
    projectors = axis_projectors(solved.axis)
    if projectors is None:
        return np.median(solved.points, axis=0)
    weight = np.ones(len(projectors))
    for _ in range(ROUNDS):
        weighted = weight[:, None, None] * projectors
        focus = np.linalg.solve(weighted.sum(axis=0), np.einsum("vij,vj->i", weighted, solved.origin))
        distance = np.linalg.norm(np.einsum("vij,vj->vi", projectors, focus - solved.origin), axis=1)
        weight = 1 / np.maximum(distance, 1e-3 * np.median(distance) + 1e-12)
    return focus


def seen_share(solved: Solved, points: np.ndarray) -> np.ndarray:
    """Fraction (N,) of the cameras that see points (N, 3) within the largest cone inside their image."""
    share = np.zeros(len(points))
    for origin, axis, angle in zip(solved.origin, solved.axis, solved.half_angle, strict=True):
        offset = points - origin
        share += offset @ axis > np.cos(angle) * np.linalg.norm(offset, axis=1)
    return share / len(solved.origin)


def region_of_interest(solved: Solved) -> Region:
    """A sphere around the point at which most cameras look, above what supports the object. Its radius is
    that of `region_radius`, smaller or larger if points that half of the cameras see say so."""
    focus = focus_of(solved)
    radius = region_radius(np.linalg.norm(solved.origin - focus, axis=1), solved.half_angle)
    if not radius > 0:
        what, remedy = "a camera is at the point at which all look", "walk around an object"
        raise InputError(what, "photographs", remedy=remedy)
    offset = np.linalg.norm(solved.points - focus, axis=1)
    near = offset < radius
    near[near] = seen_share(solved, solved.points[near]) >= SEEN_SHARE
    if np.count_nonzero(near) >= 50:  # with fewer, the cameras alone determine the radius
        reach = weighted_quantile(offset[near], solved.length[near], 0.9)
        radius = max(reach, 0.5 * radius)  # points are only where the object has texture
    sphere, seen = Region(tuple(map(float, focus)), radius), partial(seen_share, solved)
    found = object_region(sphere, solved.origin, solved.points, seen)
    nearest = float(np.linalg.norm(solved.origin - np.array(found.centre), axis=1).min())
    return replace(found, radius=min(found.radius, CAMERA_SHARE * nearest))  # a fit encloses what is outside


def upright_unit(solved: Solved, up: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Scale, rotation (3, 3) and translation (3,) that make +z up and the region the unit ball around 0; the
    first camera looks along +y."""
    z = up_direction(solved, up)
    forward = solved.axis[0] - (solved.axis[0] @ z) * z
    if np.linalg.norm(forward) < 1e-3:  # it looks straight down
        forward = np.cross(z, np.eye(3)[np.argmin(abs(z))])
    y = forward / np.linalg.norm(forward)
    rotation = np.stack([np.cross(y, z), y, z])
    region = region_of_interest(solved)
    scale = 1 / region.radius
    return scale, rotation, -scale * rotation @ np.array(region.centre)
