"""The gradient of a sum of losses is the sum of their gradients, for every order and parameter.

Losses of the parameters read them as priors do: their adjoints write to the same leaves as the image's."""

from collections.abc import Callable
from functools import cached_property
from itertools import permutations
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.spatial import cKDTree

from mi_refgs.render.pipeline import SurfelScene, render
from mi_refgs.shade.options import ShadingOptions
from mi_refgs.shade.reflectance import MODELS
from mi_refgs.splat import Camera
from mi_refgs.surfels.attributes import attribute
from tests.gradients import differentiable
from tests.helpers import slow
from tests.scenes import integrator as scenes
from tests.scenes.integrator import background_light, hollow_mesh, lit_scene, raw_channels, sensor, sky

TOLERANCE = 1e-5  # relative to the largest entry of the sum, per parameter: sums by scatter are in any order
COUNT = 400  # surfels: enough that two threads share the work on them
RENDERED = 100  # weight of the images, whose gradients are small beside those of priors
NEIGHBOURS = 4
AROUND = "surroundings_"


def every_channel(model: str, diffuse: Any, gaussians: bool) -> dict[str, np.ndarray]:
    raw, rng = raw_channels(COUNT), np.random.default_rng(5)
    if gaussians:
        raw["scale"] = np.concatenate([raw["scale"], raw["scale"][:, :1]], axis=1)
    wanted = MODELS[model].required_attributes(ShadingOptions(diffuse=diffuse))
    for name in wanted:
        raw.setdefault(name, rng.normal(size=(COUNT, attribute(name).widths[0])).astype(np.float32))
    kept = {"position", "rotation", "scale", "opacity", *wanted}
    return {name: values for name, values in raw.items() if name in kept}


def model_scene(model: str, diffuse: str = "sh", gaussians: bool = False, **changes: Any) -> Any:
    raw = every_channel(model, diffuse, gaussians)
    if "mesh" in changes:
        name = "residual_sh" if "traced_bounces" in changes else "indirect_sh"
        raw[name] = raw_channels(COUNT)["indirect_sh"]
    chosen = {"reflectance": model, "diffuse": diffuse, **changes}
    lit = {"light": None} if MODELS[model].light == "none" else {}
    return scenes.scene(raw=raw, aovs="a:alpha,d:depth,n:normal,s:diffuse", **chosen, **lit)


def open_scene(**changes: Any) -> Any:
    far = every_channel("radiance", "sh", False)
    far["position"] = 1.7 * far["position"]
    around = {AROUND + name: mi.TensorXf(values) for name, values in far.items()}
    return model_scene("split_sum", background=background_light().raw, **around, **changes)


def lit(emitter: dict[str, Any]) -> Any:
    return lit_scene(
        emitter,
        {"sun": {"type": "directional", "direction": [-1, -1, -0.5]}},
        raw=every_channel("split_sum", "sh", False),
        aovs="s:specular",
    )


def map_of(rows: int, columns: int, folder: Path) -> dict[str, Any]:
    path = folder / f"{rows}x{columns}.exr"
    mi.Bitmap(np.resize(sky(rows), (rows, columns, 3))).write(str(path))
    return {"type": "envmap", "filename": str(path), "scale": 0.7}


def textured_scene(method: str) -> Any:
    """A sphere of `refgs_bsdf`, whose materials are textures, under a constant light."""
    rng = np.random.default_rng(2)

    def texture(channels: int) -> dict[str, Any]:
        texels = rng.uniform(0.2, 0.8, (4, 4, channels)).astype(np.float32)
        return {"type": "bitmap", "bitmap": mi.Bitmap(texels), "raw": True}

    bsdf = {"type": "refgs_bsdf", "albedo": texture(3), "metallic": texture(1), "roughness": texture(1)}
    scene = {"type": "scene", "integrator": {"type": method, "max_depth": 3}, "sensor": sensor()}
    ball = {"type": "sphere", "bsdf": bsdf}
    return mi.load_dict(scene | {"ball": ball, "sky": {"type": "constant"}})


def traced(folder: Path, **changes: Any) -> Any:
    """Deferred shading whose rays meet a mesh with materials."""
    return model_scene("split_sum", "irradiance", mesh=hollow_mesh(folder), **changes)


