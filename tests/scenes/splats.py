"""Random surfels and a camera for tests of splatting against the float64 reference, and what they compare."""

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.kernels.device import upload
from mi_refgs.reference import splat as reference
from mi_refgs.reference.camera import look_at
from mi_refgs.splat import Camera, Composited, splat
from mi_refgs.surfels.attributes import ATTRIBUTES
from mi_refgs.surfels.init import from_points
from mi_refgs.surfels.table import Surfels

MAX_LEFT_OUT = 0.05  # share of the covered pixels that may lie in the band around declared discontinuities
PARAMETERS = ("position", "rotation", "scale", "opacity", "features")


@dataclass(frozen=True)
class Scene:
    raw: dict[str, np.ndarray]
    features: np.ndarray
    camera: reference.PinholeCamera
    turns: np.ndarray | None = None  # (N, 6): the first three features vary over their surfels

    def fast_camera(self) -> Camera:
        c = self.camera
        return Camera.from_pose(c.width, c.height, c.fx, c.fy, c.cx, c.cy, c.to_world, c.near)

    def surfels(self) -> Surfels:
        return Surfels.from_numpy(self.raw)

    def columns(self) -> list:
        """Features, then turns."""
        return [upload(f) for x in (self.features, self.turns) if x is not None for f in x.T]

    def splat(self, surfels: Surfels, columns: list) -> Composited:
        count = self.features.shape[1]
        return splat([surfels], columns[:count], self.fast_camera(), columns[count:])

    def exact(self, raw: dict[str, np.ndarray] | None = None) -> reference.Maps:
        return reference.splat(raw or self.raw, self.features, self.camera, turns=self.turns)


def make_scene(seed: int) -> Scene:
    """1 to 500 surfels, some of them sub-pixel, edge-on, overlapping, opaque or behind the camera."""
    rng = np.random.default_rng(seed)
    count = round(500 ** (seed % 20 / 19))
    width, height = int(rng.integers(13, 40)), int(rng.integers(13, 40))  # rarely multiples of the tile
    origin = 4 * rng.normal(size=3) / 1.7
    to_world = look_at(origin, 0.2 * rng.normal(size=3), (0.1, 0.2, 1.0))
    position = rng.normal(size=(count, 3)) * 0.6
    scale = np.log(rng.uniform(0.02, 0.5, size=(count, 2)))
    opacity = rng.normal(size=(count, 1)) * 2
    rotation = rng.normal(size=(count, 4))
    kind = np.arange(count) % 10
    scale[kind == 3] = np.log(0.002)  # sub-pixel: the low-pass decides
    opacity[kind == 4] = 6.0  # beyond the clamp at α_max
    behind = kind == 5
    position[behind] = origin - to_world[:3, 2] * rng.uniform(0.5, 3, size=(np.sum(behind), 1))
    position[kind == 6] = position[(kind == 6).nonzero()[0] - 1] + 1e-2  # overlapping, nearly equal depth
    for i in (kind == 7).nonzero()[0]:  # nearly edge-on: normal almost across the view direction
        view = position[i] - origin
        normal = np.cross(view, rng.normal(size=3))
        normal = normal / np.linalg.norm(normal) + 0.03 * view / np.linalg.norm(view)
        rotation[i] = quaternion_to(normal / np.linalg.norm(normal))
    focal = width / rng.uniform(0.6, 1.2)
    camera = reference.PinholeCamera(
        width, height, -focal, -focal * rng.uniform(0.9, 1.1), width * rng.uniform(0.3, 0.7),
        height * rng.uniform(0.3, 0.7), to_world,
    )  # fmt: skip
    raw = {"position": position, "rotation": rotation, "scale": scale, "opacity": opacity}
    # Round once, so that both sides see the same float32 numbers.
    raw = {name: values.astype(np.float32).astype(np.float64) for name, values in raw.items()}
    return Scene(raw, rng.uniform(size=(count, 4)).astype(np.float32).astype(np.float64), camera)


def make_turned(seed: int) -> Scene:
    """The surfels of `make_scene`, whose first three features vary over each of them, some steeply."""
    scene, rng = make_scene(seed), np.random.default_rng(seed + 9)
    turns = rng.normal(size=(len(scene.features), 6)) * rng.choice([0.1, 3], (len(scene.features), 1))
    return replace(scene, turns=turns.astype(np.float32).astype(np.float64))


def make_gaussians(seed: int) -> Scene:
    """The surfels of `make_scene` with a third axis: needles, pancakes, centres beside the image."""
    scene = make_scene(seed)
    rng, count = np.random.default_rng(seed + 7), len(scene.features)
    scale = np.concatenate([scene.raw["scale"], np.log(rng.uniform(0.005, 0.4, (count, 1)))], axis=1)
    position, kind = scene.raw["position"].copy(), np.arange(count) % 10
    scale[kind == 3] = np.log(0.002)
    scale[kind == 7] = np.log([0.5, 0.5, 1e-4])
    scale[kind == 8] = np.log([1.0, 1e-3, 1e-3])
    beside = kind == 9
    position[beside] += scene.camera.to_world[:3, 0] * rng.choice([-2.5, 2.5], (beside.sum(), 1))
    scale[beside] = np.log(0.8)
    raw = scene.raw | {"scale": scale, "position": position}
    return replace(scene, raw={n: x.astype(np.float32).astype(np.float64) for n, x in raw.items()})


