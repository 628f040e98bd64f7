"""Hard cases for images and gradients: the plain scene, and cases that differ from it in one thing."""

from __future__ import annotations

import functools
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from benchmarks.common.scenes import asymmetric_sky, discs, facing, unit
from mi_refgs.occlusion.mesh import Mesh, read_mesh
from mi_refgs.reference.camera import look_at
from mi_refgs.reference.splat import PinholeCamera

Array = np.ndarray
Raw = dict[str, Array]
WIDTH, HEIGHT = 24, 20


@dataclass(frozen=True)
class Case:
    """A scene, a camera, and how it is rendered; float32 numbers, so that every renderer gets the same."""

    name: str
    raw: Raw
    camera: PinholeCamera
    light: Array  # raw values (h, 2h, 3)
    at: str = "pixel"
    reflectance: str = "split_sum"
    diffuse: str = "sh"
    mesh: Callable[[], Mesh] | None = None  # made when it is needed
    surface: Any = None  # vertices, faces and offset of rays, which the float64 reference traces
    further: float = 0.0  # rays may start so much further off the surface: nothing is compared there
    pixels: int | None = None  # the float64 reference sees a random subset of this size; None: all
    offset: tuple[int, int] = (0, 0)  # of a crop window in its film
    quick: bool = True  # cheap enough for every test run
    near: float | None = None  # the camera's near plane, if the case is about it
    band: float = 1e-4  # relative width of the declared discontinuities, above what rounding does to α

    def rounded(self) -> Case:
        """With all numbers rounded to float32."""
        return replace(
            self,
            raw={name: np.asarray(x, np.float32) for name, x in self.raw.items()},
            light=np.asarray(self.light, np.float32),
        )


def filled(count: int = 40, **values: float) -> Raw:
    """Channels of the sphere with one raw value everywhere."""
    return {name: np.full_like(discs(count)[name], value) for name, value in values.items()}


def camera(
    origin: Any = (3.0, 1.0, 2.0),
    target: Any = (0.0, 0.0, 0.0),
    fov: float = 45.0,
    width: int = WIDTH,
    height: int = HEIGHT,
    near: float = 0.0,
) -> PinholeCamera:
    """A pinhole camera in Mitsuba's frame; `fov` in degrees across the width."""
    focal = 0.5 * width / np.tan(np.radians(fov) / 2)
    pose = look_at(np.asarray(origin, np.float64), np.asarray(target, np.float64))
    return PinholeCamera(width, height, -focal, -focal, width / 2, height / 2, pose, near)