SCENES: dict[str, Callable[[Path], Any]] = {
    **{f"model {name}": lambda _, name=name: model_scene(name) for name in MODELS},  # type: ignore[misc]
    "3D Gaussians": lambda _: model_scene("split_sum", gaussians=True),
    "at surfels": lambda _: model_scene("split_sum", shade_at="surfel"),
    "surroundings": lambda _: open_scene(),
    "surroundings at surfels": lambda _: open_scene(shade_at="surfel"),
    "antialiased": lambda _: model_scene("split_sum", antialias=True),
    "indirect light": lambda folder: model_scene("split_sum", mesh=hollow_mesh(folder)),
    "traced bounces": lambda folder: traced(folder, traced_bounces=1, ambient_rays=4, visibility_rays=2),
    "traced at nodes": lambda folder: traced(folder, traced_bounces=2, antialias=True),
    "envmap": lambda folder: lit(map_of(16, 32, folder)),
    "resampled envmap": lambda folder: lit(map_of(16, 24, folder)),
    "constant": lambda _: lit({"type": "constant", "radiance": {"type": "rgb", "value": [0.5, 1, 2]}}),
    "BSDF, path": lambda _: textured_scene("path"),
    "BSDF, prb": lambda _: textured_scene("prb"),
}

RESAMPLED = "sky.data", "resampled envmap"
SAMPLE = {"traced bounces", "BSDF, prb"}  # tested without `-m slow`; `test_option_pairs` tests others


def trained(scene: Any) -> list[str]:
    """Parameters that fits have; those of all sensors and transformations have a test of their own."""
    ends = ".data", "sky.scale", "sky.radiance.value"
    keys = (key for key in differentiable(scene) if not key.endswith("to_world"))
    return [key for key in keys if key.startswith("integrator.") or key.endswith(ends)]


def numbers(value: Any) -> Any:
    """The numbers of a parameter (mi.Float), under AD."""
    if dr.is_array_v(value):
        return dr.ravel(value)
    return dr.concat([value.matrix[i, j] for i in range(4) for j in range(4)])


class Losses:
    """A scene and its parameters, and losses of all of them by name, whose weights are drawn once."""

    def __init__(self, scene: Any, kept: list[str] | None = None) -> None:
        self.scene, self.params = scene, mi.traverse(scene)
        kept = trained(scene) if kept is None else kept
        self.base = {key: np.array(numbers(self.params[key])) for key in kept}
        self.shape = {key: tuple(getattr(self.params[key], "shape", (16,))) for key in kept}
        self.keys = kept
        rng = np.random.default_rng(0)
        self.picked = {key: mi.UInt32(rng.integers(0, x.size, 2 * x.size)) for key, x in self.base.items()}
        image = mi.render(scene, spp=1)
        self.weight = mi.TensorXf(RENDERED * rng.normal(size=image.shape).astype(np.float32))
        position = raw_channels(COUNT)["position"]
        _, self.neighbour = cKDTree(position).query(position, NEIGHBOURS)
        self.terms: dict[str, Callable[[], Any]] = {
            "image": lambda: self.rendered(1, slice(0, 3)),
            **({"aovs": lambda: self.rendered(4, slice(3, None))} if image.shape[2] > 3 else {}),
            **({"frame": self.frame} if "integrator.light" in kept else {}),
            "slice": lambda: self.priors(lambda _, x: x[..., 0] if isinstance(x, mi.TensorXf) else x),
            "gather": lambda: self.priors(lambda key, x: dr.gather(mi.Float, dr.ravel(x), self.picked[key])),
            "mean": lambda: self.priors(lambda k, x: self.base[k].size ** 0.5 * (2 + dr.mean(dr.ravel(x)))),
            "neighbours": lambda: self.priors(self.differences),
        }

    def leaves(self) -> dict[str, Any]:
        """New leaves of the AD graph in place of the parameters `keys`, and new constants of the others."""
        made = {}
        for key, values in self.base.items():
            kind = type(self.params[key])
            made_of = mi.Matrix4f if kind is mi.Transform4f else kind
            several = dr.depth_v(made_of) > 1  # a colour or a matrix
            parts = [mi.Float(float(x)) for x in values] if several else [mi.Float(values)]
            leaf = made_of(*parts) if kind is not mi.TensorXf else mi.TensorXf(*parts, self.shape[key])
            if key in self.keys:
                dr.enable_grad(leaf)
                made[key] = leaf
            self.params[key] = kind(leaf)
        self.params.update()
        return made

    def rendered(self, spp: int, channels: slice) -> Any:
        """A weighted sum of some channels of an image with so many samples per pixel."""
        image = mi.render(self.scene, self.params, spp=spp, seed=1)
        return dr.sum((image * self.weight)[..., channels], axis=None).array

    def frame(self) -> Any:
        of = self.scene.integrator()
        camera = Camera.from_sensor(self.scene.sensors()[0])
        light = of.shading.light_of(of.light)
        frame = render(SurfelScene(of.surfels, of.shading, light, of.occluder, of.surroundings), camera)
        weight = self.weight.array
        values = [*frame.radiance, frame.alpha, frame.depth]
        rows = dr.arange(mi.UInt32, dr.width(frame.alpha))
        return sum(dr.sum(x * dr.gather(mi.Float, weight, rows + i)) for i, x in enumerate(values))

    def priors(self, read: Callable[[str, Any], Any]) -> Any:
        """Sum of squares of what is read of each parameter."""
        total = mi.Float(0)
        for key in self.keys:
            value = self.params[key]
            value = read(key, value if isinstance(value, mi.TensorXf) else numbers(value))
            total += dr.sum(dr.square(dr.ravel(value)))
        return total

    def differences(self, key: str, x: Any) -> Any:
        """Each row minus its neighbours: of surfels the nearest ones, of a map the next rows."""
        flat, rows = dr.ravel(x), self.shape[key][0]
        width = dr.width(flat) // rows
        near = self.neighbour if rows == COUNT else np.arange(rows)[:, None] + np.arange(NEIGHBOURS)
        other = np.repeat(near % rows, width, axis=0) * width + np.tile(np.arange(width), rows)[:, None]
        own = dr.arange(mi.UInt32, rows * width)
        return sum(
            dr.gather(mi.Float, flat, own) - dr.gather(mi.Float, flat, mi.UInt32(column))
            for column in other.T.astype(np.uint32)
        )

    def gradient(self, *names: str) -> dict[str, np.ndarray]:
        """Reverse mode: the gradient of the sum of these losses, made in this order."""
        leaves = self.leaves()
        dr.backward(sum((self.terms[name]() for name in names), start=mi.Float(0)))
        return {key: np.array(dr.ravel(dr.grad(leaf))) for key, leaf in leaves.items()}

    @cached_property
    def gradients(self) -> dict[str, dict[str, np.ndarray]]:
        """The gradient of each loss alone."""
        return {name: self.gradient(name) for name in self.terms}


