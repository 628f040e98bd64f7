"""Random scenes for the laws, always of the same size, so that kernels are compiled once."""

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mi_refgs.kernels.device import upload
from mi_refgs.reference.camera import look_at
from mi_refgs.render.pipeline import Frame, Request, SurfelScene, render
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.shading import Shading
from mi_refgs.splat.camera import Camera
from mi_refgs.surfels.table import Surfels
from tests.scenes import integrator as scenes

COUNT, WIDTH, HEIGHT, FOCAL = 40, 24, 16, 26.0
LIGHT_ROWS = 16
SHADINGS = (Shading(), Shading(at="surfel", diffuse="irradiance"))  # both orders, both diffuse terms

Raw = dict[str, np.ndarray]


@dataclass(frozen=True)
class View:
    """A pinhole camera on the host, so that a law can move it."""

    to_world: np.ndarray
    near: float = 0.01
    width: int = WIDTH
    height: int = HEIGHT

    def camera(self) -> Camera:
        centre = self.width / 2, self.height / 2
        return Camera.from_pose(self.width, self.height, -FOCAL, -FOCAL, *centre, self.to_world, self.near)

    def sensor(self) -> dict[str, Any]:
        """As Mitsuba's scenes have it."""
        film = {"width": self.width, "height": self.height, "pixel_format": "rgba"}
        fov = float(2 * np.degrees(np.arctan(self.width / 2 / FOCAL)))
        return scenes.sensor(fov=fov, to_world=mi.ScalarTransform4f(self.to_world), film=film)

    def turned(self, turn: Rotation) -> "View":
        matrix = np.eye(4)
        matrix[:3, :3] = turn.as_matrix()
        return replace(self, to_world=matrix @ self.to_world)


@dataclass(frozen=True)
class Scene:
    """COUNT surfels or 3D Gaussians in a cloud of radius about 1 around the origin, and a view of it."""

    raw: Raw
    view: View

    def with_rows(self, parent: np.ndarray) -> "Scene":
        return replace(self, raw={name: values[parent] for name, values in self.raw.items()})

    def changed(self, **channels: np.ndarray) -> "Scene":
        return replace(self, raw=self.raw | {k: np.asarray(v, np.float32) for k, v in channels.items()})


def random_scene(
    seed: int, size: float = 0.25, flatness: float = 0.0, opacity: float = 0.0, axes: int = 2
) -> Scene:
    """`size` of the discs, log₁₀ of the ratio of their axes, mean logit of opacity; 3 `axes`: Gaussians."""
    rng = np.random.default_rng(seed)
    scale = np.log(size * rng.uniform(0.3, 1.5, (COUNT, axes)))
    scale[:, 1] -= flatness * np.log(10) * rng.uniform(size=COUNT)
    raw = {
        "position": 0.5 * rng.normal(size=(COUNT, 3)),
        "rotation": rng.normal(size=(COUNT, 4)),
        "scale": scale,
        "opacity": opacity + rng.normal(size=(COUNT, 1)),
        "radiance_sh": 0.3 * rng.normal(size=(COUNT, 12)),
        "albedo": rng.normal(size=(COUNT, 3)),
        "metallic": rng.normal(size=(COUNT, 1)),
        "roughness": rng.normal(size=(COUNT, 1)),
        "indirect_sh": 0.15 * rng.normal(size=(COUNT, 12)) + 0.5 * (np.arange(12) < 3),
    }
    origin = rng.normal(size=3)
    origin *= rng.uniform(2.5, 4) / np.linalg.norm(origin)
    pose = look_at(origin, 0.2 * rng.normal(size=3), tuple(rng.normal(size=3)))
    return Scene({name: values.astype(np.float32) for name, values in raw.items()}, View(pose))


SEEDS = st.integers(0, 2**32 - 1)
SCENES = st.builds(
    random_scene,
    seed=SEEDS,
    size=st.floats(0.02, 0.6),
    flatness=st.floats(0, 2),
    opacity=st.floats(-3, 5),
    axes=st.sampled_from([2, 3]),
)
DISCS = SCENES.filter(lambda scene: scene.raw["scale"].shape[1] == 2)


@cache
def light() -> Any:
    return EnvironmentLight.from_radiance(scenes.sky(LIGHT_ROWS)).prefilter()


def draw(scene: Scene, shading: Shading = SHADINGS[0], by: Any = None) -> dict[str, np.ndarray]:
    drawn = SurfelScene(Surfels.from_numpy(scene.raw), shading, by or light())
    return maps_of(render(drawn, scene.view.camera(), Request(drawn.all_aovs)))


def maps_of(frame: Frame) -> dict[str, np.ndarray]:
    assert frame.terms is not None
    maps = {"alpha": frame.alpha, "depth": frame.depth, "normal": frame.normal, "radiance": frame.radiance}
    maps |= {"specular": frame.terms.specular, **frame.maps}
    return {name: np.atleast_2d(np.array(values, np.float64)).T for name, values in maps.items()}


def gradients(
    scene: Scene, shading: Shading, seed: int, views: tuple[View, ...] | None = None
) -> dict[str, np.ndarray]:
    """Derivatives of a randomly weighted sum over maps and views (default: the scene's own) by channel."""
    weight = np.random.default_rng(seed).normal(size=(8, WIDTH * HEIGHT))
    surfels = Surfels.from_numpy(scene.raw)
    surfels.enable_grad()
    loss = mi.Float(0)
    for view in views or (scene.view,):
        frame = render(SurfelScene(surfels, shading, light()), view.camera(), Request(("normal",)))
        values = [*frame.radiance, *frame.normal, frame.depth, frame.alpha]
        loss += sum((dr.sum(v * upload(w)) for v, w in zip(values, weight, strict=True)), mi.Float(0))
    dr.backward(loss)
    return {name: np.array(dr.grad(tensor).numpy()) for name, tensor in surfels.raw.items()}


def differing(a: dict[str, np.ndarray], b: dict[str, np.ndarray], tolerance: float) -> float:
    """Share of the pixels in which a map differs by more than the tolerance, of 1 or its largest value."""
    assert a.keys() == b.keys()
    bad = np.zeros(len(a["alpha"]), bool)
    for name, values in a.items():
        assert np.all(np.isfinite(values)) and np.all(np.isfinite(b[name])), name
        bad |= np.any(np.abs(values - b[name]) > tolerance * max(1, np.abs(values).max()), axis=1)
    return float(bad.mean())


def rotated(scene: Scene, turn: Rotation) -> Scene:
    position = turn.apply(scene.raw["position"])
    rotation = (turn * Rotation.from_quat(scene.raw["rotation"])).as_quat()
    return replace(scene.changed(position=position, rotation=rotation), view=scene.view.turned(turn))
