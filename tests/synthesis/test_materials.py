"""Ground truth of materials and surface: what BSDFs declare comes out of the data set as it is meant."""

from functools import partial
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_refgs.occlusion.mesh import read_mesh
from mi_refgs.synthesis.ground_truth import materials_at
from mi_refgs.synthesis.make_dataset import make_dataset
from tests.helpers import read_loaded, refused

BASE = (0.2, 0.5, 0.8)
RGB: dict[str, Any] = {"type": "rgb", "value": list(BASE)}
DIFFUSE = {"type": "diffuse", "reflectance": RGB}
GLASS = {"type": "dielectric"}
ROUGH: dict[str, Any] = {"type": "roughconductor", "material": "none"}
PRINCIPLED = {"type": "principled", "base_color": RGB, "roughness": 0.3, "metallic": 0.7}
HALF = {"type": "checkerboard", "color0": 0.25, "color1": 0.25}
Expected = tuple[Any, Any, Any]
UNKNOWN: Expected = (None, None, None)
CASES: list[tuple[dict[str, Any], Expected]] = [
    (DIFFUSE, (BASE, None, 0)),
    (PRINCIPLED, (BASE, 0.3, 0.7)),
    ({"type": "principled", "base_color": RGB}, (BASE, 0.5, 0)),
    (PRINCIPLED | {"roughness": HALF}, (BASE, 0.25, 0.7)),
    (PRINCIPLED | {"spec_trans": 0.5}, UNKNOWN),
    ({"type": "refgs_bsdf", "albedo": RGB, "roughness": 0.3, "metallic": 0.7}, (BASE, 0.3, 0.7)),
    (ROUGH | {"alpha_u": 0.04, "alpha_v": 0.16}, ((1, 1, 1), 0.2**0.5 * 0.4**0.5, 1)),
    ({"type": "conductor", "material": "none", "specular_reflectance": RGB}, (BASE, 0, 1)),
    (ROUGH | {"alpha": 0.09}, ((1, 1, 1), 0.3, 1)),
    ({"type": "plastic", "diffuse_reflectance": RGB}, (BASE, 0, 0)),
    ({"type": "roughplastic", "diffuse_reflectance": RGB, "alpha": 0.09}, (BASE, 0.3, 0)),
    ({"type": "twosided", "inner": PRINCIPLED}, (BASE, 0.3, 0.7)),
    ({"type": "mask", "opacity": 0.9, "inner": PRINCIPLED}, (BASE, 0.3, 0.7)),
    ({"type": "bumpmap", "texture": HALF, "inner": PRINCIPLED}, (BASE, 0.3, 0.7)),
    ({"type": "blendbsdf", "weight": 0.0, "a": PRINCIPLED, "b": GLASS}, (BASE, 0.3, 0.7)),
    ({"type": "blendbsdf", "weight": 1.0, "a": GLASS, "b": DIFFUSE}, (BASE, None, 0)),
    ({"type": "blendbsdf", "weight": 0.5, "a": PRINCIPLED, "b": PRINCIPLED}, UNKNOWN),
    (GLASS, UNKNOWN),
    ({"type": "principledthin", "base_color": RGB}, UNKNOWN),
]


def seen_from(direction: tuple[float, float, float], *shapes: dict[str, Any]) -> Any:
    """Materials where a ray from far away, along a direction to the origin, first meets one of the shapes."""
    scene = mi.load_dict({"type": "scene", **{f"shape_{i}": shape for i, shape in enumerate(shapes)}})
    ray = mi.Ray3f(-5 * mi.Point3f(direction), mi.Vector3f(direction))
    found = materials_at(scene, scene.ray_intersect(ray))
    dr.eval(*found)  # while there is a scene to trace
    return found


def check(found: Any, expected: Expected) -> None:
    for name, wanted in zip(("albedo", "roughness", "metallic"), expected, strict=True):
        value, known = getattr(found, name)
        assert dr.all(known) == (wanted is not None), name
        np.testing.assert_allclose(np.array(value).ravel(), 0 if wanted is None else wanted, atol=0.01)


@pytest.mark.parametrize(
    ("bsdf", "expected"), CASES, ids=lambda case: case["type"] if isinstance(case, dict) else ""
)
def test_materials_of_bsdfs(bsdf: dict[str, Any], expected: Expected) -> None:
    other = {"type": "sphere", "center": [0, 0, -9], "bsdf": {"type": "conductor"}}
    check(seen_from((0, 0, -1), {"type": "sphere", "bsdf": bsdf}, other), expected)


