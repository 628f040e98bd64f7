"""Losses against their float64 definitions: values, and gradients against central differences."""

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_refgs.fitting import losses
from mi_refgs.io.images import srgb_from_linear
from mi_refgs.reference import losses as reference
from mi_refgs.render import display
from mi_refgs.shade.light.envmap import EnvironmentLight
from tests.fitting.image_checks import HEIGHT, WIDTH, check, planes, stack
from tests.helpers import level_maps, with_grad

Images = tuple[np.ndarray, np.ndarray]
Loss = Callable[..., Any]


@pytest.fixture
def images(rng: np.random.Generator) -> Images:
    """Two correlated images, so that no term of SSIM is negligible."""
    first = rng.random((HEIGHT, WIDTH, 3))
    second = np.clip(0.6 * first + 0.4 * rng.random((HEIGHT, WIDTH, 3)), 0, 1)
    return first, second.astype(np.float32).astype(np.float64)


def d_ssim(image: list[Any], target: list[Any]) -> Any:
    return losses.d_ssim(image, target, WIDTH, HEIGHT)


@pytest.mark.parametrize(
    ("loss", "define", "share"),
    [
        (losses.l1, reference.l1, 1.0),
        (d_ssim, lambda x, target: 1 - reference.ssim(x, target), 0.008),  # its loop over windows is slow
    ],
)
def test_image_losses(loss: Loss, define: Loss, share: float, images: Images) -> None:
    image, target = images
    check(lambda x: loss(x, planes(target)), lambda x: define(x, target), image, share)


@pytest.mark.parametrize(("loss", "most"), [(losses.l1, 0.0), (d_ssim, 1e-6)])
def test_equal_images_cost_nothing(loss: Loss, most: float, images: Images) -> None:
    leaves = with_grad(planes(images[0]))
    value = loss(leaves, planes(images[0]))
    dr.backward(value)
    assert abs(float(value[0])) <= most and np.abs(stack(leaves)).max() <= most


def test_l1_of_clipped_highlights(images: Images) -> None:
    image, target = images
    target = target.copy()
    target[3:9, 4:12] = 1.0
    image, goal = image * 1.6, planes(target)
    clipped = target >= 254.5 / 255
    assert np.any(clipped & (image > 1)) and np.any(clipped & (image < 1))

    def loss(x: list[Any]) -> Any:
        return losses.l1(losses.clip_highlights(x, goal, losses.saturated(goal)), goal)

    check(loss, lambda x: reference.l1(x, target, clipped), image)


def test_only_objects_own_colour_is_highlight() -> None:
    """Composites of 8-bit colours: white behind empty pixels and edges is none, a white edge on black is."""
    alpha = np.array([0, 1 / 255, 0.2, 0.5, 1, 0, 1 / 255, 0.2, 0.5, 1], np.float32)
    own = np.array([0.3, 254 / 255, 0.3, 254 / 255, 254 / 255, 1, 1, 1, 1, 1], np.float32)
    for background in (0.0, 1.0):
        image = own * alpha + (1 - alpha) * np.float32(background)
        (mask,) = losses.saturated([mi.Float(image)], mi.Float(alpha), [background])
        assert np.array(mask).tolist() == [False] * 6 + [True] * 4


def test_srgb_matches_file_reader_and_has_slope_at_zero() -> None:
    linear = np.array([-0.1, 0, 1e-30, 0.001, 0.0031308, 0.0032, 0.5, 1, 4, 1000], dtype=np.float32)
    x = with_grad(mi.Float(linear))
    y = display.srgb_from_linear(x)
    dr.backward(y)
    np.testing.assert_allclose(np.array(y), srgb_from_linear(linear), rtol=2e-6, atol=1e-9)
    assert np.array(dr.grad(x))[1] == pytest.approx(12.92)
    assert np.all(np.isfinite(np.array(dr.grad(x)))) and np.all(np.diff(np.array(y)) > 0)


def test_display_image(rng: np.random.Generator) -> None:
    alpha = 0.05 + 0.9 * rng.random((HEIGHT, WIDTH, 1))
    both = np.concatenate([2 * alpha * rng.random((HEIGHT, WIDTH, 3)) ** 2, alpha], axis=-1)
    weights = (rng.normal(size=(HEIGHT, WIDTH, 3)) / 100).astype(np.float32)
    background = (1.0, 0.5, 0.0)

    def loss(x: list[Any]) -> Any:
        image = display.display_image(x[:3], x[3], background)
        return dr.sum(sum((a * b for a, b in zip(image, planes(weights), strict=True)), mi.Float(0)))

    def define(x: np.ndarray) -> float:
        return float(np.sum(weights * reference.display_image(x[..., :3], x[..., 3], background)))

    check(loss, define, both)