@pytest.fixture(scope="module", params=[name if name in SAMPLE else slow(name) for name in SCENES])
def losses(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Losses:
    scene = SCENES[request.param](tmp_path_factory.mktemp("scene"))
    # Mitsuba's texels of a map that is resampled have no derivative, and say so.
    return Losses(scene, [key for key in trained(scene) if (key, request.param) != RESAMPLED])


def check_additive(losses: Losses, alone: dict[str, Any], orders: list[tuple[str, ...]]) -> None:
    for order in orders:
        for key, found in losses.gradient(*order).items():
            parts = [alone[name][key] for name in order]
            sizes = [np.abs(part).max() for part in parts]
            error, least = np.abs(found - sum(parts)).max(), min(size for size in sizes if size)
            # What one loss has lost must show even where another has a thousand times its gradient.
            wrong = error > TOLERANCE * max(sizes) or error > 0.1 * least
            assert not wrong, f"{key}: {', then '.join(order)}: off by {error:.1e}, gradients {sizes}"


@pytest.mark.parametrize("threads", [2, slow(1)])
def test_gradients_of_losses_add(losses: Losses, threads: int, set_threads: Callable[[int], None]) -> None:
    """In two orders, in which each loss comes before each other one."""
    set_threads(threads)
    names = (*losses.terms,)
    check_additive(losses, losses.gradients, [names, names[::-1]])


def test_gradients_of_every_pair_of_losses_add(set_threads: Callable[[int], None]) -> None:
    """Two losses of one parameter at a time, so that nothing else evaluates what they write."""
    losses = Losses(model_scene("split_sum"))
    set_threads(2)
    for key in ("integrator.albedo", "integrator.roughness", "integrator.light"):
        losses.keys = [key]
        alone = {name: losses.gradient(name) for name in losses.terms}
        check_additive(losses, alone, [*permutations(losses.terms, 2)])


def test_gradients_of_cameras_and_rotations_add(tmp_path: Path) -> None:
    scene = lit(map_of(16, 32, tmp_path))
    losses = Losses(scene, [key for key in differentiable(scene) if key.startswith("s")])
    check_additive(losses, losses.gradients, [names := (*losses.terms,), names[::-1]])


def test_every_parameter_has_a_gradient(losses: Losses) -> None:
    """A gradient of zero could not be lost."""
    found = [losses.gradients[name] for name in ("image", "aovs") if name in losses.terms]
    for key in losses.base:
        assert any(np.abs(gradient[key]).max() > 0 for gradient in found), key
