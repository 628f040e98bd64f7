"""3D Gaussians of a scene for other viewers."""

from __future__ import annotations

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest

from mi_refgs.formats import Shot
from mi_refgs.formats.gaussians import THIN, gaussians
from mi_refgs.formats.orbits import shots_around
from mi_refgs.render.display import display_image, image_array
from mi_refgs.render.pipeline import SurfelScene, render
from mi_refgs.render.surroundings import Surroundings
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.shading import Shading
from mi_refgs.splat import Camera
from mi_refgs.surfels.attributes import SH_DC, logit
from mi_refgs.surfels.table import Surfels
from tests.helpers import refused

COUNT, SIZE = 1500, 64
BACKWARDS = np.diag([-1.0, 1.0, -1.0, 1.0])  # half a turn about the camera's y axis


def ball(rng: np.random.Generator, count: int = COUNT) -> dict[str, np.ndarray]:
    """Opaque surfels on the unit sphere, with materials."""
    k = np.arange(count) + 0.5
    z, turn = 1 - 2 * k / count, k * np.pi * (3 - np.sqrt(5))
    ring = np.sqrt(1 - z**2)
    normal = np.stack([ring * np.cos(turn), ring * np.sin(turn), z], axis=1)
    rotation = np.concatenate([np.stack([-normal[:, 1], normal[:, 0]], 1), 0 * z[:, None], 1 + z[:, None]], 1)
    rotation *= np.where(rng.random((count, 1)) < 0.5, 1, -1)  # the same
    raw = {"position": normal, "rotation": rotation, "scale": np.full((count, 2), np.log(0.06))}
    raw["albedo"] = logit(np.clip(0.5 + 0.4 * normal, 0.01, 0.99))
    values = {"opacity": 0.95, "metallic": 0.2, "roughness": 0.6}
    return raw | {name: np.full((count, 1), logit(value)) for name, value in values.items()}


def sky() -> EnvironmentLight:
    """A light that changes with the direction."""
    rows, columns = np.meshgrid(np.linspace(0, 1, 16), np.linspace(0, 2 * np.pi, 32), indexing="ij")
    texels = np.stack([1.2 - rows, 0.7 + 0.3 * np.sin(columns), 0.3 + rows], axis=-1)
    return EnvironmentLight.from_radiance(mi.TensorXf(texels.astype(np.float32)))


@pytest.fixture
def scene(rng: np.random.Generator) -> TrainedScene:
    """The ball under the sky, shaded in the G-buffer."""
    surfels = Surfels.from_numpy(ball(rng))
    return TrainedScene(surfels, sky(), None, Shading("pixel", "split_sum", "irradiance"), 1, 0.0)


@pytest.fixture
def shots(scene: TrainedScene) -> list[Shot]:
    """A few small cameras around it."""
    return [replace(shot, camera=shot.camera.resized(SIZE)) for shot in shots_around(scene.surfels)[::5]]


def encoded(scene: TrainedScene, camera: Camera, alone: bool = False) -> np.ndarray:
    """Display-encoded on black, (H, W, 4) with alpha."""
    scene = replace(scene, surroundings=None) if alone else scene
    frame = scene.renderer(aovs=False)(camera)
    shown = display_image(list(frame.radiance), frame.alpha, [0.0] * 3)
    return image_array([*shown, frame.alpha], camera.height, camera.width)


def their_image(table: Surfels, camera: Camera) -> np.ndarray:
    """The formula of 3DGS (H, W, 4): encoded colours are blended."""
    frame = render(SurfelScene(table, Shading("surfel", "radiance")), camera)
    return image_array([*frame.radiance, frame.alpha], camera.height, camera.width)


def db(a: np.ndarray, b: np.ndarray) -> float:
    return float(-10 * np.log10(np.mean((a - b) ** 2)))