def sky(height: int = 16, peak: float = 0.0) -> Array:
    """Raw values of a light without symmetries; one texel near the equator has the radiance `peak`."""
    radiance = asymmetric_sky(height)
    if peak:
        radiance[height // 2 - 1, height // 3] = peak
    return raw_light(radiance)


def raw_light(radiance: Array) -> Array:
    """Inverse of softplus, float64."""
    return radiance + np.log(-np.expm1(-radiance))


def plain(name: str, **changes: Any) -> Case:
    """The plain scene, with any field of `Case` replaced; `raw` may hold some of the channels only."""
    raw = discs() | changes.pop("raw", {})
    return Case(name, raw, changes.pop("camera", camera()), changes.pop("light", sky()), **changes)


LN = np.log
EYE = np.array([3.0, 1.0, 2.0])  # position of the plain camera


def catalogue() -> list[Case]:
    """Every case, groups in the order of the page."""
    groups = (_ends, _normals, _scales, _places, _many, _worlds, _lights, _images, _cameras, _meshes)
    return [case for group in groups for case in group()]


def where(mask: Any, values: Any, channel: str, raw: Raw | None = None) -> Raw:
    """The plain channel with new values in some rows."""
    out = (raw or discs())[channel].copy()
    out[mask] = values
    return {channel: out}


def every(n: int = 2, k: int = 0, count: int = 40) -> Array:
    """Rows k, k + n, …"""
    return np.arange(count) % n == k


# ---------------- ends of ranges ----------------


def _ends() -> Iterator[Case]:
    yield plain("plain scene")
    yield plain("plain scene, shaded at surfels", at="surfel", diffuse="irradiance")
    ends: dict[str, Raw] = {
        "roughness 0": filled(roughness=-30),
        "roughness 1": filled(roughness=30),
        "roughness 0 beside 1": where(every(), 30, "roughness", filled(roughness=-30)),
        "metallic 0": filled(metallic=-30),
        "metallic 1": filled(metallic=30),
        "albedo 0 and 1": where(every(), 30, "albedo", filled(albedo=-30)),
        "opacity logit +30": filled(opacity=30),
        "opacity logit -30: all transparent": filled(opacity=-30),
        "opacity logits ±30": where(every(), 30, "opacity", filled(opacity=-30)),
        "opacity just above 1/255": filled(opacity=LN(0.0045)),
    }
    for name, raw in ends.items():
        yield plain(name, raw=raw)


def _sideways(rng: np.random.Generator) -> tuple[Array, Array]:
    """Unit vectors (40, 3) of the plain sphere's surfels to the eye, and random ones across them."""
    view = unit(EYE - discs()["position"])
    return view, unit(np.cross(view, rng.normal(size=(40, 3))))


def _normals() -> Iterator[Case]:
    rng = np.random.default_rng(2)
    for name, slope in {"→ 0: 0.01": 0.01, "→ 0: 0.001": 0.001, "negative: -0.1": -0.1}.items():
        view, side = _sideways(rng)
        normal = np.sqrt(1 - slope**2) * side + slope * view
        yield plain(f"N·V {name}", raw={"rotation": facing(normal)} | filled(scale=LN(0.4)))
    # Two wide discs in one place, of the same weight everywhere: α₁ = α₂ (1 - α₁).
    pair = {n: x[:2] for n, x in discs().items()}
    view, side = EYE / np.linalg.norm(EYE), np.cross(EYE, [0.3, 0.2, 1.0])
    side /= np.linalg.norm(side)
    tilt = 0.2  # below FACING_TOLERANCE: the second normal stays turned away
    first = np.sqrt(1 - tilt**2) * side + tilt * view
    for name, angle in (("normals that cancel but for 1e-3", 1e-3), ("normals that cancel", 0.0)):
        second = angle * np.cross(first, side) - first
        normals = np.stack([first, second / np.linalg.norm(second)])
        both = filled(2, position=0, scale=LN(100)) | {"rotation": facing(normals)}
        both["opacity"] = np.array([[LN(0.3 / 0.7)], [LN((3 / 7) / (4 / 7))]])
        yield plain(name, raw=pair | both)
    for size in ("1e-10", "1e10"):
        raw = {"rotation": float(size) * discs()["rotation"]}
        yield plain(f"quaternions of length {size}", raw=raw)
    yield plain("quaternions 0", raw=where(every(), 0.0, "rotation"))


# ---------------- sizes and places ----------------


def _scales() -> Iterator[Case]:
    scales = {
        "scales 1e-8": filled(scale=LN(1e-8)),
        "some scales 1e-8": where(every(), LN(1e-8), "scale"),
        "scales 0 (log scale -1000)": where(every(), -1000, "scale"),
        "scales 1e3": where(every(4), LN(1e3), "scale"),
        "scales 1e6": where(every(4), LN(1e6), "scale"),
    }
    for name, raw in scales.items():
        yield plain(name, raw=raw)
    for ratio in (1e4, 1e6):
        for name, axes in {"length 0.5": (0.5, 0.5 / ratio), "width 0.05": (0.05 * ratio, 0.05)}.items():
            yield plain(f"anisotropy {ratio:.0e}, {name}", raw={"scale": np.tile(LN(axes), (40, 1))})
        raw, eye, corner = _part_of_film(1024, 1.5)
        raw["scale"] = raw["scale"] + [float(LN(ratio)), 0]
        name = f"anisotropy {ratio:.0e}, width of 1.5 pixels in a film of 1024²"
        yield plain(name, raw=raw, camera=eye, offset=corner)


def _places() -> Iterator[Case]:
    eye, forward = EYE, -EYE / np.linalg.norm(EYE)
    view, side = _sideways(np.random.default_rng(4))
    for slope in (1e-5, 2e-4, 1e-3):
        yield plain(f"edge-on, cosine {slope:g}", raw={"rotation": facing(side + slope * view)})
    behind = where(every(), discs()["position"][every()] + 6 * eye / np.linalg.norm(eye), "position")
    yield plain("half of the surfels behind the camera", raw=behind)
    for distance in (1e-1, 1e-3, 1e-6):
        near = where(every(8), (eye + distance * forward + 0.01 * distance * side)[every(8)], "position")
        yield plain(f"surfels {distance:g} before the eye", raw=near | filled(opacity=-1))
    yield plain("surfels at the eye", raw=where(every(8), np.float32(eye), "position"))
    across = where(every(4), (eye + 0.5 * forward + 0.05 * side)[every(4)], "position")
    raw = across | {"rotation": facing(side + 0.3 * view)} | filled(scale=LN(0.6))
    yield plain("across the eye's plane", raw=raw)
    yield plain("across the near plane", raw=raw, near=0.5)


def _many() -> Iterator[Case]:
    rng = np.random.default_rng(6)

    def stack(count: int, opacity: float, step: float, spread: float = 0.0, size: float = 3.0) -> Raw:
        raw = {n: np.repeat(x[:1], count, 0) for n, x in discs(degree=0).items()}
        z = step * np.arange(count)[:, None] * np.array([0, 0, -1.0])
        raw["position"] = z + spread * rng.normal(size=(count, 3))
        raw["rotation"] = np.tile([0.05, 0.02, 0, 1.0], (count, 1))
        raw["scale"] = np.full((count, 2), LN(size))
        raw["opacity"] = np.full((count, 1), LN(opacity / (1 - opacity)))
        for name in ("radiance_sh", "albedo", "metallic", "roughness"):
            raw[name] = raw[name] + 0.3 * rng.normal(size=raw[name].shape)
        return raw

    eye = camera((0.2, 0.1, 4.0))
    yield Case("100 coincident surfels", stack(100, 0.05, 0), eye, sky())
    for count, opacity in ((10_000, 0.01), (100_000, 0.005)):
        name = f"{count:.0e} coincident surfels"
        yield Case(name, stack(count, opacity, 0), eye, sky(), pixels=12, quick=False)
    flat = stack(200, 0.3, 0, 0.4, 0.5)
    flat["position"][:, 2] = 0
    yield Case("200 surfels of identical depth", flat, camera((0, 0, 4.0)), sky())
    yield Case("5,000 layers of opacity 0.005", stack(5000, 0.005, 2e-4), eye, sky(), pixels=64, quick=False)
    yield Case("5,000 layers of opacity 0.5", stack(5000, 0.5, 2e-4), eye, sky(), pixels=64, quick=False)


# ---------------- the world ----------------


def scaled(case: Case, name: str, factor: float) -> Case:
    """The case with every length times `factor`."""
    size = float(LN(factor))
    raw: Raw = {**case.raw, "position": factor * case.raw["position"], "scale": case.raw["scale"] + size}
    pose = case.camera.to_world.copy()
    pose[:3, 3] *= factor
    found = replace(case, name=name, raw=raw, camera=replace(case.camera, to_world=pose))
    if case.surface is None:
        return found
    vertices, faces, offset = case.surface
    return _occluded(found, factor * vertices, faces, 0.5 * factor * offset)


def moved(case: Case, name: str, offset: Array) -> Case:
    """The case elsewhere; positions are those that float32 has there."""
    position = (case.raw["position"] + offset).astype(np.float32)
    pose = case.camera.to_world.copy()
    pose[:3, 3] += offset
    raw: Raw = {**case.raw, "position": position}
    return replace(case, name=name, raw=raw, camera=replace(case.camera, to_world=pose))


def _worlds() -> Iterator[Case]:
    for power in (-6, -4, -3, 3, 6):
        yield scaled(plain("plain"), f"the scene times 1e{power:+d}", 10.0**power)
    yield scaled(_plates(), "mesh and scene times 1e-3", 1e-3)
    for extents in (1e3, 1e5):
        offset = extents * np.array([1.0, -0.7, 0.4])
        yield moved(plain("plain"), f"the scene moved by {extents:.0e} extents", offset)


def _lights() -> Iterator[Case]:
    shiny = {"roughness": discs()["roughness"] - 2} | filled(metallic=2)
    yield plain("a light with a peak of 1e6", raw=shiny, light=sky(peak=1e6))
    yield plain("a light of 1e6 everywhere", light=np.full((16, 32, 3), 1e6))
    yield plain("a black light (1e-4, the floor)", light=raw_light(np.full((16, 32, 3), 1e-4)))
    yield plain("a black light (raw -80)", light=np.full((16, 32, 3), -80.0))
    yield plain("the smallest map", light=sky(8), raw=shiny)
    below = np.full((16, 32, 3), 1.0)
    below[13, 5] = 1e6
    sheet, above = _level((0, 1, 0)) | filled(roughness=-1), camera((1.5, 4, 0.5))
    yield plain("a sun of 1e6 below the horizon", raw=sheet, camera=above, light=raw_light(below))
    # Mirrors seen from above reflect the pole; from -z, those before the camera the map's seam.
    mirrors = {
        "a pole": ((0, 1, 0), (0.05, 4, 0.02)),
        "the seam of the map": ((0, 0, -1), (0, 0.4, -4)),
        "the other half": ((0, 0, 1), (0, 0.4, 4)),
    }
    for name, (normal, eye) in mirrors.items():
        raw = filled(roughness=-6, metallic=3) | _level(normal)
        yield plain(f"mirrors that reflect {name}", raw=raw, camera=camera(eye))


def _level(normal: tuple[float, ...]) -> Raw:
    """Discs in a plane, their normals within some degrees of its own."""
    rng, axis = np.random.default_rng(8), np.array(normal)
    n = axis + 0.03 * rng.normal(size=(40, 3))
    flat = rng.uniform(-1, 1, (40, 3))
    return {"position": flat - np.sum(flat * axis, 1, keepdims=True) * axis, "rotation": facing(unit(n))}


# ---------------- images and cameras ----------------


def _images() -> Iterator[Case]:
    for width, height in ((1, 1), (1, 17), (17, 1), (13, 7)):
        focal = camera().fx * max(width, 4) / WIDTH
        eye = replace(camera(width=width, height=height), fx=focal, fy=focal)
        yield plain(f"an image of {width} × {height}", camera=eye, quick=width == 1)
    flat: dict[str, Any] = {"at": "surfel", "reflectance": "radiance"}
    large = camera(width=4096, height=4096)
    yield plain("an image of 4096²", camera=large, pixels=600, quick=False, **flat)
    one = {n: x[:1] for n, x in discs().items()} | {"position": np.zeros((1, 3))}
    yield plain("one surfel", raw=one)
    none = {n: x[:0] for n, x in discs().items()}
    yield plain("no surfel", raw=none)
    raw, eye, corner = _part_of_film(4096, 2)
    name = "surfels of 2 pixels in a film of 4096²"
    yield plain(name, raw=raw, camera=eye, offset=corner, band=5e-3)
    full = camera()
    crop = replace(full, width=11, height=9, cx=full.cx - 5, cy=full.cy - 6)
    yield plain("a crop window", camera=crop, offset=(5, 6), quick=False)


def _part_of_film(size: int, pixels: float) -> tuple[Raw, PinholeCamera, tuple[int, int]]:
    """Surfels of so many pixels that fill a window near the corner of a film; its camera and its corner."""
    far, corner = camera(width=size, height=size), (size * 7 // 8, size * 6 // 7)
    part = replace(far, width=WIDTH, height=HEIGHT, cx=far.cx - corner[0], cy=far.cy - corner[1])
    inside = np.random.default_rng(12).uniform(0, 1, (40, 2)) * [WIDTH, HEIGHT] - [part.cx, part.cy]
    local = 4 * np.concatenate([inside / part.fx, np.ones((40, 1))], axis=1)
    position = local @ part.to_world[:3, :3].T + part.to_world[:3, 3]
    scale = np.full((40, 2), float(LN(4 * pixels / abs(part.fx))))
    return {"position": position, "scale": scale}, part, corner


def _cameras() -> Iterator[Case]:
    yield plain("a field of view of 1°", camera=camera(40 * EYE, fov=1.0))
    yield plain("a field of view of 150°", camera=camera(0.35 * EYE, fov=150.0))
    yield plain("a camera at the object's centre", camera=camera((0, 0, 0), (1, 0.5, 0.2), 90))
    yield plain("a camera inside, near the wall", camera=camera((0.7, 0.5, 0.1), (-1, 0.5, 0.2), 90))


# ---------------- meshes ----------------


def _grid(n: int, size: float, y: float) -> tuple[Array, Array]:
    """A plate of n² × 2 triangles at height y, facing up."""
    g = np.stack(np.meshgrid(np.linspace(-1, 1, n + 1), np.linspace(-1, 1, n + 1), indexing="ij"), -1)
    x, z = size * g.reshape(-1, 2).T
    i = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    a, b, c, d = (q.ravel() for q in (i[:-1, :-1], i[1:, :-1], i[:-1, 1:], i[1:, 1:]))
    return np.stack([x, y + 0 * x, z], 1), np.concatenate([np.stack([a, c, b], 1), np.stack([b, c, d], 1)])


def _discs_on_plate() -> Raw:
    rng = np.random.default_rng(9)
    normal = np.array([0, 1.0, 0]) + 0.05 * rng.normal(size=(40, 3))
    position = np.stack([rng.uniform(-1, 1, 40), np.zeros(40), rng.uniform(-1, 1, 40)], 1)
    turned = {"position": position, "rotation": facing(unit(normal))}
    return turned | filled(opacity=2, roughness=-2, metallic=1)


def _with_mesh(name: str, parts: list[tuple[Array, Array]], voxel: float, **changes: Any) -> Case:
    vertices, faces = (np.zeros((0, 3)), np.zeros((0, 3), int)) if not parts else _joined(parts)
    return _occluded(plain(name, **changes), vertices, faces, voxel)


def _occluded(case: Case, vertices: Array, faces: Array, voxel: float) -> Case:
    """The case with a mesh, whose rays start two voxels off it."""
    mesh = Mesh(vertices.astype(np.float32), faces.astype(np.uint32), voxel)
    return replace(case, mesh=lambda: mesh, surface=(mesh.vertices.astype(np.float64), faces, 2 * voxel))


def _joined(parts: list[tuple[Array, Array]]) -> tuple[Array, Array]:
    starts = np.cumsum([0] + [len(v) for v, _ in parts])
    return (
        np.concatenate([v for v, _ in parts]),
        np.concatenate([f + s for (_, f), s in zip(parts, starts, strict=False)]),
    )


def _plates() -> Case:
    """A mirror below half a ceiling."""
    ceiling = _grid(3, 0.8, 0.5)
    parts, eye = [_grid(3, 1.5, 0.0), ceiling], camera((2.5, 1.6, 1.5))
    return _with_mesh("two plates", parts, 1e-3, raw=_discs_on_plate(), camera=eye)


def _meshes() -> Iterator[Case]:
    yield _with_mesh("an empty mesh", [], 1.0)
    wall = _grid(2, 1.5, 0.0)
    wall = (wall[0] @ np.array([[0, 1.0, 0], [1, 0, 0], [0, 0, 1]]) - [1.3, 0, 0], wall[1])
    parts = [_grid(3, 1.5, 0.0), wall]
    for name, height in (("above", 1.6), ("below", -1.6)):
        eye = camera((2.5, height, 1.5))
        yield _with_mesh(f"an open sheet from {name}", parts, 1e-2, raw=_discs_on_plate(), camera=eye)
    yield _plates()
    foreign = functools.partial(_foreign, _plates())
    yield replace(_plates(), name="the same mesh, made elsewhere", mesh=foreign, further=0.04)
    ball = trimesh.creation.icosphere(subdivisions=2)
    ball = [(np.asarray(ball.vertices), np.asarray(ball.faces))]
    raw, eye = {"rotation": facing(discs()["position"])}, camera((3.0, 0.3, 2.0), (0.0, 1.0, 0.0), 20)
    yield _with_mesh("a grazing self-hit", ball, 5e-3, raw=raw | filled(opacity=2), camera=eye)


def _foreign(case: Case) -> Mesh:
    """The case's mesh through a file that says nothing about its making."""
    vertices, faces, _ = case.surface
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "mesh.obj"
        trimesh.Trimesh(vertices, faces, process=False).export(path)
        return read_mesh(path)