@pytest.mark.parametrize("metal", [{"type": "conductor"}, {"type": "roughconductor", "alpha": 0.001}])
def test_albedo_of_metal_is_its_reflectance(metal: dict[str, Any]) -> None:
    """At normal incidence under a constant light, by the samples of Mitsuba's own BSDF."""
    metal = metal | {"material": "Au"}
    reflected = weight_of_samples(metal).mean(axis=1)
    assert reflected[0] > 0.9 > reflected[2] + 0.4
    value, _ = seen_from((0, 0, -1), {"type": "sphere", "bsdf": metal}).albedo
    np.testing.assert_allclose(np.array(value).ravel(), reflected, atol=2e-3)


@pytest.mark.parametrize("nonlinear", [False, True])
@pytest.mark.parametrize("name", ["plastic", "roughplastic"])
def test_albedo_of_plastic_is_that_of_its_base(name: str, nonlinear: bool) -> None:
    """All that leaves at normal incidence is F + (1 - F) albedo, F being Fresnel's; less if rough."""
    plastic = {"type": name, "diffuse_reflectance": RGB, "nonlinear": nonlinear}
    fresnel = ((1.49 - 1.000277) / (1.49 + 1.000277)) ** 2
    reflected = weight_of_samples(plastic).mean(axis=1)
    value, _ = seen_from((0, 0, -1), {"type": "sphere", "bsdf": plastic}).albedo
    np.testing.assert_allclose((reflected - fresnel) / (1 - fresnel), np.array(value).ravel(), atol=0.03)


def weight_of_samples(bsdf: dict[str, Any], count: int = 200_000) -> np.ndarray:
    """Weights (3, N) of samples at normal incidence."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(1, count)
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    si.wi = mi.Vector3f(0, 0, 1)
    si.sh_frame = mi.Frame3f(mi.Vector3f(0, 0, 1))
    _, weight = mi.load_dict(bsdf).sample(mi.BSDFContext(), si, sampler.next_1d(), sampler.next_2d())
    return np.broadcast_to(np.array(weight), (3, count))


def test_two_sided_sheet_has_two_materials() -> None:
    sheet = {"type": "rectangle", "bsdf": {"type": "twosided", "front": DIFFUSE, "back": PRINCIPLED}}
    check(seen_from((0, 0, -1), sheet), (BASE, None, 0))
    check(seen_from((0, 0, 1), sheet), (BASE, 0.3, 0.7))


def test_unusable_texture_is_undefined() -> None:
    """Also where a value would not be finite, and where nothing is hit."""
    broken = mi.Bitmap(np.full((2, 2, 1), np.inf, np.float32))
    rough = PRINCIPLED | {"roughness": {"type": "bitmap", "bitmap": broken, "raw": True}}
    check(seen_from((0, 0, -1), {"type": "sphere", "bsdf": rough}), (BASE, None, 0.7))
    check(seen_from((0, 0, -1), {"type": "sphere", "center": [5, 0, 0], "bsdf": PRINCIPLED}), UNKNOWN)


SCENE = """<scene version="3.0.0">
    <emitter type="constant"/>
    <shape type="sphere">
        <bsdf type="refgs_bsdf">
            <texture type="checkerboard" name="albedo">
                <rgb name="color0" value="0.8, 0.1, 0.2"/>
                <rgb name="color1" value="0.1, 0.3, 0.9"/>
                <transform name="to_uv"><scale x="6" y="3"/></transform>
            </texture>
            <float name="metallic" value="1"/>
            <float name="roughness" value="0.35"/>
        </bsdf>
    </shape>
    <shape type="sphere">
        <point name="center" x="1.2" y="0" z="0.8"/>
        <float name="radius" value="0.5"/>
        <bsdf type="diffuse"><rgb name="reflectance" value="0.7, 0.6, 0.5"/></bsdf>
    </shape>
    <shape type="cylinder"><point name="p0" x="0" y="0" z="-1.5"/><point name="p1" x="0.3" y="0" z="-0.7"/>
        <float name="radius" value="0.4"/><bsdf type="dielectric"/></shape>
</scene>"""


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A chequered metal ball, a clay one, and a glass tube."""
    folder = tmp_path_factory.mktemp("materials")
    (folder / "three.xml").write_text(SCENE)
    options: dict[str, Any] = {"views": 4, "test_views": 1, "size": 32, "spp": 4, "environment_height": 0}
    return make_dataset(folder / "three.xml", folder / "out", **options, progress=False)


