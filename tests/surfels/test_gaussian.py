"""3D Gaussians by EWA: what `tests/splat` does not compare with surfels."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mi_refgs.constants import ALPHA_MAX, ALPHA_MIN, GAUSSIAN_LOW_PASS
from mi_refgs.fitting.events import densify
from mi_refgs.methods import Window
from mi_refgs.reference import image
from mi_refgs.reference import splat as oracle
from mi_refgs.reference.camera import rotation_axes
from mi_refgs.reference.footprint import Gaussian, Rules
from mi_refgs.render.pipeline import Request, Shading, SurfelScene, render
from mi_refgs.surfels.init import from_points
from mi_refgs.surfels.ply import read_ply, write_ply
from mi_refgs.surfels.table import Surfels
from tests.scenes.splats import Scene, fast_maps, make_gaussians

IMAGE_TOLERANCE = 1e-5  # observed 2e-6


def test_reference_footprints_match_textbook_matrices() -> None:
    """J W Σ Wᵀ Jᵀ + λ I of one Gaussian after another, where its centre is in view."""
    scene, compared = make_gaussians(8), 0
    camera = scene.camera
    at = np.stack([v.ravel() + 0.5 for v in np.meshgrid(range(camera.width), range(camera.height))], axis=1)
    sample = Gaussian.footprint(scene.raw, camera, Rules(), *at.T)
    position, scale, opacity = (scene.raw[n] for n in ("position", "scale", "opacity"))
    axes = np.stack(rotation_axes(scene.raw["rotation"]), axis=2)
    focal, middle = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    for i in np.flatnonzero(~Gaussian.culled(scene.raw, camera, Rules())):
        p = camera.to_world[:3, :3].T @ (position[i] - camera.to_world[:3, 3])
        centre = focal * p[:2] / p[2] + middle
        if (centre < 0).any() or (centre > [camera.width, camera.height]).any():
            continue
        turned = camera.to_world[:3, :3].T @ axes[i] @ np.diag(np.exp(scale[i]))
        jacobian = np.column_stack([np.diag(focal), -focal * p[:2] / p[2]]) / p[2]
        inverse = np.linalg.inv(jacobian @ turned @ turned.T @ jacobian.T + GAUSSIAN_LOW_PASS * np.eye(2))
        rho = np.einsum("pi,ij,pj->p", at - centre, inverse, at - centre)
        alpha = np.minimum(ALPHA_MAX, np.exp(-0.5 * rho) / (1 + np.exp(-opacity[i])))
        np.testing.assert_allclose(sample.alpha[i], alpha, atol=1e-8)
        compared += 1
    assert compared >= 10


def test_point_covers_the_area_of_the_low_pass() -> None:
    """Far below a pixel only the filter is left: 2π λ pixels, of which the cut takes α_min / o."""
    raw = {
        "position": np.array([[0.0, 0, 1]]),
        "rotation": np.array([[0.0, 0, 0, 1]]),
        "scale": np.full((1, 3), -20.0),
        "opacity": np.full((1, 1), 0.0),
    }
    places, mass = 8, 0.0
    for i in range(places * places):
        x, y = (8 + (k + 0.5) / places for k in divmod(i, places))
        scene = Scene(raw, np.zeros((1, 0)), oracle.PinholeCamera(16, 16, -20, -20, x, y, np.eye(4)))
        mass += fast_maps(scene).alpha.numpy().sum() / places**2
    assert mass == pytest.approx(2 * np.pi * GAUSSIAN_LOW_PASS * (0.5 - ALPHA_MIN), rel=1e-2)


def test_rendered_3dgs_file_matches_the_oracle(tmp_path: Path) -> None:
    """Points to a file to an image of its radiance, against the file's numbers in float64."""
    rng = np.random.default_rng(1)
    made = from_points(
        rng.normal(size=(60, 3)) * 0.4,
        colours=rng.uniform(size=(60, 3)),
        rng=rng,
        primitive="gaussian",
        attributes=["radiance_sh"],
        degree={"radiance_sh": 2},
        opacity=0.7,
    )
    raw = made.to_numpy()
    raw["scale"] += rng.normal(size=(60, 3)).astype(np.float32)
    raw["radiance_sh"][:, 3:] = 0.2 * rng.normal(size=(60, 24))
    write_ply(tmp_path / "3dgs.ply", Surfels.from_numpy(raw))
    surfels, scene = read_ply(tmp_path / "3dgs.ply"), make_gaussians(15)
    camera = scene.camera
    drawn = SurfelScene(surfels, Shading(at="surfel", reflectance="radiance"))
    frame = render(drawn, scene.fast_camera(), Request(("normal",)))
    double = {name: values.astype(np.float64) for name, values in surfels.to_numpy().items()}
    pixels = np.arange(camera.width * camera.height)
    order = oracle.sorted_rows([double], camera, pixels)
    truth = image.render(image.Scene(double, camera, pixels, order, "surfel", "radiance"))
    assert truth.band.mean() < 0.05 and truth.maps["alpha"].max() > 0.9
    found = {"radiance": frame.radiance, "normal": frame.normal, "alpha": [frame.alpha]}
    for name, values in found.items():
        error = np.abs(np.array(values, np.float64).T.reshape(len(pixels), -1) - truth.maps[name])
        assert error[~truth.band].max() <= IMAGE_TOLERANCE, name


def test_the_normal_is_the_shortest_axis() -> None:
    scales = np.log([[1, 2, 3], [2, 1, 3], [3, 2, 1], [1, 1, 1], [1, 1, 2]])
    raw = {"position": np.zeros((5, 3)), "scale": scales, "opacity": np.zeros((5, 1))}
    surfels = Surfels.from_numpy(raw | {"rotation": np.random.default_rng(0).normal(size=(5, 4))})
    axes = np.stack([np.array(axis).T for axis in surfels.frame()], axis=1)
    expected = axes[np.arange(5), [0, 1, 2, 2, 0]]
    normal = np.array(surfels.primitive.normal(surfels)).T
    assert np.abs(np.sum(normal * expected, axis=1)[:4] - 1).max() < 1e-6


def test_a_gaussian_is_split_along_its_longest_axis() -> None:
    raw = {
        "position": np.ones((2, 3)),
        "rotation": np.tile([0.0, 0, 0, 1], (2, 1)),
        "scale": np.log([[0.3, 0.1, 0.05], [0.05, 0.1, 0.3]]),
        "opacity": np.zeros((2, 1)),
    }
    gaussians = Surfels.from_numpy(raw)
    edited = densify.densify_and_prune(
        gaussians, np.ones(2), densify.NO_ROWS, 1.0, densify.Densify(Window(0, 1, 1), grow=1.0), 4
    )
    children = edited.surfels.to_numpy()
    assert edited.parent.tolist() == [0, 1, 0, 1] and edited.fresh.all()
    offsets = children["position"] - 1
    expected = 0.3 * densify.SPLIT_OFFSET * np.array([[1, 0, 0], [0, 0, 1], [-1, 0, 0], [0, 0, -1]])
    np.testing.assert_allclose(offsets, expected, atol=1e-6)
    shrunk = np.exp(children["scale"] - raw["scale"][[0, 1, 0, 1]])
    np.testing.assert_allclose(shrunk, np.where(expected, densify.SPLIT_SCALE, 1), rtol=1e-5)
