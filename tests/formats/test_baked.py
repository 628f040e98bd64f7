"""Meshes with baked textures: a known scene in glTF and plain Mitsuba, read by other libraries."""

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import trimesh

from mi_refgs.formats import Shot, baking, write
from mi_refgs.formats.baking import TexturedMesh, bake, simplified, texels, unwrap
from mi_refgs.formats.mitsuba_scene import DIFFUSE_RATIO, ROUGHNESSES, base_colour
from mi_refgs.formats.orbits import shots_around
from mi_refgs.io.images import linear_from_srgb, read_png
from mi_refgs.occlusion.mesh import Mesh
from mi_refgs.render.display import image_array
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.shade.brdf import split_sum
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.shading import Shading
from mi_refgs.surfels.attributes import logit
from mi_refgs.surfels.table import Surfels
from tests.helpers import refused, run_python
from tests.scenes.integrator import sky
from tests.scenes.known import CENTRES, CLAY, METAL, RADII, known_mesh, known_scene, known_surfels

SHIFT = np.array([0.1, 0.4, -0.2])  # offset of the balls, so that no axis equals another
MIDDLES = CENTRES + SHIFT
TEXTURE = 256
FACES = 2000
SIZE = 96  # pixels of the cameras that are exported
MATERIALS = METAL | {"roughness": 0.1}, CLAY  # the metal is nearly a mirror


@dataclass(frozen=True)
class Exported:
    """The scene and cameras that the formats were written from, and their folder."""

    trained: TrainedScene
    shots: list[Shot]
    folder: Path
    baked: TexturedMesh


def trained_scene() -> TrainedScene:
    raw, mesh = known_surfels().to_numpy(), known_mesh()
    raw["position"] += SHIFT.astype(np.float32)
    rough = np.array([material["roughness"] for material in MATERIALS])
    raw["roughness"] = logit(rough[np.arange(len(raw["position"])) % 2])[:, None].astype(np.float32)
    mesh = replace(mesh, vertices=(mesh.vertices + SHIFT).astype(np.float32), voxel=0.01)
    return replace(
        known_scene(), surfels=Surfels.from_numpy(raw), light=EnvironmentLight.from_radiance(sky()), mesh=mesh
    )


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Exported:
    """The balls in both formats."""
    trained = trained_scene()
    around = shots_around(trained.surfels)
    chosen = around[1], around[3], *around[4::4]
    shots = [replace(shot, camera=shot.camera.resized(SIZE)) for shot in chosen]
    folder = tmp_path_factory.mktemp("baked")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(baking, "VIEW_SIZE", 256)
        write(trained, ["mitsuba", "gltf-mesh"], folder, shots, {"faces": FACES, "texture": TEXTURE})
        return Exported(trained, shots, folder, bake(trained, tuple(shots), FACES, TEXTURE))


def ball_of(points: np.ndarray) -> np.ndarray:
    """Index of the ball that points (N, 3) are on."""
    return np.linalg.norm(points[:, None] - MIDDLES, axis=-1).argmin(axis=1)