def test_material_maps_are_those_of_the_scene(made: Path) -> None:
    """Pixel by pixel, by the position that depth gives; the reader's camera, files and scene agree."""
    seen = []
    for view in read_loaded(made, "train").views:
        assert view.depth is not None
        rays = np.array(view.camera().rays()).T.reshape(32, 32, 3)
        point = view.to_world[:3, 3] + rays * view.depth[..., None]
        hit = view.depth > 0
        metal = hit & (abs(np.linalg.norm(point, axis=-1) - 1) < 1e-3)
        clay = hit & (abs(np.linalg.norm(point - [1.2, 0, 0.8], axis=-1) - 0.5) < 1e-3)
        glass = hit & ~metal & ~clay
        albedo, roughness, metallic = (view.materials[n] for n in ("albedo", "roughness", "metallic"))
        for array, where in ((albedo, metal | clay), (roughness, metal), (metallic, metal | clay)):
            np.testing.assert_array_equal(array[..., -1], where)
            assert not array[~where].any()
        u = np.arctan2(point[..., 1], point[..., 0]) / (2 * np.pi) % 1
        v = np.arccos(np.clip(point[..., 2], -1, 1)) / np.pi
        first = ((u * 6 % 1) > 0.5) == ((v * 3 % 1) > 0.5)
        colour = np.where(first[..., None], (0.8, 0.1, 0.2), (0.1, 0.3, 0.9))
        np.testing.assert_allclose(albedo[metal][:, :3], colour[metal], atol=1e-5)
        np.testing.assert_allclose(albedo[clay][:, :3], np.tile((0.7, 0.6, 0.5), (clay.sum(), 1)), atol=1e-5)
        np.testing.assert_allclose(roughness[metal][:, 0], 0.35, atol=1e-6)
        np.testing.assert_array_equal(metallic[..., 0], metal)
        seen.append([where.sum() for where in (metal, clay, glass)])
    assert np.sum(seen, axis=0).min() > 50


def test_surface_mesh_is_that_of_the_shapes(made: Path) -> None:
    """Every point that a view sees lies on it, and its corners lie on the shapes."""
    mesh = read_mesh(made / "surface.ply")
    surface = {"type": "ply", "filename": str(made / "surface.ply"), "face_normals": True}
    scene = mi.load_dict({"type": "scene", "m": surface})
    for view in read_loaded(made, "train").views:
        assert view.depth is not None and view.normal is not None
        camera = view.camera()
        distance = np.array(scene.ray_intersect(mi.Ray3f(camera.origin, camera.rays())).t).reshape(32, 32)
        grazing = np.abs(np.sum(view.normal * np.array(camera.rays()).T.reshape(32, 32, 3), -1)) < 0.2
        compared = (view.depth > 0) & np.isfinite(distance) & ~grazing
        assert compared.sum() > 0.8 * (view.depth > 0).sum()
        np.testing.assert_allclose(distance[compared], view.depth[compared], atol=3e-3)
    axis, below = np.array([0.3, 0, 0.8]) / np.hypot(0.3, 0.8), mesh.vertices - np.array([0, 0, -1.5])
    tube = abs(np.linalg.norm(below - (below @ axis)[:, None] * axis, axis=1) - 0.4) < 1e-5
    ball = abs(np.linalg.norm(mesh.vertices, axis=1) - 1) < 1e-5
    clay = abs(np.linalg.norm(mesh.vertices - [1.2, 0, 0.8], axis=1) - 0.5) < 1e-5
    assert (tube | ball | clay).all() and tube.any() and ball.any() and clay.any()


def test_unsupported_shape_is_named(tmp_path: Path) -> None:
    """Before anything is written."""
    (tmp_path / "curve.txt").write_text("0 0 0 0.1\n0.3 0 0 0.1\n0.6 0.1 0 0.1\n0.8 0.1 0.2 0.1\n")
    shape = '<shape type="bsplinecurve" id="odd"><string name="filename" value="curve.txt"/></shape>'
    (tmp_path / "odd.xml").write_text(f'<scene version="3.0.0"><emitter type="constant"/>{shape}</scene>')
    make = partial(make_dataset, tmp_path / "odd.xml", tmp_path / "out", views=1, size=8, progress=False)
    refused(make, "odd.xml: shape 'odd': a BSplineCurve", "use a mesh, sphere")
    assert not (tmp_path / "out").exists()
