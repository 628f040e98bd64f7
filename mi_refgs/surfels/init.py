"""Initial surfels, one per point; `data.hull` finds such points. The order of surfels in memory."""

from collections.abc import Mapping, Sequence

import numpy as np
import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from mi_refgs.errors import InputError
from mi_refgs.surfels.attributes import ATTRIBUTES, MAX_SH_DEGREE, SH_DC, attribute
from mi_refgs.surfels.primitives.primitive import PRIMITIVES
from mi_refgs.surfels.table import Surfels

DISTANCE_FLOOR = 1e-4  # least distance of neighbours, in extents of the points: keeps the log scale finite
DRAWS, ROUNDS = 8, 4  # of `even_points`: draws per point, and moves to the centres of cells
APART = 2.0  # distances of neighbours that the opposite sides of a sheet are half apart
NEIGHBOURS = 3  # their mean squared distance gives the scale [3DGS]
MORTON_BITS = 10  # log₂ of the cells along an axis: they are smaller than the distance of surfels
MORTON_OUTLIERS = 0.01  # fraction of points at either end of an axis that are put into the outermost cells


def from_points(
    points: np.ndarray,  # (N, 3) world
    normals: np.ndarray | None = None,  # (N, 3) any length
    colours: np.ndarray | None = None,  # (N, 3) linear radiance
    *,
    rng: np.random.Generator,
    primitive: str = "surfel",
    attributes: Sequence[str] | None = None,
    degree: Mapping[str, int] | None = None,
    scale_factor: float = 1.0,
    largest: np.ndarray | None = None,  # (N,)
    **initial: float | np.ndarray,
) -> Surfels:
    """Surfels at points: scale from the 3 nearest neighbours, normal as given or uniform at random.

    largest: bound of the scales. attributes: those beside the geometry (default: all). degree: of spherical
    harmonics by attribute, 0 by default. initial: activated values by attribute, such as `roughness=0.3`.
    colours: of the constant coefficient of radiance_sh (grey 0.5 by default). Raises InputError for wrong
    shapes, NaN in points, unknown attributes and values out of range.
    """
    points = _check("points", points, np.shape(points)[:1])
    count = len(points)
    for name in (*(attributes or ()), *(degree or ()), *initial):
        attribute(name)
    for name, wanted in (degree or {}).items():
        if not 0 <= wanted <= MAX_SH_DEGREE:
            what = f"degree of {name}: {wanted} is not in 0 … {MAX_SH_DEGREE}"
            raise InputError(what, "surfels", remedy="choose one")
    if normals is not None:
        normals = _check("normals", normals, (count,))
    kind = PRIMITIVES.find(primitive, "primitive")
    spacing = np.minimum(neighbour_scale(points) * scale_factor, np.inf if largest is None else largest)
    raw = {"position": points, **kind.start(spacing, quaternions(normals, count, rng))}
    for name, declared in ATTRIBUTES.items():
        chosen = not declared.geometry if attributes is None else name in attributes
        if name not in raw and (name in kind.widths or chosen):
            width = declared.width((degree or {}).get(name, 0))
            raw[name] = declared.start(count, width, rng, initial.pop(name, None))
    for name in initial:
        raise InputError("follows from the points or is not in `attributes`", "surfels", name, "leave it out")
    if colours is not None and "radiance_sh" in raw:
        raw["radiance_sh"][:, :3] = (_check("colours", colours, (count,)) - 0.5) / SH_DC
    return Surfels.from_numpy({name: raw[name] for name in ATTRIBUTES if name in raw})


def even_points(
    vertices: np.ndarray, faces: np.ndarray, count: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Points (count, 3) evenly spread on triangles, and the unit normals there: uniform draws, then the
    centres of their cells [Lloyd 1982], which are parts of one side of a thin sheet. InputError without area.
    """
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    if count < 1 or not mesh.area > 0:
        what = f"{count} points on an area of {mesh.area:g}"
        raise InputError(what, "surfels", "mesh", "give triangles and a number from 1")
    drawn, face = trimesh.sample.sample_surface(mesh, DRAWS * count, seed=int(rng.integers(2**31)))
    normals = np.asarray(mesh.face_normals[face])
    place = np.concatenate([drawn / np.sqrt(mesh.area / count), APART * normals], axis=1)
    chosen = np.arange(count)
    for _ in range(ROUNDS):
        _, cell = cKDTree(place[chosen]).query(place)
        total = np.stack([np.bincount(cell, column, count) for column in place.T], axis=1)
        size = np.bincount(cell, minlength=count)[:, None]
        chosen = cKDTree(place).query(np.where(size > 0, total / np.maximum(size, 1), place[chosen]))[1]
    return np.asarray(drawn[chosen]), normals[chosen]


def neighbour_scale(points: np.ndarray) -> np.ndarray:
    """Root mean squared distance (N,) of each point to its 3 nearest, above DISTANCE_FLOOR of the extent; of
    points at one place that is their distance from the origin, or 1."""
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


def morton_order(points: np.ndarray) -> np.ndarray:
    """Order (N,) of points (N, 3) along a Z-shaped space-filling curve; stable. [Morton 1966]"""
    if len(points) == 0:
        return np.zeros(0, dtype=np.int64)
    low, high = np.quantile(points, (MORTON_OUTLIERS, 1 - MORTON_OUTLIERS), axis=0)
    edge = max(float((high - low).max()), np.finfo(np.float32).tiny)
    cell = np.clip((points - low) / edge * 2**MORTON_BITS, 0, 2**MORTON_BITS - 1).astype(np.uint32)
    cell_index = np.zeros(len(points), dtype=np.uint32)
    for bit in range(MORTON_BITS):
        for axis in range(3):
            cell_index |= (cell[:, axis] >> bit & 1) << (3 * bit + axis)
    return np.argsort(cell_index, kind="stable")


def _check(name: str, values: np.ndarray, rows: tuple[int, ...]) -> np.ndarray:
    array = np.asarray(values, dtype=np.float64)
    if array.shape != (*rows, 3):
        expected = f"expected {(*rows, 3)}; give one row of three per point"
        raise InputError(f"shape {array.shape}, {expected}", "surfels", name)
    if bad := np.count_nonzero(~np.isfinite(array)):
        raise InputError(f"{bad} values are NaN or infinite", "surfels", name, "remove those points")
    return array
