"""Lights in image files: lat-long images, and cubes and angular maps, which become lat-long."""

import os
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from scipy.ndimage import map_coordinates

from mi_refgs.errors import InputError, counted
from mi_refgs.io.exr import EXR_MAGIC, read_exr_light
from mi_refgs.io.files import require_file
from mi_refgs.io.hdr import read_hdr
from mi_refgs.io.images import box_downscale, linear_from_srgb, read_bytes
from mi_refgs.io.progress import note
from mi_refgs.shade.light.lobe_matrices import map_directions, resample

MAX_ROWS = 4096  # most rows that are kept of a map: 400 MB of float32
CONVERTED_ROWS = 512  # most rows of a map that was a cube or an angular map
EVEN = 0.01  # range of values, by the median of the picture, where a cross or an angular map has no picture
R, U, F = AXES = np.diag((-1.0, 1.0, 1.0))  # right, up, front: from inside, the middle of a lat-long image
FACES = np.array([[R, -F, U], [-R, F, U], [U, R, -F], [-U, R, F], [F, R, U], [-F, -R, U]])
"""Of the faces of a cube in OpenGL's order: the middle, the directions along rows and up columns."""
CROSSES = {
    (4, 3): [(1, 2), (1, 0), (0, 1), (2, 1), (1, 1), (1, 3)],
    (3, 4): [(1, 2), (1, 0), (0, 1), (2, 1), (1, 1), (3, 1)],
}
"""Row and column of each face, by columns and rows of the cross; below the bottom, the back is turned."""


