"""The image of a case of options in float64: maps of the reference, and sensor, film and AOVs in NumPy."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import mitsuba as mi
import numpy as np

from mi_refgs import constants as c
from mi_refgs.occlusion.visibility import OFFSET_VOXELS, Occluder
from mi_refgs.reference import image, losses, occlusion
from mi_refgs.reference.camera import PinholeCamera, look_at, rotation_axes
from mi_refgs.reference.footprint import GEOMETRY
from mi_refgs.reference.models import Light, Options, hemisphere, unit
from mi_refgs.reference.splat import primitive_of, sorted_rows
from mi_refgs.render.pipeline import Request, SurfelScene, render
from mi_refgs.render.samples import samples_per_axis
from mi_refgs.render.surroundings import Surroundings, nothing_around
from mi_refgs.shade import brdf
from mi_refgs.shade.ambient import update_occluder_caches
from mi_refgs.shade.light import lobe_matrices
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.light.light import ConstantLight, RotatedLight
from mi_refgs.splat.camera import Camera
from tests.laws.covering import Case
from tests.laws.option_cases import CROPS, HEIGHT, WIDTH
from tests.laws.option_scenes import (
    AROUND,
    BACKDROP,
    FOV,
    NEAR,
    Values,
    aov_types,
    mesh,
    rotation,
    shading,
    surfels_of,
)

Array = np.ndarray
XYZ = np.array(
    [[0.412453, 0.357580, 0.180423], [0.212671, 0.715160, 0.072169], [0.019334, 0.119193, 0.950227]]
)
"""From linear sRGB. [Mitsuba's srgb_to_xyz]"""
BAND = 1e-4
MATERIALS = {"albedo": 3, "metallic": 1, "roughness": 1, "tint": 3}
TRACED = ("visibility rays", "traced bounces", "ambient rays")
"""Occlusion by many rays, which the reference does not have: its maps are those of `render`."""


def camera_of(case: Case) -> tuple[PinholeCamera, tuple[int, int], int]:
    """The camera of the samples, the place of the first in its tile, and samples along each axis."""
    x, y, width, height = CROPS[case["crop"]]
    k = samples_per_axis(case["samples"])
    focal = -WIDTH / 2 / math.tan(math.radians(FOV) / 2) * k
    pose = look_at(np.array([3.0, 1, 2]), np.zeros(3), (0, 0, 1))
    centre = (WIDTH / 2 - x) * k, (HEIGHT / 2 - y) * k
    tile = c.tile_size(abs(focal))
    corner = x * k % tile[0], y * k % tile[1]
    film = (-x * k, (WIDTH - x) * k), (-y * k, (HEIGHT - y) * k)
    return PinholeCamera(width * k, height * k, focal, focal, *centre, pose, NEAR, film), corner, k


@dataclass
class Oracle:
    """Images of a case for values near the first ones; what has no derivative stays as it is for those."""

    case: Case
    first: Values
    _kept: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        shown, self.window = self.case, (slice(None), slice(None))
        if self.case["accuracy"] == "antialias":  # roughness depends on pixels beside the crop window
            x, y, width, height = CROPS[self.case["crop"]]
            shown, self.window = self.case | {"crop": "none"}, (slice(y, y + height), slice(x, x + width))
        self.camera, self.corner, self.per_axis = camera_of(shown)
        self.pixels = np.arange(self.camera.width * self.camera.height)
        self.band = np.zeros(len(self.pixels), bool)
        self.exact = self.case["occlusion"] not in TRACED

    def image(self, values: Values) -> Array:
        """(H, W, channels), as `mi.render` gives it."""
        values = {name: np.asarray(x, np.float64) for name, x in values.items()}
        maps = self._reference(values) if self.exact else self._rendered(values)
        return self._developed(maps, values)[self.window]

    def undecided(self) -> Array:
        """Pixels (H, W) of which a sample is near a discontinuity; after the first `image`."""
        return self._blocks(self.band.astype(float)[:, None])[self.window][..., 0] > 0

    # ---------------- maps of the samples ----------------

    def _keep(self, name: str, value: Any) -> Any:
        return self._kept.setdefault(name, value() if name not in self._kept else None)

    def _reference(self, values: Values) -> dict[str, Array]:
        case, camera = self.case, self.camera
        own = {n: x for n, x in values.items() if n in surfels_of(self.first).raw}
        around = {n.removeprefix(AROUND): x for n, x in values.items() if n.startswith(AROUND)}
        if not around:
            around = {n: np.zeros((0, own[n].shape[1])) for n in (*GEOMETRY, "radiance_sh")}
        both = {n: np.concatenate([own[n], around[n]]) for n in GEOMETRY}
        order = self._keep("order", lambda: sorted_rows(both, camera, self.pixels, self.corner))
        chosen = shading(case)
        options = Options(
            dominant=chosen.dominant, multiscatter=chosen.multiscatter, directions=chosen.directions
        )
        if chosen.reflectance == "monte_carlo":
            normal = self._keep("normal", lambda: _facing(own, camera))
            options = replace(options, detached_normal=normal)
            if chosen.occlusion:
                free = self._keep("free", lambda: _free(own["position"], normal, chosen.directions))
                options = replace(options, free=free)
        scene = image.Scene(
            own, camera, self.pixels, order, chosen.at, chosen.reflectance, chosen.diffuse,
            light_of(case, values), options=options, terms=True,
        )  # fmt: skip
        if chosen.occlusion and chosen.model.visibility == "mirror":
            scene = replace(
                scene, visibility=lambda n, r: self._keep("visible", lambda: _visible(camera, n, r))
            )
        background = values.get("background", np.full((8, 16, 3), -np.inf))
        if chosen.antialias and "variance" not in self._kept:
            maps, _ = image.render_open(image.OpenScene(scene, around, background))
            shape = camera.height, camera.width
            normal, share = maps["object_normal"].reshape(*shape, 3), maps["object_alpha"].reshape(shape)
            self._kept["variance"] = losses.widened_roughness(np.zeros(shape), normal, share).ravel() ** 4
        scene = replace(scene, variance=self._kept.get("variance"))
        maps, band = image.render_open(image.OpenScene(scene, around, background))
        if chosen.occlusion and chosen.model.visibility == "mirror":
            maps["visibility"] = self._kept["visible"][:, None]
        floor = np.abs(maps["object_alpha"] - c.COVERAGE_FLOOR)[:, 0] < 0.5 * c.COVERAGE_FLOOR
        floor |= np.abs(maps["alpha"] - c.COVERAGE_FLOOR)[:, 0] < 0.5 * c.COVERAGE_FLOOR
        self._keep("band", lambda: np.logical_or(self.band, band | floor, out=self.band))
        return maps

    def _rendered(self, values: Values) -> dict[str, Array]:
        """Maps of `render`, of all AOVs."""
        case, chosen, camera = self.case, shading(self.case), self.camera
        held = {name: x.astype(np.float32) for name, x in values.items()}
        surfels = surfels_of(held)
        around = surfels_of(held, AROUND) if case["surroundings"] else nothing_around(surfels)
        behind = EnvironmentLight(mi.TensorXf(held["background"])) if "background" in held else None
        open_ = Surroundings(around, behind) if case["surroundings"] or behind else None
        light: Any = ConstantLight(mi.Color3f(held["radiance"].tolist())) if "radiance" in held else None
        if light is None:
            light = chosen.light_of(EnvironmentLight.from_radiance(map_of(case, values)))
            light = RotatedLight(light, mi.Matrix3f(rotation(case).T.astype(np.float32)))
        occluder = Occluder(mesh())
        update_occluder_caches(occluder, surfels, light, chosen)
        view = Camera.from_pose(
            camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, camera.to_world, NEAR
        )
        (left, right), (top, bottom) = (map(int, ends) for ends in camera.borders)
        view = replace(view, offset=(-left, -top), film=(right - left, bottom - top))
        drawn = SurfelScene(surfels, chosen, light, occluder, open_)
        frame = render(drawn, view, Request(drawn.all_aovs))
        assert frame.terms is not None
        found = {
            "radiance": frame.radiance, "alpha": frame.alpha, "depth": frame.depth, "normal": frame.normal,
            "diffuse": frame.terms.diffuse, "specular": frame.terms.specular,
            "indirect": frame.terms.indirect, **frame.maps,
        } | ({} if frame.object_alpha is frame.alpha else {"object_alpha": frame.object_alpha}) \
          | ({} if behind is None else {"background": frame.background})  # fmt: skip
        count = len(self.pixels)
        maps = {name: np.atleast_2d(np.array(x, np.float64)).T for name, x in found.items()}
        maps = {name: np.broadcast_to(x, (count, x.shape[1])) for name, x in maps.items()}
        return {"object_alpha": maps["alpha"]} | maps

    # ---------------- the film ----------------

    def _blocks(self, values: Array) -> Array:
        """Means (H, W, n) of values (samples, n) over the pixels."""
        k = self.per_axis
        height, width = self.camera.height // k, self.camera.width // k
        return np.asarray(values).reshape(height, k, width, k, -1).mean(axis=(1, 3))

    def _developed(self, maps: dict[str, Array], values: Values) -> Array:
        case = self.case
        rgb, alpha = maps["radiance"], maps["alpha"]
        if case["terms"] != "all":
            rgb = maps[case["terms"]]
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
        by = maps["object_alpha"]
        value = maps.get("visibility", np.ones_like(by)) if kind == "visibility" else maps[kind]
        mean = self._blocks(value * by) / np.where(share > 0, share, 1)
        return np.where(share > c.COVERAGE_FLOOR, mean, 0)

    def _ray_lengths(self) -> Array:
        """|ray| (samples, 1), of rays that are 1 along the viewing axis."""
        camera = self.camera
        x = (self.pixels % camera.width + 0.5 - camera.cx) / camera.fx
        y = (self.pixels // camera.width + 0.5 - camera.cy) / camera.fy
        return np.sqrt(1 + x**2 + y**2)[:, None]


# ---------------- the light ----------------


def map_of(case: Case, values: Values) -> Array:
    """Radiance (h, 2h, 3) of the light's map, float64."""
    if "light" in values:
        own = np.logaddexp(0, values["light"])
        return own if own.ndim == 3 else np.tile(own, (8, 16, 1))
    if "radiance" in values:
        return np.tile(values["radiance"], (8, 16, 1))
    own = values["data"] * values["brightness"]
    return lobe_matrices.resample(own, 8) if case["map"] == "9 x 14" else own


def light_of(case: Case, values: Values) -> Light:
    radiance = map_of(case, values)
    wanted = shading(case).levels
    flat = radiance.reshape(-1, 3)
    levels = [(m @ flat) for m in _matrices(len(radiance), wanted)]
    if case["map"] == "constant" and case["emitter"] != "tensor":
        levels = [np.broadcast_to(flat[0], level.shape) for level in levels]
    shaped = [x.reshape(h := math.isqrt(len(x) // 2), 2 * h, 3) for x in levels]
    table = brdf.table().astype(np.float64)
    return Light([radiance, *shaped], wanted.roughness, table, rotation(case).T)


@cache
def _matrices(height: int, wanted: lobe_matrices.Levels) -> list[Array]:
    """Dense prefilter matrices (2 h_out², 2 h²) of the levels, float64."""
    matrices = []
    φ = lobe_matrices.column_angles(2 * height)
    for level in lobe_matrices.build_levels(height, wanted):
        m = np.arange(level.weights.shape[2])
        across = np.cos(m[:, None, None] * (lobe_matrices.column_angles(2 * level.height)[:, None] - φ))
        dense = np.einsum("ikm,mab->iakb", level.weights, across, optimize=True)
        matrices.append(dense.reshape(2 * level.height**2, 2 * height**2))
    return matrices


# ---------------- rays ----------------


def _blocked(origin: Array, direction: Array) -> Array:
    """Whether rays (n, 3) meet the mesh."""
    found = mesh()
    return np.isfinite(occlusion.mesh_distance(found.vertices, found.faces, origin, direction))


def _visible(camera: PinholeCamera, normal: Array, ray: Array) -> Array:
    """Visibility (P,) of the mirror direction from where the pixels' rays meet the mesh."""
    found = mesh()
    origin = np.broadcast_to(camera.to_world[:3, 3], ray.shape)
    t = occlusion.mesh_distance(found.vertices, found.faces, origin, ray)
    hit = np.isfinite(t)
    start = origin + np.where(hit, t, 0)[:, None] * ray + OFFSET_VOXELS * found.voxel * normal
    mirror = ray - 2 * np.sum(normal * ray, 1, keepdims=True) * normal
    return np.where(hit & _blocked(start, mirror), 0.0, 1.0)


def _facing(raw: dict[str, Array], camera: PinholeCamera) -> Array:
    """Normals (N, 3) of surfels towards the camera."""
    axes = np.stack(rotation_axes(raw["rotation"]))
    normal = axes[primitive_of(raw).normal(raw), np.arange(len(raw["rotation"]))]
    direction = unit(raw["position"] - camera.to_world[:3, 3])
    away = np.sum(normal * direction, 1, keepdims=True) > c.FACING_TOLERANCE
    return np.where(away, -normal, normal)


def _free(position: Array, normal: Array, count: int) -> Array:
    """Whether light arrives at surfels from their directions, (N, count)."""
    start = position + OFFSET_VOXELS * mesh().voxel * normal
    free = [
        ~_blocked(np.tile(o, (count, 1)), hemisphere(count, n)) for o, n in zip(start, normal, strict=True)
    ]
    return np.stack(free)
