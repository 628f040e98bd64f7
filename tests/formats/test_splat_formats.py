"""3D Gaussians of a scene in PLY and glTF files for other viewers, and a view with its layers as EXR."""

import json
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from mi_refgs.formats import Shot, write
from mi_refgs.formats.gaussians import THIN, gaussians
from mi_refgs.formats.orbits import shots_around
from mi_refgs.render.display import display_image, image_array
from mi_refgs.render.pipeline import SurfelScene, render
from mi_refgs.render.surroundings import Surroundings
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.sh import sh_basis
from mi_refgs.shade.shading import Shading
from mi_refgs.splat import Camera
from mi_refgs.surfels.attributes import SH_DC, logit
from mi_refgs.surfels.ply import read_ply
from mi_refgs.surfels.table import Surfels
from tests.helpers import read_exr, refused

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
    beside = (camera.fx * place.x / place.z + camera.cx).numpy() > camera.width + 8
    assert beside.sum() > 50 and np.abs(table["radiance_sh"][beside]).max(axis=1).min() > 1e-3


def test_empty_views_do_not_change_colours(scene: TrainedScene, shots: list[Shot]) -> None:
    """A camera that looks away has no effect; if all do, colours are still finite."""
    away = [replace(shot, camera=shot.camera.moved(shot.camera.pose() @ BACKWARDS)) for shot in shots]
    train = [shot for shot in shots if shot.split == "train"]
    few, more = (gaussians(scene, given, 1, False).to_numpy() for given in (train, [*train, away[0]]))
    np.testing.assert_allclose(more["radiance_sh"], few["radiance_sh"], atol=1e-4)
    assert all(np.isfinite(table).all() for table in gaussians(scene, away, 1, False).to_numpy().values())
    refused(lambda: gaussians(scene, shots, 4, False), "--degree: 4 is out of range")


def test_background_gaussians(scene: TrainedScene, shots: list[Shot], rng: np.random.Generator) -> None:
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


def columns_of(file: Path) -> tuple[dict[str, Any], Callable[[str], np.ndarray]]:
    """JSON of a binary glTF file, and its attributes by name."""
    data = file.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", data)
    size, kind = struct.unpack_from("<I4s", data, 12)
    content = json.loads(data[20 : 20 + size])
    rest, binary = struct.unpack_from("<I4s", data, 20 + size)
    assert (magic, version, length, kind, binary) == (b"glTF", 2, len(data), b"JSON", b"BIN\0")
    assert size % 4 == rest % 4 == 0 and content["buffers"][0]["byteLength"] == rest == len(data) - 28 - size

    def column(name: str) -> np.ndarray:
        accessor = content["accessors"][content["meshes"][0]["primitives"][0]["attributes"][name]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        view = content["bufferViews"][accessor["bufferView"]]
        offset = 28 + size + view["byteOffset"]
        values = np.frombuffer(data, "<f4", accessor["count"] * width, offset).reshape(-1, width)
        assert values.nbytes == view["byteLength"] and accessor["componentType"] == 5126
        if "min" in accessor:
            np.testing.assert_array_equal(values.min(axis=0), np.float32(accessor["min"]))
            np.testing.assert_array_equal(values.max(axis=0), np.float32(accessor["max"]))
        return values

    return content, column


def test_gltf_has_activated_gaussians(scene: TrainedScene, shots: list[Shot], tmp_path: Path) -> None:
    files = write(scene, ["3dgs-ply", "gltf-splats"], tmp_path, shots, {"degree": 2})
    table, (content, column) = read_ply(files["3dgs-ply"][0]), columns_of(files["gltf-splats"][0])
    raw, prefix = table.to_numpy(), "KHR_gaussian_splatting"
    primitive = content["meshes"][0]["primitives"][0]
    assert primitive["mode"] == 0 and content["extensionsUsed"] == [prefix]
    extension = primitive["extensions"][prefix]
    assert (extension["kernel"], extension["colorSpace"]) == ("ellipse", "srgb_rec709_display")
    np.testing.assert_allclose(column("POSITION"), raw["position"], rtol=1e-6)
    np.testing.assert_allclose(column(f"{prefix}:SCALE"), np.exp(raw["scale"]), rtol=1e-5)
    np.testing.assert_allclose(column(f"{prefix}:OPACITY")[:, 0], table.opacity().numpy(), atol=1e-6)
    rotation = column(f"{prefix}:ROTATION")
    np.testing.assert_allclose(np.linalg.norm(rotation, axis=1), 1, atol=1e-6)
    q = table.rotation()
    np.testing.assert_allclose(rotation, np.stack([q.x, q.y, q.z, q.w], axis=1), atol=1e-6)
    # SH coefficients by degree and order give the colour of the table in any direction.
    basis = [float(f[0]) for f in sh_basis(mi.Vector3f(0.48, -0.6, 0.64), 2)]
    names = [f"{prefix}:SH_DEGREE_{k}_COEF_{n}" for k in range(3) for n in range(2 * k + 1)]
    colour = sum(column(name) * y for name, y in zip(names, basis, strict=True))
    coefficients = raw["radiance_sh"].reshape(COUNT, 9, 3)
    np.testing.assert_allclose(colour, np.einsum("nkc,k->nc", coefficients, basis), atol=1e-5)
    assert len(primitive["attributes"]) == 5 + 9
    shown = column("COLOR_0")
    assert shown.min() >= 0 and shown.max() <= 1 and shown.shape[1] == 4
    x, y, z, w = content["nodes"][0]["rotation"]  # +z of the data is +y of glTF
    turned = [2 * (x * z + w * y), 2 * (y * z - w * x), w * w + z * z - x * x - y * y]
    np.testing.assert_allclose(turned, [0, 1, 0], atol=1e-7)


def test_exr_has_every_layer(scene: TrainedScene, shots: list[Shot], tmp_path: Path) -> None:
    (file,) = write(scene, ["exr"], tmp_path / "view.exr", shots, {"view": 1, "samples": 1})["exr"]
    layers, frame = read_exr(file), scene.renderer()(shots[1].camera)
    expected = dict(zip("RGB", frame.radiance, strict=True)) | {"A": frame.alpha, "depth.Z": frame.depth}
    expected |= {f"albedo.{c}": plane for c, plane in zip("RGB", frame.maps["albedo"], strict=True)}
    for name, plane in expected.items():
        np.testing.assert_allclose(layers[name], image_array(plane, SIZE, SIZE), atol=1e-6)
    for letter in "RGB":
        terms = sum(layers[f"{name}.{letter}"] for name in ("diffuse", "specular", "indirect"))
        np.testing.assert_allclose(terms, layers[letter], atol=1e-5)
    solid = layers["A"] > 0.99
    normal = np.stack([layers[f"normal.{letter}"] for letter in "XYZ"], axis=-1)
    np.testing.assert_allclose(np.linalg.norm(normal[solid], axis=-1), 1, atol=1e-5)
    np.testing.assert_allclose(layers["roughness.V"][solid], 0.6, atol=1e-3)
    assert {"metallic.V", "visibility.V"} <= {*layers} and solid.mean() > 0.2
