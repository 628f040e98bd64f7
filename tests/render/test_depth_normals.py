"""Neighbours, depth normals and the losses on them, against their float64 definitions."""

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_refgs.constants import COVERAGE_FLOOR
from mi_refgs.fitting import losses
from mi_refgs.kernels.device import upload
from mi_refgs.reference import losses as reference
from mi_refgs.render import display
from mi_refgs.render.depth_normals import normals_from_depth
from mi_refgs.render.stencil import ChosenPixels, neighbours
from mi_refgs.splat.camera import Camera
from tests.fitting.image_checks import HEIGHT, WIDTH, check, stack
from tests.helpers import with_grad


@pytest.mark.parametrize("size", [(1, 1), (1, 5), (4, 1), (3, 4)])
def test_neighbours_adjoint_is_the_transpose(size: tuple[int, int], rng: np.random.Generator) -> None:
    width, height = size
    steps = [(x, y) for y in (-1, 0, 1) for x in (-1, 0, 1)]
    matrix = np.zeros((len(steps), width * height, width * height))
    for source in range(width * height):
        unit = np.zeros(width * height, dtype=np.float32)
        unit[source] = 1
        matrix[:, :, source] = [np.array(out) for out in neighbours(mi.Float(unit), width, height, steps)]
    every, some = np.arange(width * height), np.flatnonzero(rng.random(width * height) < 0.7)[::-1]
    for own in (every, some) if len(some) else (every,):  # of an image, and of some pixels of it alone
        among = None if own is every else ChosenPixels(upload(own, mi.UInt32), width * height)
        weights, part = rng.normal(size=(len(steps), len(own))), matrix[:, own][:, :, own]
        plane = with_grad(mi.Float(rng.normal(size=len(own)).astype(np.float32)))
        out = neighbours(plane, width, height, steps, among)
        np.testing.assert_allclose(np.array(out), part @ np.array(plane), atol=1e-6)
        losses_of = (o * mi.Float(w.astype(np.float32)) for o, w in zip(out, weights, strict=True))
        dr.backward(sum(losses_of, mi.Float(0)))
        np.testing.assert_allclose(np.array(dr.grad(plane)), np.einsum("ki,kij->j", weights, part), atol=1e-5)


INTRINSICS = (-21.0, -19.0, 7.3, 8.1)  # Mitsuba's signs, off-centre
ROTATION = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))[0]
ROTATION = ROTATION * np.sign(np.linalg.det(ROTATION))


def expected_depth(blended: Any, alpha: Any) -> Any:
    """z = D / A as the renderer forms it: 0 where the pixel is empty, with a finite gradient."""
    seen = alpha > COVERAGE_FLOOR
    return dr.select(seen, blended / dr.select(seen, alpha, 1.0), 0.0)


def camera() -> Camera:
    to_world = np.eye(4)
    to_world[:3, :3], to_world[:3, 3] = ROTATION, (1.0, 2.0, 3.0)
    return Camera.from_pose(WIDTH, HEIGHT, *INTRINSICS, to_world)