def test_display_image_shows_background_of_empty_pixels() -> None:
    radiance, alpha = with_grad((mi.Float(0, 0, 1e-9), mi.Float(0, 1e-7, 1e-8)))
    (image,) = display.display_image([radiance], alpha, (0.25,))
    dr.backward(image)
    np.testing.assert_allclose(np.array(image), 0.25, atol=1e-6)
    assert np.all(np.array(dr.grad(radiance)) == 0)
    np.testing.assert_allclose(np.array(dr.grad(alpha)), -0.25)


@pytest.mark.parametrize(("count", "edge"), [(3, 1.0), (2, 10.0)])
def test_smoothness(count: int, edge: float, images: Images, rng: np.random.Generator) -> None:
    guide, _ = images
    check(
        lambda x: losses.smoothness(x, planes(guide), WIDTH, HEIGHT, edge),
        lambda x: reference.smoothness(x, guide, edge),
        rng.normal(size=(HEIGHT, WIDTH, count)),
        share=0.04,
    )


def test_undecided(rng: np.random.Generator) -> None:
    """Alpha says what counts and gets no gradient; 0 and 1 cost nothing."""
    alpha = rng.random((HEIGHT, WIDTH, 1)).astype(np.float32)
    check(
        lambda x: losses.undecided(x[0], planes(alpha)[0]),
        lambda x: reference.undecided(x, alpha),
        0.1 + 0.8 * rng.random((HEIGHT, WIDTH, 1)),
    )
    weight = with_grad(mi.Float(1, 1, 0.5))
    assert float(losses.undecided(mi.Float(0, 1, 0), weight)[0]) == 0
    assert not dr.grad_enabled(losses.undecided(mi.Float(0.5, 0.5, 0.5), weight))


def test_colour_of_light(rng: np.random.Generator) -> None:
    """Against the definition, by the light's texels; a grey light, however uneven, costs nothing."""
    texels = rng.uniform(0.1, 2, (8, 16, 3))

    def loss(light: EnvironmentLight) -> Any:
        return losses.light_colour(light.prefilter())

    def define(values: np.ndarray, scale: float) -> float:
        level = level_maps(EnvironmentLight.from_radiance(values).prefilter())[-1]
        return reference.light_colour(level, scale)

    light = EnvironmentLight.from_radiance(texels)
    scale = reference.irradiances(level_maps(light.prefilter())[-1]).mean()
    dr.enable_grad(light.raw)
    value = loss(light)
    assert float(value[0]) == pytest.approx(define(texels, scale), rel=1e-4) and float(value[0]) > 0.01
    dr.backward(value)
    slope = dr.grad(light.raw).numpy() / -np.expm1(-texels)  # softplus' slope, in terms of softplus
    step = rng.normal(size=texels.shape)
    difference = (define(texels + 0.01 * step, scale) - define(texels - 0.01 * step, scale)) / 0.02
    assert np.sum(slope * step) == pytest.approx(difference, rel=2e-2)
    assert float(loss(EnvironmentLight.from_radiance(np.repeat(texels[..., :1], 3, axis=-1)))[0]) < 1e-6


def test_difference_of_lights(rng: np.random.Generator) -> None:
    """Against the definition, by the radiance; a light brighter than what is clipped costs nothing."""
    photographed = rng.uniform(0, 1.5, (40, 3)).astype(np.float32)
    radiance = (photographed + rng.choice([-0.2, 0.3], (40, 3)) * rng.random((40, 3))).clip(0.01)
    seen, area = rng.choice([0, 0.4, 1], 40).astype(np.float32), rng.random(40).astype(np.float32)

    def define(values: np.ndarray) -> float:
        return reference.light_difference(values, photographed, seen, area, losses.CLIPPED, losses.HUE)

    light = with_grad(mi.Color3f(radiance.T.astype(np.float32)))
    value = losses.light_difference(light, mi.Color3f(photographed.T), mi.Float(seen), mi.Float(area))
    assert float(value[0]) == pytest.approx(define(radiance), rel=1e-5)
    dr.backward(value)
    slope, step = dr.grad(light).numpy().T, 1e-4 * rng.normal(size=radiance.shape)
    difference = define(radiance + step) - define(radiance - step)
    assert np.sum(slope * step) == pytest.approx(difference / 2, rel=1e-2)
    free = (photographed > losses.CLIPPED) & (radiance > photographed) & (seen == 1)[:, None]
    assert free.any() and not slope[free].any()
    brighter = photographed * np.float32(1.5) + np.float32(0.5)  # same log ratio in all channels
    unseen = mi.Color3f(brighter.T), mi.Color3f(photographed.T), mi.Float(np.zeros(40)), mi.Float(area)
    assert float(losses.light_difference(*unseen)[0]) < 1e-6
