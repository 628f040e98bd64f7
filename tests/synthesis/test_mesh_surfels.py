"""Surfels on meshes and Mitsuba shapes: no holes, normals, materials of BSDFs and their textures."""

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from scipy import ndimage

import mi_refgs
from mi_refgs.occlusion.mesh import Mesh
from mi_refgs.render.pipeline import render_depth
from mi_refgs.surfels.attributes import sigmoid
from tests.helpers import refused
from tests.scenes.sphere import CENTRE, RADIUS

MESHES = {
    "ball": trimesh.creation.icosphere(4),
    "sheet": trimesh.creation.box((2, 1.2, 0.05)),
    "ring": trimesh.creation.torus(0.8, 0.25),
}


@pytest.mark.parametrize("name", MESHES)
def test_no_pixel_shows_through(name: str, tmp_path: Path) -> None:
    """At alpha 0.95, three pixels inside of the silhouette; and nothing is outside of it."""
    mesh, size = MESHES[name], 96
    mesh.export(tmp_path / "mesh.ply")
    scene = mi.load_dict({"type": "scene", "s": {"type": "ply", "filename": str(tmp_path / "mesh.ply")}})
    whole = Mesh(np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.uint32), 0.1)
    surfels = mi_refgs.surfels_from_mesh(whole, 3000, attributes=["albedo"])
    for eye in ([0, -3.5, 1.5], [0.3, 0.2, 3.5]):
        camera = mi_refgs.Camera.look_at(eye, fov=40, size=size)
        alpha = np.array(render_depth(surfels, camera)[1]).reshape(size, size)
        origin = mi.Point3f(*camera.pose()[:3, 3].tolist())
        seen = np.array(scene.ray_test(mi.Ray3f(origin, camera.rays()))).reshape(size, size)
        assert alpha[ndimage.binary_erosion(seen, iterations=3)].min() > 0.95
        assert alpha[~ndimage.binary_dilation(seen, iterations=3)].max() < 0.5


def test_normals_and_materials_are_those_of_the_shape() -> None:
    """Of a scene, its shapes or one: a texture by its coordinates, numbers, and what options say instead."""
    image = np.zeros((2, 2, 3), np.float32)
    image[:, 0], image[:, 1] = [0.8, 0.2, 0.1], [0.1, 0.3, 0.7]
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(image), "raw": True, "filter_type": "nearest"}
    metal = {"type": "principled", "base_color": texture, "roughness": 0.3, "metallic": 1.0}
    shape = {"type": "sphere", "center": CENTRE.tolist(), "radius": RADIUS, "bsdf": metal}
    scene = mi.load_dict({"type": "scene", "s": shape, "light": {"type": "constant"}})
    for given in (scene, scene.shapes(), scene.shapes()[0]):
        surfels = mi_refgs.surfels_from_mesh(given, 500, opacity=0.9)
        raw = surfels.to_numpy()
        outward = (raw["position"] - CENTRE) / RADIUS
        np.testing.assert_allclose(np.linalg.norm(outward, axis=1), 1, atol=1e-5)
        np.testing.assert_allclose(np.array(surfels.frame()[2]).T, outward, atol=1e-3)
        half = np.arctan2(outward[:, 1], outward[:, 0]) % (2 * np.pi) < np.pi
        expected = np.where(half[:, None], image[0, 0], image[0, 1])
        right = np.abs(sigmoid(raw["albedo"]) - expected).max(axis=1) < 1e-3
        assert right.mean() > 0.98 and np.allclose(sigmoid(raw["roughness"]), 0.3, atol=1e-4)
        assert sigmoid(raw["metallic"]).min() > 0.99 and np.allclose(sigmoid(raw["opacity"]), 0.9, atol=1e-5)
    assert "s.bsdf.roughness.value" in mi.traverse(scene)  # still has its names
    fewer = mi_refgs.surfels_from_mesh(scene, 50, attributes=["albedo"], albedo=0.5)
    assert "metallic" not in fewer.raw and np.allclose(fewer.raw["albedo"].numpy(), 0, atol=0.15)


def test_surfaces_without_area_are_refused() -> None:
    flat = trimesh.Trimesh(np.zeros((3, 3)), [[0, 1, 2]], process=False)
    refused(lambda: mi_refgs.surfels_from_mesh(flat, 10), "10 points on an area of 0")
