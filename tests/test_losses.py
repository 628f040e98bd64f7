"""Losses against their float64 definitions: values, and gradients against central differences of the definitions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from mi_refgs.fit import losses
from mi_refgs.fit.images import srgb_from_linear
from mi_refgs.fit.ssim import ssim
from mi_refgs.reference import losses as reference
from mi_refgs.render.depth_normals import expected_depth, normals_from_depth
from mi_refgs.render.stencil import neighbours
from mi_refgs.splat.camera import Camera

HEIGHT, WIDTH = 14, 17  # not square, and larger than SSIM's window in one axis only by a little
STEP = 1e-5  # of the float64 definitions: truncation 1e-10, rounding 1e-11
VALUE = 2e-6  # float32 sums of 700 numbers of size 1: observed 3e-7
GRADIENT = 2e-5  # relative L2 against float64 differences: observed 1e-6 (SSIM 4e-6)


def planes(image: np.ndarray) -> list[Any]:
    """(H, W, 3) array → three planes."""
    return [mi.Float(np.ascontiguousarray(image[..., c].ravel(), dtype=np.float32)) for c in range(image.shape[2])]


def stack(planes_: list[Any]) -> np.ndarray:
    return np.stack([np.array(dr.grad(p), dtype=np.float64) for p in planes_], axis=-1).reshape(HEIGHT, WIDTH, -1)


def gradient(function: Callable[[np.ndarray], float], at: np.ndarray, entries: np.ndarray | None = None) -> np.ndarray:
    """Central differences of a float64 function, for all entries or those of a mask."""
    slope = np.zeros(at.shape)
    for index in np.argwhere(np.ones(at.shape, bool) if entries is None else entries):
        index = tuple(index)
        shifted = at.copy()
        shifted[index] = at[index] + STEP
        above = function(shifted)
        shifted[index] = at[index] - STEP
        slope[index] = (above - function(shifted)) / (2 * STEP)
    return slope


def check(
    loss: Callable[[list[Any]], Any], define: Callable[[np.ndarray], float], image: np.ndarray, share: float = 1.0
) -> None:
    """Value, reverse-mode gradient and one forward-mode directional derivative of a loss of an image.

    share: of the entries that are compared one by one (slow definitions); the image's rim is always among them.
    """
    image = image.astype(np.float32).astype(np.float64)
    leaves = planes(image)
    dr.enable_grad(leaves)
    value = loss(leaves)
    assert abs(float(value[0]) - define(image)) < VALUE
    dr.backward(value)
    entries = np.random.default_rng(2).random(image.shape) < share
    entries[0, :2] = entries[-1, -2:] = True
    found, wanted = stack(leaves), gradient(define, image, entries)
    assert np.linalg.norm(wanted) > 0
    assert np.linalg.norm((found - wanted)[entries]) <= GRADIENT * np.linalg.norm(wanted)

    direction = np.random.default_rng(3).normal(size=image.shape).astype(np.float32)
    leaves = planes(image)
    for leaf, towards in zip(leaves, planes(direction), strict=True):
        dr.enable_grad(leaf)
        dr.set_grad(leaf, towards)
    value = loss(leaves)
    dr.forward_to(value)
    towards = direction.astype(np.float64)
    expected = (define(image + STEP * towards) - define(image - STEP * towards)) / (2 * STEP)
    scale = np.linalg.norm(found) * np.linalg.norm(direction)
    assert abs(float(dr.grad(value)[0]) - expected) <= GRADIENT * scale


@pytest.fixture
def images(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Two correlated images, so that no term of SSIM is negligible."""
    first = rng.random((HEIGHT, WIDTH, 3))
    return first, np.clip(0.6 * first + 0.4 * rng.random((HEIGHT, WIDTH, 3)), 0, 1).astype(np.float32).astype(np.float64)


def test_l1(images: tuple[np.ndarray, np.ndarray]) -> None:
    image, target = images
    check(lambda x: losses.l1(x, planes(target)), lambda x: reference.l1(x, target), image)


def test_l1_at_equality_has_no_slope(images: tuple[np.ndarray, np.ndarray]) -> None:
    leaves = planes(images[0])
    dr.enable_grad(leaves)
    value = losses.l1(leaves, planes(images[0]))
    dr.backward(value)
    assert float(value[0]) == 0 and np.all(stack(leaves) == 0)


def test_l1_of_clipped_highlights(images: tuple[np.ndarray, np.ndarray]) -> None:
    image, target = images
    target = target.copy()
    target[3:9, 4:12] = 1.0
    image = image * 1.6
    clipped = target >= 254.5 / 255
    assert np.any(clipped & (image > 1)) and np.any(clipped & (image < 1))
    check(
        lambda x: losses.l1(x, planes(target), losses.saturated(planes(target))),
        lambda x: reference.l1(x, target, clipped),
        image,
    )