def test_gaussians_render_the_same_image(scene: TrainedScene, shots: list[Shot]) -> None:
    """Colour and outline agree at cameras between those that colours were fitted to."""
    table = gaussians(scene, shots, 3, False)
    assert table.primitive.name == "gaussian" and table.sh_degree() == 3
    for shot in [shot for shot in shots if shot.split == "test"]:
        ours, theirs = encoded(scene, shot.camera), their_image(table, shot.camera)
        inside = ours[..., 3] > 0.99
        assert inside.mean() > 0.3
        assert db(theirs[inside, :3], ours[inside, :3]) > 34
        assert db(theirs[..., :3], ours[..., :3]) > 28
        assert db(theirs[..., 3], ours[..., 3]) > 19  # its outline is long for so few pixels


def test_gaussians_are_thin_along_the_normal_and_inset(scene: TrainedScene, shots: list[Shot]) -> None:
    """Scales and opacities stay; surfels move inwards by less than a pixel, whichever way normals point."""
    before = scene.surfels.to_numpy()
    after = gaussians(scene, shots, 0, False).to_numpy()
    np.testing.assert_array_equal(after["scale"][:, :2], before["scale"])
    np.testing.assert_allclose(after["scale"][:, 2], np.log(0.06 * THIN), rtol=1e-5)
    np.testing.assert_array_equal(after["opacity"], before["opacity"])
    np.testing.assert_array_equal(after["rotation"], before["rotation"])
    radius = np.linalg.norm(after["position"], axis=1)
    camera = shots[0].camera
    pixel = np.linalg.norm(camera.pose()[:3, 3]) / camera.focal
    seen = before["position"][:, 2] > -0.3  # the cameras are above
    assert (radius[seen] < 1 - 0.3 * pixel).mean() > 0.95 and radius.min() > 1 - pixel


def test_unseen_gaussians_get_the_colour_of_neighbours(scene: TrainedScene, shots: list[Shot]) -> None:
    """Their colour is not the grey of zero coefficients."""
    camera = replace(shots[0].camera, width=SIZE // 2)
    table = gaussians(scene, [Shot("only", "train", camera)], 0, False).to_numpy()
    place = camera.to_camera(scene.surfels.position())
    column = (camera.fx * place.x / place.z + camera.cx).numpy()
    beside = column > camera.width + 8
    assert beside.sum() > 50 and np.abs(table["radiance_sh"][beside]).max(axis=1).min() > 1e-3


def test_empty_views_do_not_change_colours(scene: TrainedScene, shots: list[Shot]) -> None:
    """A camera that looks away has no effect; if all do, colours are still finite."""
    away = [replace(shot, camera=shot.camera.moved(shot.camera.pose() @ BACKWARDS)) for shot in shots]
    train = [shot for shot in shots if shot.split == "train"]
    few, more = (gaussians(scene, given, 1, False).to_numpy() for given in (train, [*train, away[0]]))
    np.testing.assert_allclose(more["radiance_sh"], few["radiance_sh"], atol=1e-4)
    none = gaussians(scene, away, 1, False).to_numpy()
    assert all(np.isfinite(table).all() for table in none.values())
    refused(lambda: gaussians(scene, shots, 4, False), "--degree: 4 is out of range")


def test_background_gaussians_are_exported_unless_object_only(
    scene: TrainedScene, shots: list[Shot], rng: np.random.Generator
) -> None:
    raw = ball(rng, 400)
    around = {name: raw[name] for name in ("rotation", "opacity")}
    around |= {"position": raw["position"] * 0.4 + [0, 0, -1.4], "scale": raw["scale"] + np.log(0.8)}
    around["radiance_sh"] = np.tile((np.array([0.8, 0.1, 0.1]) - 0.5) / SH_DC, (400, 1))
    both = replace(scene, surroundings=Surroundings(Surfels.from_numpy(around)))
    camera = shots[0].camera
    whole, alone = (gaussians(both, shots, 2, object) for object in (False, True))
    assert whole.count == COUNT + 400 and alone.count == COUNT
    assert db(their_image(whole, camera)[..., :3], encoded(both, camera)[..., :3]) > 26
    assert db(their_image(alone, camera)[..., :3], encoded(both, camera, alone=True)[..., :3]) > 28
