"""The image of a case of options in float64: maps of the reference, and sensor, film and AOVs in NumPy."""

import math
from dataclasses import replace

import numpy as np
from scipy.ndimage import maximum_filter

from benchmarks.stability.exact import filters
from mi_refgs import constants as c
from mi_refgs.occlusion.visibility import ALONG, OFFSET_VOXELS
from mi_refgs.reference import image, occlusion
from mi_refgs.reference.camera import PinholeCamera, look_at, rotation_axes
from mi_refgs.reference.footprint import GEOMETRY
from mi_refgs.reference.light import Light, filtered
from mi_refgs.reference.models import Options, hemisphere, unit
from mi_refgs.reference.splat import primitive_of, sorted_rows
from mi_refgs.render.samples import samples_per_axis
from mi_refgs.shade import brdf
from mi_refgs.shade.light import lobe_matrices
from tests.laws.covering import Case
from tests.laws.option_cases import CROPS, FOV, HEIGHT, NEAR, WIDTH
from tests.laws.option_scenes import AROUND, BACKDROP, Values, aov_types, mesh, rotation, shading, surfels_of

Array = np.ndarray
XYZ = np.array([[0.412453, 0.35758, 0.180423], [0.212671, 0.71516, 0.072169], [0.019334, 0.119193, 0.950227]])
"""From linear sRGB. [Mitsuba's srgb_to_xyz]"""


def camera_of(case: Case) -> tuple[PinholeCamera, tuple[int, int], int]:
    """The camera of the samples, the place of the first in its tile, and samples along each axis."""
    x, y, width, height = CROPS[case["crop"]]
    k = samples_per_axis(case["samples"])
    focal = -WIDTH / 2 / math.tan(math.radians(FOV) / 2) * k
    pose = look_at(np.array([3.0, 1, 2]), np.zeros(3), (0, 0, 1))
    centre = (WIDTH / 2 - x) * k, (HEIGHT / 2 - y) * k
    tile = c.tile_size(abs(focal), fine=case["primitive"] == "surfel")
    corner = x * k % tile[0], y * k % tile[1]
    film = (-x * k, (WIDTH - x) * k), (-y * k, (HEIGHT - y) * k)
    return PinholeCamera(width * k, height * k, focal, focal, *centre, pose, NEAR, film), corner, k