def discs(**channels: Any) -> dict[str, Any]:
    """Raw values of discs at the origin that face +z, grey and opaque unless `channels` says otherwise."""
    count = max(len(values) for values in channels.values())
    raw = {
        "position": np.zeros((count, 3)),
        "rotation": np.tile([0.0, 0, 0, 1], (count, 1)),
        "scale": np.full((count, 2), np.log(0.3)),
        "opacity": np.full((count, 1), 20.0),
        "radiance_sh": np.zeros((count, 3)),
    }
    return raw | channels


def random_raw(count: int, rng: np.random.Generator, degree: int) -> dict[str, np.ndarray]:
    """Random raw values of every attribute, with harmonics of a degree."""
    widths = {name: attribute.width(degree) for name, attribute in ATTRIBUTES.items()}
    return {name: rng.normal(size=(count, width)).astype(np.float32) for name, width in widths.items()}


def opaque(
    points: np.ndarray, normals: np.ndarray, colours: Any, sizes: list[float], primitive: str = "surfel"
) -> Surfels:
    """Surfels, or Gaussians, of these sizes that nearly hide what lies behind, with one colour each."""
    options: dict[str, Any] = {"attributes": ["radiance_sh"], "opacity": 0.99, "primitive": primitive}
    raw = from_points(points, normals, colours, rng=np.random.default_rng(0), **options).to_numpy()
    raw["scale"][:] = np.log(sizes)[:, None]
    return Surfels.from_numpy(raw)


def seen_from(*origin: float, size: int = 1, focal: float = 8.0) -> Camera:
    """A camera of size × size pixels that looks at the origin."""
    pose = look_at(np.array(origin), np.zeros(3), up=(0, 1, 0))
    return Camera.from_pose(size, size, -focal, -focal, size / 2, size / 2, pose)


def quaternion_to(normal: np.ndarray) -> np.ndarray:
    """A quaternion (x, y, z, w) whose rotation takes +z to `normal`."""
    return np.array([*np.cross([0, 0, 1.0], normal), 1 + normal[2]]) + 1e-9


def fast_maps(scene: Scene) -> Composited:
    return scene.splat(scene.surfels(), scene.columns())


def check_image(scene: Scene, tolerance: float) -> None:
    """Features, alpha and depth against the float64 reference, in parts of a range above 1."""
    expected, got = scene.exact(), fast_maps(scene)
    keep = outside_band(expected)
    depth_scale = np.abs(scene.raw["position"]).max() + 5
    pairs = [*zip(got.features, np.moveaxis(expected.features, -1, 0), strict=True)]
    pairs += [(got.alpha, expected.alpha), (got.depth / depth_scale, expected.depth / depth_scale)]
    for found, wanted in pairs:
        error = np.abs(found.numpy().reshape(keep.shape) - wanted)[keep].max()
        assert error <= tolerance * max(1, np.abs(wanted).max())


def outside_band(maps: reference.Maps) -> np.ndarray:
    """Pixels (H, W) away from the declared discontinuities: nearly all that are covered; observed: 96 %."""
    covered = maps.alpha > 0
    assert np.count_nonzero(maps.band & covered) <= MAX_LEFT_OUT * np.count_nonzero(covered)
    return ~maps.band


def loss_weights(scene: Scene, seed: int) -> np.ndarray:
    """Random weights (H, W, 6), zero in the declared band, where differences step across."""
    keep = outside_band(scene.exact())
    weights = np.random.default_rng(seed + 100).normal(size=(*keep.shape, 6))
    return np.where(keep[..., None], weights, 0).astype(np.float32).astype(np.float64)


def fast_loss(scene: Scene, surfels: Surfels, features: list, weights: np.ndarray) -> "mi.Float":
    maps = scene.splat(surfels, features)
    loss = mi.Float(0)
    for k, image in enumerate([*maps.features, maps.depth, maps.alpha]):
        loss += dr.sum(image * upload(weights[..., k]))
    return loss


def fast_gradients(scene: Scene, weights: np.ndarray) -> dict[str, np.ndarray]:
    surfels, features = scene.surfels(), scene.columns()
    dr.enable_grad(surfels.raw, features)
    dr.backward(fast_loss(scene, surfels, features, weights))
    gradients = {name: dr.grad(surfels.raw[name]).numpy() for name in scene.raw}
    gradients["features"] = np.stack([dr.grad(f).numpy() for f in features], axis=1)
    return gradients


def exact_gradients(scene: Scene, weights: np.ndarray) -> dict[str, np.ndarray]:
    """Derivatives of Σ weights · maps in float64."""
    adjoints = np.moveaxis(weights, 2, 0).reshape(6, -1)
    return reference.differentiate(scene.raw, scene.features, scene.camera, adjoints, scene.turns)


def check_gradients(scene: Scene, seed: int, tolerance: float) -> None:
    """Adjoints against float64, and none missing: a derivative that is not 0 never comes back as 0."""
    weights = loss_weights(scene, seed)
    expected, got = exact_gradients(scene, weights), fast_gradients(scene, weights)
    errors = gradient_errors(got, expected)
    assert max(errors.values()) <= tolerance, errors
    for name in PARAMETERS:
        strong = np.abs(expected[name]).max(axis=1) > 1e-3 * max(np.abs(expected[name]).max(), 1e-9)
        assert np.all(np.abs(got[name]).max(axis=1)[strong] > 0), name


def gradient_errors(got: dict[str, np.ndarray], expected: dict[str, np.ndarray]) -> dict[str, float]:
    """Relative L2 error per parameter class."""
    errors = {}
    for name in PARAMETERS:
        assert np.all(np.isfinite(got[name])), name
        scale = np.linalg.norm(expected[name])
        errors[name] = float(np.linalg.norm(got[name] - expected[name]) / scale) if scale > 1e-9 else 0.0
    return errors