def test_saturated_is_the_last_8_bit_value() -> None:
    (mask,) = losses.saturated([mi.Float(254 / 255, 254.4 / 255, 1.0, 1.7)])
    assert list(np.array(mask)) == [False, False, True, True]


def test_ssim(images: tuple[np.ndarray, np.ndarray]) -> None:
    image, target = images
    # The loop over windows is slow: differences on a part of the image, whose window meets two borders.
    image, target = image[:, :, :1], target[:, :, :1]
    image = image.astype(np.float32).astype(np.float64)
    leaf = planes(image)
    dr.enable_grad(leaf)
    value = ssim(leaf, planes(target), WIDTH, HEIGHT)
    assert abs(float(value[0]) - reference.ssim(image, target)) < VALUE
    dr.backward(value)
    found = stack(leaf)

    def patch(values: np.ndarray) -> float:
        whole = image.copy()
        whole[:3, :4] = values
        return reference.ssim(whole, target)

    wanted = gradient(patch, image[:3, :4])
    assert np.linalg.norm(found[:3, :4] - wanted) <= GRADIENT * np.linalg.norm(wanted)
    middle = image.copy()
    direction = np.random.default_rng(1).normal(size=image.shape)
    slope = (reference.ssim(middle + STEP * direction, target) - reference.ssim(middle - STEP * direction, target)) / (2 * STEP)
    assert abs(np.sum(found * direction) - slope) <= GRADIENT * np.linalg.norm(found) * np.linalg.norm(direction)


def test_ssim_forward_mode_is_the_transpose(images: tuple[np.ndarray, np.ndarray]) -> None:
    image, target = images
    leaves = planes(image)
    dr.enable_grad(leaves)
    value = losses.d_ssim(leaves, planes(target), WIDTH, HEIGHT)
    dr.backward(value)
    found = stack(leaves)
    direction = np.random.default_rng(1).normal(size=image.shape)
    leaves = planes(image)
    for leaf, towards in zip(leaves, planes(direction), strict=True):
        dr.enable_grad(leaf)
        dr.set_grad(leaf, towards)
    value = losses.d_ssim(leaves, planes(target), WIDTH, HEIGHT)
    dr.forward_to(value)
    assert float(dr.grad(value)[0]) == pytest.approx(np.sum(found * direction), rel=1e-4)


def test_ssim_of_equal_images_is_one_and_flat(images: tuple[np.ndarray, np.ndarray]) -> None:
    leaves = planes(images[0])
    dr.enable_grad(leaves)
    value = losses.d_ssim(leaves, planes(images[0]), WIDTH, HEIGHT)
    dr.backward(value)
    assert abs(float(value[0])) < 1e-6 and np.abs(stack(leaves)).max() < 1e-6


@pytest.mark.parametrize("kind", ["l1", "bce"])
def test_alpha_loss(kind: str, rng: np.random.Generator) -> None:
    alpha, target = rng.random((HEIGHT, WIDTH, 1)), (rng.random((HEIGHT, WIDTH, 1)) > 0.5).astype(np.float64)
    check(
        lambda x: losses.alpha_loss(x[0], planes(target)[0], kind),
        lambda x: reference.alpha_loss(x, target, kind),
        0.05 + 0.9 * alpha,
    )


def test_bce_trains_from_exactly_empty_and_exactly_full() -> None:
    alpha, target = mi.Float(0, 1, 0, 1), mi.Float(1, 0, 0, 1)
    dr.enable_grad(alpha)
    dr.backward(losses.alpha_loss(alpha, target, "bce"))
    slope = np.array(dr.grad(alpha))
    assert np.all(np.isfinite(slope)) and slope[0] < -100 and slope[1] > 100


def test_unknown_alpha_loss_is_refused() -> None:
    with pytest.raises(ValueError, match="'l1' or 'bce'"):
        losses.alpha_loss(mi.Float(0.5), mi.Float(1), "dice")


def test_srgb_matches_the_file_reader_and_has_a_slope_at_zero() -> None:
    linear = np.array([-0.1, 0, 1e-30, 0.001, 0.0031308, 0.0032, 0.5, 1, 4, 1000], dtype=np.float32)
    x = mi.Float(linear)
    dr.enable_grad(x)
    y = losses.linear_to_srgb(x)
    dr.backward(y)
    np.testing.assert_allclose(np.array(y), srgb_from_linear(linear), rtol=2e-6, atol=1e-9)
    assert np.array(dr.grad(x))[1] == pytest.approx(12.92)
    assert np.all(np.isfinite(np.array(dr.grad(x)))) and np.all(np.diff(np.array(y)) > 0)


