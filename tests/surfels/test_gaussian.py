"""3D Gaussians by EWA: what `tests/splat` does not compare with surfels."""

import numpy as np

from mi_refgs.constants import ALPHA_MAX, GAUSSIAN_LOW_PASS
from mi_refgs.fitting.events import densify
from mi_refgs.reference.camera import rotation_axes
from mi_refgs.reference.footprint import Gaussian, Rules
from mi_refgs.surfels.table import Surfels
from tests.scenes.splats import discs, make_gaussians


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


def test_the_normal_is_the_shortest_axis() -> None:
    scales = np.log([[1, 2, 3], [2, 1, 3], [3, 2, 1], [1, 1, 1], [1, 1, 2]])
    surfels = Surfels.from_numpy(discs(scale=scales, rotation=np.random.default_rng(0).normal(size=(5, 4))))
    expected = np.stack([np.array(axis).T for axis in surfels.frame()], axis=1)[np.arange(5), [0, 1, 2, 2, 0]]
    normal = np.array(surfels.primitive.normal(surfels)).T
    assert np.abs(np.sum(normal * expected, axis=1)[:4] - 1).max() < 1e-6


def test_a_gaussian_is_split_along_its_longest_axis() -> None:
    raw = discs(position=np.ones((2, 3)), scale=np.log([[0.3, 0.1, 0.05], [0.05, 0.1, 0.3]]))
    edited = densify.densify_and_prune(Surfels.from_numpy(raw), np.ones(2), 4, grow=1.0)
    children = edited.surfels.to_numpy()
    assert edited.parent.tolist() == [0, 1, 0, 1] and edited.fresh.all()
    offsets = children["position"] - 1
    expected = 0.3 * densify.SPLIT_OFFSET * np.array([[1, 0, 0], [0, 0, 1], [-1, 0, 0], [0, 0, -1]])
    np.testing.assert_allclose(offsets, expected, atol=1e-6)
    shrunk = np.exp(children["scale"] - raw["scale"][[0, 1, 0, 1]])
    np.testing.assert_allclose(shrunk, np.where(expected, densify.SPLIT_SCALE, 1), rtol=1e-5)