def at(image: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Values of an image at coordinates (N, 2), v upwards, of the nearest texel."""
    place = np.minimum((np.stack([1 - uv[:, 1], uv[:, 0]]) * len(image)).astype(int), len(image) - 1)
    return image[*place]


def check_materials(points: np.ndarray, uv: np.ndarray, *maps: np.ndarray) -> None:
    """Require that albedo, roughness and metallic at points of balls are those of the known scene."""
    ball = ball_of(points)
    for name, image in zip(("albedo", "roughness", "metallic"), maps, strict=True):
        found = at(image, uv)
        true = np.array([np.broadcast_to(material[name], found.shape[1:]) for material in MATERIALS])
        assert np.quantile(np.abs(found - true[ball]).reshape(len(ball), -1).max(axis=1), 0.99) < 0.02, name


def test_charts_do_not_overlap(exported: Exported) -> None:
    """Areas of triangles sum to that of the covered texels, so none is counted twice."""
    mesh = simplified(exported.trained.mesh or Mesh.empty(), FACES)
    assert FACES / 2 < len(mesh.faces) <= FACES
    whole = known_mesh()
    cut = Mesh(whole.vertices[whole.faces].reshape(-1, 3), np.arange(whole.faces.size).reshape(-1, 3), 0.01)
    welded, expected = simplified(cut, FACES), simplified(whole, FACES)
    assert len(welded.vertices) == len(expected.vertices) and len(welded.faces) == len(expected.faces)
    small = Mesh(1e-4 * mesh.vertices, mesh.faces, 1e-4 * mesh.voxel)  # the unit does not count
    _, faces, uv = unwrap(small, TEXTURE)
    assert uv.min() >= 0 and uv.max() <= 1
    corner = uv[faces]
    a, b = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    area = 0.5 * np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    covered, triangle, barycentric = texels(faces, uv, TEXTURE)
    assert area.sum() == pytest.approx(covered.mean(), rel=0.02)
    assert covered.mean() > 0.3
    u, v = np.array(barycentric)
    place = np.einsum("ct,tcd->td", [1 - u - v, u, v], corner[triangle.numpy()])
    row, column = np.nonzero(covered)
    wanted = np.stack([(column + 0.5) / TEXTURE, 1 - (row + 0.5) / TEXTURE], axis=1)
    np.testing.assert_allclose(place, wanted, atol=1e-5)


def test_textures_have_the_known_materials(exported: Exported) -> None:
    made = exported.baked
    check_materials(made.vertices, made.uv, made.albedo, made.roughness, made.metallic)
    for image in (made.albedo, made.roughness, made.metallic):
        assert np.isfinite(image).all() and image.min() >= 0 and image.max() <= 1


def test_texels_beside_charts_have_materials(exported: Exported) -> None:
    """Lookups beside a chart return the nearest texel of one, not a background."""
    albedo = exported.baked.albedo.reshape(-1, 3)
    distance = np.min([np.abs(albedo - material["albedo"]).max(axis=1) for material in MATERIALS], axis=0)
    assert np.quantile(distance, 0.99) < 0.03


def test_vertices_and_normals_match_the_balls(exported: Exported) -> None:
    made = exported.baked
    ball = ball_of(made.vertices)
    outward = made.vertices - MIDDLES[ball]
    radius = np.linalg.norm(outward, axis=1)
    np.testing.assert_allclose(radius, RADII[ball], atol=0.02)
    angle = np.degrees(np.arccos(np.clip((made.normals * outward).sum(axis=1) / radius, -1, 1)))
    assert np.quantile(angle, 0.95) < 3
    crossed = trimesh.Trimesh(made.vertices, made.faces, process=False).face_normals
    assert ((crossed * made.normals[made.faces[:, 0]]).sum(axis=1) > 0.8).all()


def test_mesh_below_the_surface_moves_outwards(exported: Exported, monkeypatch: pytest.MonkeyPatch) -> None:
    """A mesh of the balls that is 1.5 voxels too small grows to their outlines."""
    trained = exported.trained
    assert trained.mesh is not None
    ball = ball_of(trained.mesh.vertices)
    inward = (trained.mesh.vertices - MIDDLES[ball]) * (0.015 / RADII[ball])[:, None]
    small = replace(trained.mesh, vertices=(trained.mesh.vertices - inward).astype(np.float32))
    monkeypatch.setattr(baking, "VIEW_SIZE", 256)
    vertices = bake(replace(trained, mesh=small), tuple(exported.shots), FACES, 64).vertices
    radius = np.linalg.norm(vertices - MIDDLES[ball_of(vertices)], axis=1)
    assert np.abs(np.median(radius / RADII[ball_of(vertices)]) - 1) < 0.012


def test_gltf_mesh_has_y_up_and_known_materials(exported: Exported) -> None:
    scene: Any = trimesh.load(exported.folder / "gltf-mesh.glb", process=False)
    mesh = scene.geometry["object"]
    ours = mesh.vertices[:, [0, 2, 1]] * [1, -1, 1]
    np.testing.assert_allclose(ours, exported.baked.vertices, atol=1e-6)
    normals = mesh.vertex_normals[:, [0, 2, 1]] * [1, -1, 1]
    np.testing.assert_allclose(normals, exported.baked.normals, atol=1e-5)
    material = mesh.visual.material
    albedo = linear_from_srgb(np.asarray(material.baseColorTexture, np.float32)[..., :3] / 255)
    surface = np.asarray(material.metallicRoughnessTexture, np.float32) / 255
    _, roughness, metallic = np.moveaxis(surface, -1, 0)
    check_materials(ours, np.asarray(mesh.visual.uv), albedo, roughness, metallic)
    assert material.metallicFactor == 1 and material.roughnessFactor == 1


STOCK = """
import sys
import mitsuba as mi
mi.set_variant(sys.argv[3])
import numpy as np
scene = mi.load_file(sys.argv[1] + "/scene.xml", spp=int(sys.argv[4]))
np.save(sys.argv[2], np.stack([np.array(mi.render(scene, sensor=i)) for i in range(len(scene.sensors()))]))
assert "mi_refgs" not in sys.modules
"""


@pytest.mark.parametrize(("variant", "spp"), [("llvm_ad_rgb", 64), ("scalar_rgb", 16)])
def test_plain_mitsuba_renders_the_image(exported: Exported, tmp_path: Path, variant: str, spp: int) -> None:
    """A mirror under a light without symmetries, and clay, rendered without this package."""
    run_python(STOCK, exported.folder / "mitsuba", tmp_path / "p.npy", variant, spp, folder=tmp_path)
    theirs = np.load(tmp_path / "p.npy")
    view = exported.trained.renderer(samples=4)
    for shot, picture in zip(exported.shots[:2], theirs, strict=True):
        frame = view(shot.camera)
        ours = image_array([*frame.radiance, frame.alpha], SIZE, SIZE)
        np.testing.assert_allclose(picture[..., 3].mean(), ours[..., 3].mean(), rtol=0.02)
        inside = (ours[..., 3] > 0.99) & (picture[..., 3] > 0.99)
        mirror = inside & (image_array(frame.maps["metallic"], SIZE, SIZE) > 0.9)
        assert mirror.sum() > 500
        error, size = np.abs(ours - picture)[..., :3], ours[..., :3]
        assert error[inside].mean() < 0.35 * size[inside].mean()
        for turned in (ours[:, ::-1], ours[::-1]):
            assert np.abs(turned - picture)[mirror][:, :3].mean() > 3 * error[mirror].mean()


def test_plain_mitsuba_reads_texture_encodings(exported: Exported) -> None:
    folder, uv = exported.folder / "mitsuba", exported.baked.uv
    base = base_colour(exported.baked)
    np.testing.assert_allclose(linear_from_srgb(read_png(folder / "albedo.png")), base, atol=0.01)
    bsdf = mi.load_file(str(folder / "scene.xml")).shapes()[0].bsdf()
    textures = {name for name in mi.traverse(bsdf).keys() if name.endswith(".data")}
    assert textures == {"base_color.data", "roughness.data", "metallic.data"}
    si = dr.zeros(mi.SurfaceInteraction3f, len(uv))
    si.uv, si.wi = mi.Point2f(uv[:, 0], 1 - uv[:, 1]), mi.Vector3f(0, 0, 1)  # coordinates of the PLY
    shown = np.array(bsdf.eval_diffuse_reflectance(si)).T
    assert np.quantile(np.abs(shown - at(base, uv)), 0.98) < 0.02
    text = (folder / "scene.xml").read_text()
    assert text.count('name="raw" value="true"') == 2 and text.count('name="raw" value="false"') == 1


@pytest.mark.parametrize("roughness", [0.2, 0.9])
def test_principled_albedo_equals_ours(roughness: float) -> None:
    """Mean albedo over all view directions: sampled weights against the split-sum table."""
    rgb = {"type": "rgb", "value": [float(0.6 * np.interp(roughness, ROUGHNESSES, DIFFUSE_RATIO))] * 3}
    bsdf = mi.load_dict({"type": "principled", "base_color": rgb, "roughness": roughness, "specular": 0.5})
    count = 1 << 18
    random = mi.PCG32(count)
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    cosine = dr.sqrt(random.next_float32())
    si.wi = mi.Vector3f(dr.sqrt(1 - cosine * cosine), 0, cosine)
    points = mi.Point2f(random.next_float32(), random.next_float32())
    _, weight = bsdf.sample(mi.BSDFContext(), si, random.next_float32(), points)
    scale, bias = split_sum(cosine, mi.Float(roughness))
    ours = dr.mean(0.6 + 0.4 * (0.04 * scale + bias))
    assert float(dr.mean(weight.x)[0]) == pytest.approx(float(ours[0]), rel=0.01)


def test_missing_package(exported: Exported, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "xatlas", None)
    again = replace(exported.trained, iteration=2)  # another scene, whose mesh is not cached
    message = 'xatlas is not installed; pip install "mi_refgs[export]"'
    refused(lambda: write(again, ["gltf-mesh"], tmp_path / "a.glb", exported.shots), message)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"light": None}, "light: the run has none; fit one with materials and a light, as"),
        ({"mesh": None}, "mesh: the run has none; fit one with occlusion, as `--for relighting` does, or"),
        ({"mesh": Mesh.empty()}, "mesh: the run has none that textures could be baked to"),
        ({"surfels": None}, "albedo, metallic: the run has none; fit one with materials"),
    ],
)
def test_incomplete_runs(exported: Exported, tmp_path: Path, change: dict[str, Any], message: str) -> None:
    if "surfels" in change:
        raw = exported.trained.surfels.raw.items()
        change = {"surfels": Surfels({k: v for k, v in raw if k not in ("albedo", "metallic")})}
    scene = replace(exported.trained, shading=Shading(diffuse="irradiance", occlusion=False), **change)
    found = refused(lambda: write(scene, ["mitsuba"], tmp_path, exported.shots))
    assert found.startswith(f"{tmp_path}: {message}")