def test_display_image(rng: np.random.Generator) -> None:
    alpha = 0.05 + 0.9 * rng.random((HEIGHT, WIDTH, 1))
    radiance = 2 * alpha * rng.random((HEIGHT, WIDTH, 3)) ** 2
    both = np.concatenate([radiance, alpha], axis=-1)
    weights = rng.normal(size=(HEIGHT, WIDTH, 3)) / 100
    background = (1.0, 0.5, 0.0)

    def loss(x: list[Any]) -> Any:
        image = losses.display_image(x[:3], x[3], background)
        return dr.sum(sum((a * b for a, b in zip(image, planes(weights), strict=True)), mi.Float(0)))

    rounded = weights.astype(np.float32)
    check(loss, lambda x: float(np.sum(rounded * reference.display_image(x[..., :3], x[..., 3], background))), both)


def test_display_image_shows_the_background_of_empty_pixels() -> None:
    radiance, alpha = mi.Float(0, 0, 1e-9), mi.Float(0, 1e-7, 1e-8)
    dr.enable_grad(radiance, alpha)
    (image,) = losses.display_image([radiance], alpha, (0.25,))
    dr.backward(image)
    np.testing.assert_allclose(np.array(image), 0.25, atol=1e-6)
    assert np.all(np.array(dr.grad(radiance)) == 0)
    np.testing.assert_allclose(np.array(dr.grad(alpha)), -0.25)


def test_normal_smoothness(images: tuple[np.ndarray, np.ndarray], rng: np.random.Generator) -> None:
    guide, _ = images
    check(
        lambda x: losses.normal_smoothness(x, planes(guide), WIDTH, HEIGHT),
        lambda x: reference.normal_smoothness(x, guide),
        rng.normal(size=(HEIGHT, WIDTH, 3)),
        share=0.04,
    )


def test_smoothness_weight_masks_pixels(images: tuple[np.ndarray, np.ndarray]) -> None:
    normal, guide = images
    nothing = dr.zeros(mi.Float, WIDTH * HEIGHT)
    assert float(losses.normal_smoothness(planes(normal), planes(guide), WIDTH, HEIGHT, nothing)[0]) == 0


@pytest.mark.parametrize("size", [(1, 1), (1, 5), (4, 1), (3, 4)])
def test_neighbours_adjoint_is_the_transpose(size: tuple[int, int], rng: np.random.Generator) -> None:
    width, height = size
    steps = [(x, y) for y in (-1, 0, 1) for x in (-1, 0, 1)]
    matrix = np.zeros((len(steps), width * height, width * height))
    for source in range(width * height):
        unit = np.zeros(width * height, dtype=np.float32)
        unit[source] = 1
        matrix[:, :, source] = [np.array(out) for out in neighbours(mi.Float(unit), width, height, steps)]
    weights = rng.normal(size=(len(steps), width * height))
    plane = mi.Float(rng.normal(size=width * height).astype(np.float32))
    dr.enable_grad(plane)
    out = neighbours(plane, width, height, steps)
    dr.backward(sum((o * mi.Float(w.astype(np.float32)) for o, w in zip(out, weights, strict=True)), mi.Float(0)))
    np.testing.assert_allclose(np.array(dr.grad(plane)), np.einsum("ki,kij->j", weights, matrix), atol=1e-5)


# ---------------- depth normals ----------------

INTRINSICS = (-21.0, -19.0, 7.3, 8.1)  # Mitsuba's signs, off-centre
ROTATION = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))[0]
ROTATION = ROTATION * np.sign(np.linalg.det(ROTATION))


def camera() -> Camera:
    to_world = np.eye(4)
    to_world[:3, :3], to_world[:3, 3] = ROTATION, (1.0, 2.0, 3.0)
    return Camera.look(WIDTH, HEIGHT, *INTRINSICS, to_world)


def test_depth_normals_of_a_plane_are_exact() -> None:
    """A plane n · X = 1 has depth 1 / (n · ray) at the pixel centres, and its normal comes back at every pixel."""
    fx, fy, cx, cy = INTRINSICS
    plane = np.array([0.1, -0.2, 0.4])
    column, row = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = np.stack([(column - cx) / fx, (row - cy) / fy, np.ones_like(row)], axis=-1)
    depth = 1 / (rays @ plane)
    normal, valid = normals_from_depth(
        mi.Float(depth.ravel().astype(np.float32)), dr.ones(mi.Float, WIDTH * HEIGHT), camera()
    )
    mask = np.array(valid).reshape(HEIGHT, WIDTH)
    assert mask[1:-1, 1:-1].all() and mask.sum() == (WIDTH - 2) * (HEIGHT - 2)
    found = np.stack([np.array(c) for c in normal], axis=-1).reshape(HEIGHT, WIDTH, 3)
    wanted = -ROTATION @ plane / np.linalg.norm(plane)
    np.testing.assert_allclose(found[mask], np.broadcast_to(wanted, (mask.sum(), 3)), atol=2e-5)
    assert np.all(found[~mask] == 0)


