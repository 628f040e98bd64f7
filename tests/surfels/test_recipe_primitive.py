"""CONTRIBUTING's recipe "a primitive": balls with one radius, from points to a fit and a file."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_refgs import Reconstruction, methods
from mi_refgs.cli import main
from mi_refgs.constants import ALPHA_MAX, ALPHA_MIN
from mi_refgs.errors import InputError
from mi_refgs.fitting.events import densify
from mi_refgs.kernels.device import upload
from mi_refgs.render.surroundings import Surroundings
from mi_refgs.splat import Camera, splat
from mi_refgs.surfels import attributes
from mi_refgs.surfels.attributes import Attribute
from mi_refgs.surfels.init import from_points
from mi_refgs.surfels.ply import read_ply, write_ply
from mi_refgs.surfels.primitives import primitive as base
from mi_refgs.surfels.primitives.primitive import Footprints, cutoff_radius_squared, rectangle
from mi_refgs.surfels.table import Surfels
from tests.scenes.tiny import train_command, write_data, write_method

RADIUS = Attribute("radius", (1,), "exp", 5e-3, ("radius",), geometry=True)


@dataclass(frozen=True)
class BallSample(base.FootprintSample):
    gaussian: Any
    delta: Any


class BallAdjoint:
    def __init__(self) -> None:
        self.sums = [mi.Float(0)] * 5  # of columns

    def add(self, sample: BallSample, δalpha: Any, δz: Any) -> None:
        δalpha = dr.select(sample.alpha < ALPHA_MAX, δalpha, 0)
        slope, (x, y) = δalpha * sample.alpha, sample.delta
        columns = (-0.5 * slope * dr.squared_norm(sample.delta), δz, slope * x, slope * y)
        added = (*columns, δalpha * sample.gaussian)
        self.sums = [total + value for total, value in zip(self.sums, added, strict=True)]

    def columns(self, row: Any) -> list[Any]:
        sharpness, z, x, y, opacity = self.sums
        return [sharpness, z, x * row[0], y * row[0], opacity]


class Ball(base.Primitive):
    """A round Gaussian whose projection is round: α = o exp(-|δ|²/(2 σ²)), σ = max(f r/z, ½) pixels."""

    name = "ball"
    widths = {"position": 3, "radius": 1, "opacity": 1}  # noqa: RUF012
    adjoint = BallAdjoint
    columns = 5  # 1/σ², p.z, centre.x, centre.y, opacity
    sizes = ("radius",)

    def project(self, surfels: Any, camera: Any) -> Footprints:
        p, opacity = camera.to_camera(surfels.position()), surfels.opacity()
        visible = dr.detach((p.z > camera.near) & (p.z > 0) & (opacity >= ALPHA_MIN))
        z = dr.select(visible, p.z, 1)
        centre = mi.Vector2f(camera.fx * p.x / z + camera.cx, camera.fy * p.y / z + camera.cy)
        sigma = dr.maximum(dr.abs(camera.fx) * surfels.value("radius") / z, 0.5)
        columns = [dr.rcp(sigma * sigma), z, centre.x, centre.y, opacity]
        with dr.suspend_grad():
            half = mi.Vector2f(sigma * dr.sqrt(cutoff_radius_squared(opacity)) + 1e-3)
            covered = rectangle(centre, -half, half, visible, camera)
        return Footprints([dr.select(visible, x, 0) for x in columns], *covered, self)

    def evaluate(self, row: Any, pixel: Any, near: Any) -> BallSample:
        delta = mi.Vector2f(pixel.x - row[2], pixel.y - row[3])
        gaussian = dr.exp(-0.5 * row[0] * dr.squared_norm(delta))
        alpha = dr.minimum(row[4] * gaussian, ALPHA_MAX)
        return BallSample(alpha, row[1], alpha >= ALPHA_MIN, gaussian, delta)

    def normal(self, surfels: Any) -> Any:
        return dr.normalize(mi.Vector3f(surfels.position()))  # out of a convex thing at the origin

    def overlaps(self, row: list[Any], low: Any, high: Any) -> Any:
        x, y = dr.clip(0, low.x - row[2], high.x - row[2]), dr.clip(0, low.y - row[3], high.y - row[3])
        return row[0] * (x * x + y * y) <= cutoff_radius_squared(row[4]) * 1.001

    def depth_near(self, row: list[Any], pixel: Any) -> Any:
        return row[1]

    def start(self, spacing: np.ndarray, rotation: np.ndarray) -> dict[str, np.ndarray]:
        return {"radius": np.log(spacing)[:, None]}

    def extent(self, raw: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        count = len(raw["radius"])
        return np.tile(np.eye(3, dtype=np.float32), (count, 1, 1)), np.exp(raw["radius"].repeat(3, 1))


@pytest.fixture(autouse=True)
def registered() -> Iterator[None]:
    attributes.register(RADIUS)
    base.register(Ball())
    yield
    base.PRIMITIVES.unregister("ball")
    attributes.ATTRIBUTES.unregister("radius")


def balls(count: int = 30) -> Surfels:
    rng = np.random.default_rng(0)
    points = 0.4 * rng.normal(size=(count, 3))
    made = from_points(points, rng=rng, primitive="ball", attributes=[], opacity=0.6)
    return Surfels.from_numpy({n: v + 0.3 * rng.normal(size=v.shape) for n, v in made.to_numpy().items()})


def camera() -> Camera:
    pose = np.eye(4)
    pose[2, 3] = -3.0
    return Camera.from_pose(24, 20, -30.0, -30.0, 12.0, 10.0, pose)


def in_numpy(raw: dict[str, np.ndarray], feature: np.ndarray) -> np.ndarray:
    """Maps (3, 20, 24) in float64: the feature's, depth, alpha."""
    x, y = np.meshgrid(np.arange(24) + 0.5, np.arange(20) + 0.5)
    maps, transmittance = np.zeros((3, 20, 24)), np.ones((20, 24))
    for i in np.argsort(raw["position"][:, 2]):
        px, py, z = raw["position"][i] + [0, 0, 3]
        sigma = max(30 * np.exp(raw["radius"][i, 0]) / z, 0.5)
        squared = (x + 30 * px / z - 12) ** 2 + (y + 30 * py / z - 10) ** 2
        alpha = np.exp(-squared / (2 * sigma**2)) / (1 + np.exp(-raw["opacity"][i, 0]))
        alpha = np.where(alpha >= ALPHA_MIN, np.minimum(alpha, ALPHA_MAX), 0)
        maps += transmittance * alpha * np.array([feature[i], z, 1])[:, None, None]
        transmittance *= 1 - alpha
    return maps