def found_normals(depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normals (H, W, 3) of an opaque image of these depths, and where they are valid (H, W)."""
    normal, valid = normals_from_depth(upload(depth), dr.ones(mi.Float, WIDTH * HEIGHT), camera())
    return np.array(normal).T.reshape(HEIGHT, WIDTH, 3), np.array(valid).reshape(HEIGHT, WIDTH)


def test_depth_normals_of_a_plane_are_exact() -> None:
    """A plane n · X = 1 has depth 1 / (n · ray) at the pixel centres, and its normal comes back."""
    fx, fy, cx, cy = INTRINSICS
    plane = np.array([0.1, -0.2, 0.4])
    column, row = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = np.stack([(column - cx) / fx, (row - cy) / fy, np.ones_like(row)], axis=-1)
    found, mask = found_normals(1 / (rays @ plane))
    assert mask[1:-1, 1:-1].all() and mask.sum() == (WIDTH - 2) * (HEIGHT - 2)
    wanted = -ROTATION @ plane / np.linalg.norm(plane)
    np.testing.assert_allclose(found[mask], np.broadcast_to(wanted, (mask.sum(), 3)), atol=2e-5)
    assert np.all(found[~mask] == 0)


def test_steps_between_surfaces_have_no_normal(rng: np.random.Generator) -> None:
    """Steps of every size on a wavy surface: the float64 reference has the same normals, and gaps."""
    step = np.linspace(0, 4, WIDTH) * (np.arange(HEIGHT) > 6)[:, None]
    depth = 3 + 0.1 * rng.random((HEIGHT, WIDTH)) + step
    depth = depth.astype(np.float32).astype(np.float64)
    expected, wanted = reference.normals_from_depth(depth, np.ones((HEIGHT, WIDTH)), *INTRINSICS, ROTATION)
    found, valid = found_normals(depth)
    np.testing.assert_array_equal(valid, wanted)
    np.testing.assert_allclose(found, expected, atol=2e-5)
    edge = wanted[6:8, 1:-1]
    assert edge[:, :2].all() and not edge[:, -5:].any()  # small steps are slopes, large ones are not


@pytest.mark.parametrize("has_background", [False, True])
def test_normal_consistency_through_the_depth(rng: np.random.Generator, has_background: bool) -> None:
    """Value and gradients to N, D, A, and the object's share, of the whole chain; alpha has holes."""
    alpha = 0.4 + 0.6 * rng.random((HEIGHT, WIDTH, 1))
    alpha[5, 5], alpha[9, 3:6] = 0, 0
    depth = alpha * (3 + 0.3 * rng.random((HEIGHT, WIDTH, 1)))
    normal, own = rng.normal(size=(HEIGHT, WIDTH, 3)), alpha * rng.random((HEIGHT, WIDTH, 1))
    packed = np.concatenate([normal, depth, alpha, own], axis=-1)
    weight = alpha[..., 0].astype(np.float32).astype(np.float64)

    def loss(x: list[Any]) -> Any:
        depth_normal, valid = normals_from_depth(expected_depth(x[3], x[4]), x[4], camera())
        share = x[5] if has_background else None
        return losses.normal_consistency(mi.Vector3f(*x[:3]), depth_normal, valid, x[4], share)

    def define(x: np.ndarray) -> float:
        seen = x[..., 4] >= 1 / 255
        z = np.where(seen, x[..., 3] / np.where(seen, x[..., 4], 1), 0)
        depth_normal, valid = reference.normals_from_depth(z, x[..., 4], *INTRINSICS, ROTATION)
        share = x[..., 5] if has_background else None
        return reference.normal_consistency(x[..., :3], depth_normal, valid, weight, share)

    check(loss, define, packed, share=0.2, tolerance=1e-4)


def test_aligned_and_empty_pixels_keep_their_roughness() -> None:
    alpha, valid = mi.Float(0.5, 1.0, 0, 0), mi.Bool(True, True, True, False)
    up = mi.Vector3f(0, 0, 1) + dr.zeros(mi.Float, 4)
    assert float(losses.normal_consistency(alpha * up, up, valid, alpha)[0]) == 0


def test_empty_image_gives_finite_gradients() -> None:
    """Nothing seen anywhere: every loss stays finite, forwards and backwards."""
    size = WIDTH * HEIGHT
    leaves = with_grad([dr.zeros(mi.Float, size) for _ in range(5)])
    depth_normal, valid = normals_from_depth(expected_depth(leaves[3], leaves[4]), leaves[4], camera())
    image = display.display_image(leaves[:3], leaves[4], (1.0, 1.0, 1.0))
    target = [dr.ones(mi.Float, size)] * 3
    total = (
        losses.l1(image, target)
        + losses.d_ssim(image, target, WIDTH, HEIGHT)
        + losses.normal_consistency(mi.Vector3f(*leaves[:3]), depth_normal, valid, leaves[4])
        + losses.smoothness(leaves[:3], target, WIDTH, HEIGHT)
        + losses.alpha_loss(leaves[4], dr.zeros(mi.Float, size))
    )
    dr.backward(total)
    assert np.isfinite(float(total[0])) and np.all(np.isfinite(stack(leaves)))