def test_normal_consistency_through_the_depth(rng: np.random.Generator) -> None:
    """Value and gradients to N, D and A of the whole chain; two holes in the alpha switch their neighbourhoods off."""
    alpha = 0.4 + 0.6 * rng.random((HEIGHT, WIDTH, 1))
    alpha[5, 5], alpha[9, 3:6] = 0, 0
    depth = alpha * (3 + 0.3 * rng.random((HEIGHT, WIDTH, 1)))
    packed = np.concatenate([rng.normal(size=(HEIGHT, WIDTH, 3)), depth, alpha], axis=-1)
    weight = alpha[..., 0].astype(np.float32).astype(np.float64)

    def loss(x: list[Any]) -> Any:
        z = expected_depth(x[3], x[4])
        depth_normal, valid = normals_from_depth(z, x[4], camera())
        return losses.normal_consistency(mi.Vector3f(*x[:3]), depth_normal, valid, x[4])

    def define(x: np.ndarray) -> float:
        seen = x[..., 4] >= 1 / 255
        z = np.where(seen, x[..., 3] / np.where(seen, x[..., 4], 1), 0)
        depth_normal, valid = reference.normals_from_depth(z, x[..., 4], *INTRINSICS, ROTATION)
        return reference.normal_consistency(x[..., :3], depth_normal, valid, weight)

    at = packed.astype(np.float32).astype(np.float64)
    leaves = planes(at)
    dr.enable_grad(leaves)
    value = loss(leaves)
    assert abs(float(value[0]) - define(at)) < VALUE
    dr.backward(value)
    found = stack(leaves)
    direction = rng.normal(size=at.shape) * (at != 0)
    for channels in (slice(0, 3), slice(3, 4), slice(4, 5)):
        part = np.zeros(at.shape)
        part[..., channels] = direction[..., channels]
        slope = (define(at + STEP * part) - define(at - STEP * part)) / (2 * STEP)
        scale = np.linalg.norm(found[..., channels]) * np.linalg.norm(part)
        assert scale > 0 and abs(np.sum(found * part) - slope) <= 1e-4 * scale
    wanted = gradient(lambda z: define(np.concatenate([at[..., :3], z, at[..., 4:]], axis=-1)), at[..., 3:4] + 0.0)
    assert np.linalg.norm(found[..., 3:4] - wanted) <= 2e-4 * np.linalg.norm(wanted)


def test_aligned_and_empty_pixels_cost_nothing() -> None:
    empty = dr.zeros(mi.Float, 4)
    normal = mi.Vector3f(0, 0, mi.Float(0.5, 1.0, 0, 0))
    alpha = mi.Float(0.5, 1.0, 0, 0)
    value = losses.normal_consistency(normal, mi.Vector3f(0, 0, 1) + empty, mi.Bool(True, True, True, False), alpha)
    assert float(value[0]) == 0


def test_empty_image_gives_finite_gradients() -> None:
    """Nothing seen anywhere: every loss stays finite, forwards and backwards."""
    size = WIDTH * HEIGHT
    leaves = [dr.zeros(mi.Float, size) for _ in range(5)]
    dr.enable_grad(leaves)
    z = expected_depth(leaves[3], leaves[4])
    depth_normal, valid = normals_from_depth(z, leaves[4], camera())
    image = losses.display_image(leaves[:3], leaves[4], (1.0, 1.0, 1.0))
    target = [dr.ones(mi.Float, size)] * 3
    total = (
        losses.l1(image, target)
        + losses.d_ssim(image, target, WIDTH, HEIGHT)
        + losses.normal_consistency(mi.Vector3f(*leaves[:3]), depth_normal, valid, leaves[4])
        + losses.normal_smoothness(leaves[:3], target, WIDTH, HEIGHT)
        + losses.alpha_loss(leaves[4], dr.zeros(mi.Float, size), "bce")
    )
    dr.backward(total)
    assert np.isfinite(float(total[0])) and np.all(np.isfinite(stack(leaves)))


def test_second_call_compiles_nothing(images: tuple[np.ndarray, np.ndarray]) -> None:
    image, target = images

    def once(scale: float) -> int:
        leaves = planes(image * scale)
        dr.enable_grad(leaves)
        goal = planes(target)
        dr.eval(leaves, goal)
        misses = sum(dr.detail.launch_stats()[1:])
        value = 0.8 * losses.l1(leaves, goal) + 0.2 * losses.d_ssim(leaves, goal, WIDTH, HEIGHT)
        dr.backward(value)
        dr.eval(value, [dr.grad(leaf) for leaf in leaves])
        dr.sync_thread()
        return sum(dr.detail.launch_stats()[1:]) - misses

    once(1.0)
    once(0.9)
    assert once(0.8) == 0