def test_attributes_decide_the_primitive() -> None:
    assert balls().primitive.name == "ball" and set(balls().raw) == {"position", "radius", "opacity"}


def test_balls_are_not_splatted_together_with_gaussians() -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(5, 3))
    gaussians = from_points(points, rng=rng, primitive="gaussian", attributes=["radiance_sh"])
    with pytest.raises(InputError, match=r"'gaussian' is not splatted together with 'ball'.*the same primit"):
        Surroundings(gaussians).check(balls())
    Surroundings(gaussians).check(gaussians)


def test_balls_are_splatted_and_differentiated() -> None:
    """Images against NumPy; reverse mode against differences of it, and against forward mode."""
    rng, surfels = np.random.default_rng(1), balls()
    feature, weights = rng.uniform(size=30), rng.normal(size=(3, 20, 24))
    raw = {name: values.astype(np.float64) for name, values in surfels.to_numpy().items()}
    maps = splat([surfels], [upload(feature)], camera())
    found = np.stack([np.array(m).reshape(20, 24) for m in (maps.features[0], maps.depth, maps.alpha)])
    np.testing.assert_allclose(found, in_numpy(raw, feature), atol=2e-5)

    def loss() -> Any:
        maps = splat([surfels], [upload(feature)], camera())
        values = (maps.features[0], maps.depth, maps.alpha)
        return sum((dr.sum(v * upload(w)) for v, w in zip(values, weights, strict=True)), mi.Float(0))

    surfels.enable_grad()
    dr.backward(loss())
    slopes = {name: dr.grad(tensor).numpy() for name, tensor in surfels.raw.items()}
    direction = {name: rng.normal(size=values.shape) for name, values in raw.items()}
    expected = sum(np.sum(slopes[name] * direction[name]) for name in raw)
    sides = []
    for step in (1e-6, -1e-6):
        moved = {name: values + step * direction[name] for name, values in raw.items()}
        sides.append(np.sum(weights * in_numpy(moved, feature)))
    assert expected == pytest.approx((sides[0] - sides[1]) / 2e-6, rel=5e-3)
    for name, tensor in surfels.raw.items():
        dr.clear_grad(tensor)
        dr.set_grad(tensor, mi.TensorXf(direction[name].astype(np.float32)))
    assert dr.forward_to(loss())[0] == pytest.approx(expected, rel=1e-3)


def test_balls_are_split_and_written(tmp_path: Path) -> None:
    surfels = balls()
    error = np.arange(30.0) - 9  # two thirds have one
    edited = densify.densify_and_prune(surfels, error, 90, grow=1.0)
    before, after = surfels.to_numpy(), edited.surfels.to_numpy()
    assert len(edited.parent) == 50 and edited.fresh.sum() == 40
    shrunk = np.where(edited.fresh, np.log(densify.SPLIT_SCALE), 0)
    np.testing.assert_allclose(after["radius"][:, 0], before["radius"][edited.parent, 0] + shrunk, rtol=1e-5)
    write_ply(tmp_path / "balls.ply", edited.surfels)
    read = read_ply(tmp_path / "balls.ply")
    assert read.primitive.name == "ball"
    made = Reconstruction.from_params(before | {"radiance_sh": np.zeros((len(before["radius"]), 3))})
    assert made.export("3dgs-ply", tmp_path / "gaussians.ply") and made.render(0, size=16)[..., 3].max() > 0.5
    np.testing.assert_array_equal(read.to_numpy()["radius"], after["radius"])


def test_balls_are_fitted(tmp_path: Path) -> None:
    """A method names them; the run's own scene, checkpoint and evaluation have them."""
    text = f"""
        iterations = {methods.PRESETS["quick"].iterations}
        checkpoint_every = 3
        surfels = {{ primitive = "ball", attributes = ["radiance_sh"], degree = {{ radiance_sh = 1 }} }}
        stage.all = {{ until = 6, reflectance = "radiance" }}
        event.densify = {{ when = {{ start = 1, until = 6, every = 2 }}, prune_extent = 10.0 }}
        """
    data, run = write_data(tmp_path / "data"), tmp_path / "run"
    assert main(train_command(data, run, write_method(tmp_path, text))) == 0
    fitted = read_ply(run / "surfels.ply")
    assert fitted.primitive.name == "ball" and 80 < fitted.count <= 100
    assert main(["eval", str(run)]) == 0
    assert main(["train", str(data), "-o", str(run), "--resume"]) == 0
    picture = np.array(mi.render(mi.load_file(str(run / "scene.xml"))))
    assert np.isfinite(picture).all() and picture.max() > 0.3