def read_radiance(path: str | os.PathLike[str], rows: int = MAX_ROWS) -> np.ndarray:
    """Linear radiance (h, w, 3) float32 ≥ 0 of an EXR, HDR, PNG or JPEG file, averaged to at most `rows` rows
    and 2 · `rows` columns: lat-long, or converted from a cube (EXR's `envmap`; six faces in a row, column or
    cross) or an angular map (disc in a square). Raises InputError for others and above `files.MAX_PIXELS`."""
    path = Path(path)
    image, layout = read_image(path)
    if below := int(np.count_nonzero((image < 0).any(axis=-1))):
        note(path, f"{counted(below, 'texel')} below 0 set to 0")
        image = np.maximum(image, 0)
    height, width, _ = image.shape
    size, limit = f"{width} × {height} pixels", min(rows, CONVERTED_ROWS)
    if min(height, width) < 2:
        raise InputError(f"{size} are no lat-long image", path, "environment", "give 2 × 2 at least")
    if layout == "cube" and height != 6 * width:
        raise InputError(f"a cube, but of {size}", path, "envmap", "export six square faces in a column")
    if layout != "lat-long" and (faces := _faces(image, layout)) is not None:
        if layout is None:
            note(path, f"{size} are read as the faces of a cube, in OpenGL's order")
        n = faces.shape[1]
        span = n - 1 if layout == "cube" else n  # the outer pixels of OpenEXR's faces are on edges
        image = _lat_long(faces, partial(_on_cube, span=span / n), min(2 * n, limit), 4 * n)
    elif layout is None and _is_disc(image):
        note(path, f"{size} are read as an angular map (light probe), not as a photograph of a mirror ball")
        rim = 1 - 1.5 / width  # beyond, pixels are mixed with those outside
        image = _lat_long(image[None], partial(_on_disc, rim=rim), min(max(width // 2, 2), limit), width)
    elif abs(width - 2 * height) > 2:
        note(path, f"{size} are stretched over the sphere; a lat-long image is twice as wide as high")
    height, width, _ = image.shape
    return np.ascontiguousarray(resample(image, min(height, rows), min(width, 2 * rows)))


def read_image(path: Path) -> tuple[np.ndarray, str | None]:
    """Linear colour (h, w, 3) float32 of a file, whose first bytes say its format, and `exr.Part.layout`."""
    require_file(path)
    with path.open("rb") as file:
        first = file.read(4)
    if first[:2] == b"#?":
        return read_hdr(path), None
    if first == EXR_MAGIC:
        return read_exr_light(path)
    pixels = read_bytes(path)[0][..., :3].astype(np.float32)
    return np.asarray(linear_from_srgb(pixels / np.float32(255))), None


def _is_even(outside: np.ndarray, picture: np.ndarray) -> bool:
    """Whether pixels (…, 3) outside of a picture have one colour, such as black."""
    return bool(np.ptp(outside.reshape(-1, 3), axis=0).max() <= EVEN * np.median(picture))


def _faces(image: np.ndarray, layout: str | None) -> np.ndarray | None:
    """The faces (6, n, n, 3) of a cube as those of FACES; None for other images."""
    height, width, _ = image.shape
    if height == 6 * width or (width == 6 * height and layout is None):
        faces = np.stack(np.split(image, 6, axis=0 if height > width else 1))
        if layout == "cube":  # of OpenEXR (ImfEnvmap.h): the first two are swapped, the next two upside down
            faces = np.concatenate([faces[1::-1], faces[2:4, ::-1, ::-1], faces[4:]])
        return faces
    for (columns, rows), cells in CROSSES.items():
        n = width // columns
        if (columns * n, rows * n) == (width, height) and layout is None:
            grid = image.reshape(rows, n, columns, n, 3).swapaxes(1, 2)
            faces = np.stack([grid[cell] for cell in cells])
            faces[5] = faces[5, ::-1, ::-1] if rows > columns else faces[5]
            rest = [grid[cell] for cell in np.ndindex(rows, columns) if cell not in cells]
            return faces if _is_even(np.stack(rest), faces) else None
    return None


def _is_disc(image: np.ndarray) -> bool:
    """Whether an image is square, and even outside of its largest disc."""
    height, width, _ = image.shape
    radius = np.hypot(*np.ogrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j])
    outside = radius > 1 + 4 / width
    return height == width and outside.any() and _is_even(image[outside], image[radius < 1])


def _on_cube(directions: np.ndarray, span: float) -> tuple[np.ndarray, ...]:
    """Where directions (m, 3) are on FACES, whose edges are at ± `span`."""
    along = (directions @ FACES.reshape(18, 3).T).reshape(-1, 6, 3)
    face = along[..., 0].argmax(axis=1)
    depth, right, up = along[np.arange(len(face)), face].T
    return face, -up * span / depth, right * span / depth


def _on_disc(directions: np.ndarray, rim: float) -> tuple[np.ndarray, ...]:
    """Where directions (m, 3) are on an angular map: the distance from its middle is proportional to the
    angle from the front. [Debevec, "Rendering synthetic objects into real scenes", 1998]"""
    right, up, front = AXES @ directions.T
    across = np.hypot(right, up)
    scale = np.minimum(np.arctan2(across, front) / np.pi, rim) / np.maximum(across, 1e-9)
    return np.zeros(len(up), int), -up * scale, right * scale


def _lat_long(
    pictures: np.ndarray, place: Callable[[np.ndarray], tuple[np.ndarray, ...]], height: int, turn: int
) -> np.ndarray:
    """A lat-long image of square pictures (k, n, n, 3) with `turn` pixels in 360°; `place` returns the number
    of a picture, and the place in it from -1 to 1, down and to the right."""
    n = pictures.shape[1]
    factor = next(f for f in range(max(turn // (4 * height), 1), 0, -1) if n % f == 0)
    pictures = np.stack([box_downscale(picture, factor) for picture in pictures])
    n //= factor

    def row(directions: np.ndarray) -> np.ndarray:
        picture, down, right = place(directions)
        at = picture, (n * (1 + down) - 1) / 2, (n * (1 + right) - 1) / 2
        planes = np.moveaxis(pictures, -1, 0)
        return np.stack([map_coordinates(plane, at, order=1, mode="nearest") for plane in planes], -1)

    return resample(np.stack([row(directions) for directions in map_directions(2 * height)]), height)
