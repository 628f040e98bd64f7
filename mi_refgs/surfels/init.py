"""Initial surfels: one for each of the points that a scene starts from; `data.hull` finds such points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from mi_refgs.errors import InputError
from mi_refgs.surfels.attributes import ATTRIBUTES, MAX_SH_DEGREE, SH_DC, attribute
from mi_refgs.surfels.primitives import PRIMITIVES
from mi_refgs.surfels.table import Surfels

# Least distance to the neighbours, as part of the points' extent: keeps the log scale of doubled points
# finite. 2DGS has 3e-4 scene units, whatever the unit.
DISTANCE_FLOOR = 1e-4
# Neighbours whose mean squared distance gives the scale. [3DGS]
NEIGHBOURS = 3


def from_points(
    points: np.ndarray,  # (N, 3) world
    normals: np.ndarray | None = None,  # (N, 3) any length
    colours: np.ndarray | None = None,  # (N, 3) linear radiance
    *,
    rng: np.random.Generator,
    primitive: str = "surfel",
    channels: Sequence[str] | None = None,
    degree: Mapping[str, int] | None = None,
    scale_factor: float = 1.0,
    largest: np.ndarray | None = None,  # (N,)
    **initial: float | np.ndarray,
) -> Surfels:
    """One `primitive` per point: size from its 3 nearest neighbours, normal as given or uniform at random.

    Sizes are at most `largest`. The tangents are turned at random about the normal. `channels` beside the
    geometry (default: all that are declared); `degree` of spherical harmonics by channel, 0 by default;
    `initial` activated values by channel, such as `roughness=0.3`, by default those of `surfels.channels`.
    `colours` fill the DC of radiance_sh (grey 0.5 by default). Rotations are uniform over SO(3), not over
    positive components as in the released Ref-Gaussian. Raises InputError for wrong shapes, NaN, unknown
    channels or values out of range.
    """
    points = _check("points", points, np.shape(points)[:1])
    count = len(points)
    for name in (*(channels or ()), *(degree or ()), *initial):
        attribute(name)
    for name, wanted in (degree or {}).items():
        if not 0 <= wanted <= MAX_SH_DEGREE:
            raise InputError(f"surfels: degree of {name}: {wanted} is not in 0 … {MAX_SH_DEGREE}; choose one")
    if normals is not None:
        normals = _check("normals", normals, (count,))
    kind = PRIMITIVES.find(primitive, "primitive")
    raw = {"position": points}
    spacing = neighbour_scale(points) * scale_factor
    spacing = spacing if largest is None else np.minimum(spacing, largest)
    raw |= kind.start(spacing, quaternions(normals, count, rng))
    for name, declared in ATTRIBUTES.items():
        chosen = not declared.geometry if channels is None else name in channels
        if name not in raw and (name in kind.widths or chosen):
            width = declared.width((degree or {}).get(name, 0))
            raw[name] = declared.start(count, width, rng, initial.get(name))
    if colours is not None and "radiance_sh" in raw:
        raw["radiance_sh"][:, :3] = (_check("colours", colours, (count,)) - 0.5) / SH_DC
    return Surfels.from_numpy({name: raw[name] for name in ATTRIBUTES if name in raw})


def neighbour_scale(points: np.ndarray) -> np.ndarray:
    """Root mean squared distance (N,) of each point to its 3 nearest neighbours.

    It is at least DISTANCE_FLOOR of the points' extent, the longest side of their box; where they are all at
    one place, of its distance from the origin, or of 1.
    """
    if not len(points):
        return np.zeros(0)
    extent = float(np.ptp(points, axis=0).max()) or float(np.linalg.norm(points[0])) or 1.0
    wanted = min(NEIGHBOURS, len(points) - 1)
    distance = np.zeros((len(points), 1))
    if wanted:
        distance = cKDTree(points).query(points, k=wanted + 1)[0][:, 1:]
    return np.maximum(np.sqrt(np.mean(distance**2, axis=1)), DISTANCE_FLOOR * extent)


def random_normals(count: int, rng: np.random.Generator) -> np.ndarray:
    """Unit vectors (count, 3), uniform on the sphere."""
    normals = rng.normal(size=(count, 3))
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


def quaternions(normals: np.ndarray | None, count: int, rng: np.random.Generator) -> np.ndarray:
    """Unit quaternions (count, 4), x y z w, whose third axis is the normal; without normals uniform."""
    free = rng.normal(size=(count, 4))
    free /= np.linalg.norm(free, axis=1, keepdims=True)
    if normals is None or count == 0:
        return free
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    n = np.where(length > 0, normals / np.where(length > 0, length, 1), [0.0, 0.0, 1.0])
    tangent = np.cross(n, free[:, :3])
    short = np.linalg.norm(tangent, axis=1) < 1e-6
    tangent[short] = np.cross(n[short], np.eye(3)[np.argmin(np.abs(n[short]), axis=1)])
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    return Rotation.from_matrix(np.stack([tangent, np.cross(n, tangent), n], axis=-1)).as_quat()


def _check(name: str, values: np.ndarray, rows: tuple[int, ...]) -> np.ndarray:
    array = np.asarray(values, dtype=np.float64)
    if array.shape != (*rows, 3):
        raise InputError(
            f"surfels: {name}: shape {array.shape}, expected {(*rows, 3)}; give one row of three per point"
        )
    bad = int(np.count_nonzero(~np.isfinite(array)))
    if bad:
        raise InputError(f"surfels: {name}: {bad} values are NaN or infinite; remove those points")
    return array