class Oracle:
    def __init__(self, case: Case, first: Values) -> None:
        self.case, self.window, shown = case, (slice(None), slice(None)), case
        if case["accuracy"] == "antialias":  # normals are interpolated with pixels beside the crop window
            x, y, width, height = CROPS[case["crop"]]
            shown, self.window = case | {"crop": "none"}, (slice(y, y + height), slice(x, x + width))
        self.camera, self.corner, self.per_axis = camera_of(shown)
        self.pixels = np.arange(self.camera.width * self.camera.height)
        self.own = [*surfels_of(first).raw]
        self.visible: Array | None = None

        first = {name: np.asarray(x, np.float64) for name, x in first.items()}
        own, around = self._tables(first)
        self.order = sorted_rows([own, around], self.camera, self.pixels, self.corner)
        chosen = shading(case)
        self.options = Options(dominant=chosen.dominant, directions=chosen.directions)
        if chosen.reflectance == "monte_carlo":
            normal = _facing(own, self.camera)
            free = _free(own["position"], normal, chosen.directions) if chosen.occlusion else None
            self.options = replace(self.options, detached_normal=normal, free=free)

        maps, band = self._maps(first)
        for alpha in (maps["alpha"], maps["object_alpha"]):
            band |= np.abs(alpha - c.COVERAGE_FLOOR)[:, 0] < 0.5 * c.COVERAGE_FLOOR
        self.band = band
        if chosen.antialias:  # what a pixel interpolates must be decided, too
            shape = self.camera.height, self.camera.width
            self.band = maximum_filter(band.reshape(shape), 3).ravel()

    def image(self, values: Values) -> Array:
        values = {name: np.asarray(x, np.float64) for name, x in values.items()}
        return self._developed(self._maps(values)[0])[self.window]

    def undecided(self) -> Array:
        """Pixels (H, W) of which a sample is near a discontinuity."""
        return self._blocks(self.band.astype(float)[:, None])[self.window][..., 0] > 0

    def _tables(self, values: Values) -> tuple[dict[str, Array], dict[str, Array]]:
        """Raw channels of the object, and of the surroundings, which may have no rows."""
        own = {n: values[n] for n in self.own}
        empty = {n: np.zeros((0, own[n].shape[1])) for n in (*GEOMETRY, "radiance_sh")}
        return own, {n: values.get(AROUND + n, rows) for n, rows in empty.items()}

    def _maps(self, values: Values) -> tuple[dict[str, Array], Array]:
        chosen, (own, around) = shading(self.case), self._tables(values)
        scene = image.Scene(
            own, self.camera, self.pixels, self.order, chosen.at, chosen.reflectance, chosen.diffuse,
            light_of(self.case, values), options=self.options, terms=True, antialias=chosen.antialias,
            around=around, background=values.get("background", np.full((8, 16, 3), -np.inf)),
        )  # fmt: skip
        if chosen.occlusion and chosen.model.visibility == "mirror":
            scene = replace(scene, visibility=self._visibility)
        found = image.render(scene)
        visible = np.ones((len(self.pixels), 1)) if self.visible is None else self.visible[:, None]
        if self.options.free is not None:  # the mean over directions, blended as a material is
            share = np.clip(self.options.free.mean(1, keepdims=True), 1e-15, 1 - 1e-15)
            marked = own | {"roughness": np.log(share / (1 - share))}
            visible = image.render(replace(scene, raw=marked, terms=False)).maps["roughness"]
        return found.maps | {"visibility": visible}, found.band

    def _visibility(self, normal: Array, ray: Array) -> Array:
        """Visibility (P,) of the mirror direction, that of the first image."""
        if self.visible is None:
            found, eye = mesh(), self.camera.to_world[:3, 3]
            start = OFFSET_VOXELS * found.voxel, ALONG
            self.visible = occlusion.mirror_visibility(found.vertices, found.faces, eye, normal, ray, *start)
        return self.visible

    def _blocks(self, values: Array) -> Array:
        k = self.per_axis
        height, width = self.camera.height // k, self.camera.width // k
        return np.asarray(values).reshape(height, k, width, k, -1).mean(axis=(1, 3))

    def _developed(self, maps: dict[str, Array]) -> Array:
        case = self.case
        rgb, alpha = maps["radiance"], maps["alpha"]
        coverage = self._blocks(alpha)
        if case["background"] != "none":
            behind = maps["background"] if case["background"] == "map" else np.array(BACKDROP)
            rgb, coverage = rgb + (1 - alpha) * behind, np.ones_like(coverage)
        elif case["input"] == "run" and case["surroundings"]:  # opaque over black
            coverage = np.ones_like(coverage)
        colour = self._blocks(rgb)
        if case["colour"] != "rgb":
            colour = colour @ (XYZ if case["colour"] == "xyz" else XYZ[1:2]).T
        channels = [colour, coverage] if case["alpha"] else [colour]
        return np.concatenate(channels + [self._aov(name, maps) for name in aov_types(case)], axis=-1)

    def _aov(self, kind: str, maps: dict[str, Array]) -> Array:
        """One AOV (H, W, n): means over the samples of premultiplied values, divided once."""
        alpha, share = self._blocks(maps["alpha"]), self._blocks(maps["object_alpha"])
        if kind == "alpha":
            return alpha
        if kind in image.TERMS:
            return self._blocks(maps[kind])
        if kind == "normal":
            mean = self._blocks(maps["normal"])
            length = np.linalg.norm(mean, axis=-1, keepdims=True)
            return np.where(alpha > c.COVERAGE_FLOOR, mean / np.where(length > 0, length, 1), 0)
        if kind == "depth":
            along = (maps["depth"] - NEAR) * self._ray_lengths()  # distances, which are averaged
            distance = self._blocks(along * maps["alpha"]) / np.where(alpha > 0, alpha, 1)
            return np.where(alpha > c.COVERAGE_FLOOR, distance, 0)
        mean = self._blocks(maps[kind] * maps["object_alpha"]) / np.where(share > 0, share, 1)
        return np.where(share > c.COVERAGE_FLOOR, mean, 0)

    def _ray_lengths(self) -> Array:
        camera = self.camera
        x = (self.pixels % camera.width + 0.5 - camera.cx) / camera.fx
        y = (self.pixels // camera.width + 0.5 - camera.cy) / camera.fy
        return np.sqrt(1 + x**2 + y**2)[:, None]


def map_of(case: Case, values: Values) -> Array:
    if "light" in values:
        own = np.logaddexp(0, values["light"])
        return own if own.ndim == 3 else np.tile(own, (8, 16, 1))
    if "radiance" in values:
        return np.tile(values["radiance"], (8, 16, 1))
    own = values["data"] * values["brightness"]
    return lobe_matrices.resample(own, 8) if case["map"] == "9 x 14" else own


def light_of(case: Case, values: Values) -> Light:
    radiance = map_of(case, values)
    levels = filtered(radiance, filters(len(radiance)))
    if case["map"] == "constant" and case["emitter"] != "tensor":
        levels = [np.broadcast_to(radiance[0, 0], level.shape) for level in levels]
    return Light(levels, lobe_matrices.LEVEL_ROUGHNESS, brdf.table().astype(np.float64), rotation(case).T)


def _facing(raw: dict[str, Array], camera: PinholeCamera) -> Array:
    axes = np.stack(rotation_axes(raw["rotation"]))
    normal = axes[primitive_of(raw).normal(raw), np.arange(len(raw["rotation"]))]
    direction = unit(raw["position"] - camera.to_world[:3, 3])
    away = np.sum(normal * direction, 1, keepdims=True) > c.FACING_TOLERANCE
    return np.where(away, -normal, normal)


def _free(position: Array, normal: Array, count: int) -> Array:
    found, free = mesh(), []
    for place, about in zip(position, normal, strict=True):
        rays = hemisphere(count, about)
        start = place + occlusion.beyond(about, rays, OFFSET_VOXELS * found.voxel, ALONG)
        free.append(~np.isfinite(occlusion.mesh_distance(found.vertices, found.faces, start, rays)))
    return np.stack(free)
