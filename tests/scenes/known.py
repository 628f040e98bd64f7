"""A path-traced data set whose every material is known, and the run that has found all of it."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from mi_refgs.data.dataset import read_dataset
from mi_refgs.io.exr import write_exr
from mi_refgs.methods.read import load
from mi_refgs.occlusion.mesh import Mesh
from mi_refgs.render.surroundings import Surroundings
from mi_refgs.runs.export import export
from mi_refgs.runs.run import Run
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.shading import Shading
from mi_refgs.surfels.attributes import logit
from mi_refgs.surfels.init import from_points
from mi_refgs.surfels.table import Surfels
from mi_refgs.synthesis.make_dataset import make_dataset
from tests.scenes.integrator import joined, sky

SIZE = 40
METAL: dict[str, Any] = {"albedo": (0.9, 0.6, 0.3), "roughness": 0.35, "metallic": 1.0}
CLAY: dict[str, Any] = {"albedo": (0.2, 0.55, 0.35), "roughness": 0.5, "metallic": 0.0}
CENTRES = np.array([[-0.5, 0, 0], [0.55, 0, -0.1]])
RADII = np.array([0.5, 0.45])
SURFELS = 6000


def _ball(material: dict[str, Any], centre: np.ndarray, radius: float) -> str:
    colour = ", ".join(map(str, material["albedo"]))
    x, y, z = centre
    return f"""<shape type="sphere"><point name="center" x="{x}" y="{y}" z="{z}"/>
        <float name="radius" value="{radius}"/><bsdf type="refgs_bsdf">
        <rgb name="albedo" value="{colour}"/><float name="metallic" value="{material["metallic"]}"/>
        <float name="roughness" value="{material["roughness"]}"/></bsdf></shape>"""


def write_known_data(folder: Path, spp: int = 64) -> Path:
    """Two balls, one of metal and one of glaze, under one sky, and the test views also under another."""
    folder.mkdir(parents=True, exist_ok=True)
    write_exr(folder / "day.exr", sky(32))
    write_exr(folder / "dusk.exr", other_sky())
    balls = (_ball(*ball) for ball in zip((METAL, CLAY), CENTRES, RADII, strict=True))
    (folder / "balls.xml").write_text(
        '<scene version="3.0.0"><emitter type="envmap"><string name="filename" value="day.exr"/>'
        '<transform name="to_world"><rotate x="1" angle="90"/></transform></emitter>'
        f"{''.join(balls)}</scene>"
    )
    spec: dict[str, Any] = {"views": 2, "test_views": 3, "size": SIZE, "spp": spp, "environment_height": 32}
    lights = [folder / "dusk.exr"]
    return make_dataset(folder / "balls.xml", folder / "data", relight=lights, progress=False, **spec)


def other_sky() -> np.ndarray:
    """A lat-long map with a warm band and a dark half."""
    row, column = np.mgrid[0:32, 0:64]
    warm = 0.2 + 2 * np.exp(-(((row - 14) / 4) ** 2)) * (1 + np.cos(column / 64 * 2 * np.pi))
    return np.stack([warm, 0.7 * warm, 0.3 * warm + 0.2], axis=-1).astype(np.float32)


def known_surfels() -> Surfels:
    """The balls as opaque surfels, evenly spread, with the true materials."""
    ball = np.arange(SURFELS) % 2
    z = 1 - (2 * (np.arange(SURFELS) // 2) + 1) / (SURFELS // 2)
    angle = np.arange(SURFELS) // 2 * np.pi * (3 - np.sqrt(5))
    ring = np.sqrt(1 - z**2)
    normals = np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=1)
    points = CENTRES[ball] + RADII[ball, None] * normals
    channels = ["radiance_sh", "albedo", "metallic", "roughness"]
    rng = np.random.default_rng(0)
    surfels = from_points(points, normals, rng=rng, attributes=channels, scale_factor=0.8, opacity=0.999)
    raw = surfels.to_numpy()
    for name in ("albedo", "metallic", "roughness"):
        raw[name] = logit(np.array([np.atleast_1d(material[name]) for material in (METAL, CLAY)])[ball])
    return Surfels.from_numpy(raw)


def known_mesh() -> Mesh:
    """The balls, of few enough triangles to be quick."""
    parts = zip(CENTRES, RADII, strict=True)
    return joined(2e-3, *(trimesh.creation.icosphere(3, r).apply_translation(c) for c, r in parts))


def known_scene() -> TrainedScene:
    """A ball of metal and one of glaze under a sky, whose every material is known."""
    shading = Shading(diffuse="irradiance", occlusion=True)
    light = EnvironmentLight.from_radiance(sky(32))
    return TrainedScene(known_surfels(), light, known_mesh(), shading, 1, 0.0)


def with_background(scene: TrainedScene, radiance: float | None = None) -> TrainedScene:
    """The ball of metal as the object, the other as its background, before a map of constant radiance."""
    raw = scene.surfels.to_numpy()
    own = raw["position"][:, 0] < 0
    geometry = ("position", "rotation", "scale", "opacity", "radiance_sh")
    others = Surfels.from_numpy({name: raw[name][~own] for name in geometry})
    behind = None if radiance is None else EnvironmentLight.constant(radiance, 8)
    surfels = Surfels.from_numpy({name: table[own] for name, table in raw.items()})
    return replace(scene, surfels=surfels, surroundings=Surroundings(others, behind))


def write_known_run(data: Path, folder: Path, **shading: Any) -> Run:
    """The run that has found everything: true materials, surface and light; `shading` as in `Shading`."""
    run = Run(folder)
    run.create(load("ref_gaussian", "quick"), str(data))
    chosen: dict[str, Any] = {"diffuse": "irradiance", "occlusion": True} | shading
    light = EnvironmentLight.from_file(data / "environment.exr")
    scene = TrainedScene(known_surfels(), light, known_mesh(), Shading(**chosen), 1, 0.0)
    export(scene, run.path, read_dataset(data, "test").views[0].camera())
    return run
