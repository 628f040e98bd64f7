"""What a step lowers: zero for the perfect image, and the sum that the method's weights say."""

from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from mi_refgs import methods
from mi_refgs.data.dataset import Dataset
from mi_refgs.errors import InputError
from mi_refgs.fitting import losses
from mi_refgs.fitting.objective import LossInputs, objective
from mi_refgs.fitting.targets import Target
from mi_refgs.kernels.device import upload
from mi_refgs.methods.method import LossWeight
from mi_refgs.reference import losses as reference
from mi_refgs.render.depth_normals import normals_from_depth
from mi_refgs.render.pipeline import Frame
from mi_refgs.shade.light.envmap import EnvironmentLight
from tests.fitting.image_checks import BACKGROUND, HEIGHT, WIDTH, picture, planes, shown, view_of


def made(linear: bool, radiance: np.ndarray, alpha: np.ndarray) -> tuple[Dataset, Target]:
    """A data set of one image of premultiplied linear radiance (H, W, 3), and its target."""
    view = view_of(shown(radiance, alpha, linear), alpha, linear)
    return Dataset(Path("a"), "train", (view,), BACKGROUND, linear, None), Target.of(view, BACKGROUND)


def frame_of(radiance: np.ndarray, alpha: np.ndarray) -> Frame:
    flat = np.full(alpha.shape, 2.0, np.float32)
    normal = mi.Vector3f(0, 0, upload(-alpha.astype(np.float32)))
    opacity, colour = upload(alpha.astype(np.float32)), mi.Color3f(*planes(radiance.astype(np.float32)))
    return Frame(opacity, upload(flat), normal, colour, object_alpha=opacity)


@pytest.mark.parametrize("linear", [False, True])
def test_perfect_image_costs_nothing(linear: bool, rng: np.random.Generator) -> None:
    """8-bit images are composited as displayed, linear ones before they are encoded; either once."""
    radiance, alpha = picture(rng)
    data, target = made(linear, radiance, alpha)
    weights = {"l1": LossWeight(0.8), "ssim": LossWeight(0.2), "alpha": LossWeight(0.3)}
    loss, error = objective(LossInputs.of(frame_of(radiance, alpha), target, data), weights, 1)
    assert abs(float(loss[0])) < 1e-5 and float(error[0]) < 1e-10


def test_losses_are_weighed_as_method_says(rng: np.random.Generator) -> None:
    true = picture(rng)
    data, target = made(True, *true)
    radiance, alpha = rng.uniform(0, 0.5, (HEIGHT, WIDTH, 3)), rng.uniform(0, 1, (HEIGHT, WIDTH))
    weights = {"l1": LossWeight(0.7), "ssim": LossWeight(0.3), "alpha": LossWeight(0.4)}
    loss, error = objective(LossInputs.of(frame_of(radiance, alpha), target, data), weights, 1)
    pair = (radiance, alpha), true
    shown, goal = (reference.srgb(x + (1 - a[..., None]) * BACKGROUND) for x, a in pair)
    expected = 0.7 * reference.l1(shown, goal) + 0.3 * (1 - reference.ssim(shown, goal))
    expected += 0.4 * reference.l1(alpha, true[1])
    assert float(loss[0]) == pytest.approx(expected, abs=2e-5)
    np.testing.assert_allclose(error.numpy(), np.mean((shown - goal) ** 2, axis=-1).ravel(), atol=1e-6)


def test_priors_are_weighed_as_method_says(rng: np.random.Generator) -> None:
    radiance, alpha = picture(rng)
    data, target = made(True, radiance, alpha)
    maps = {name: rng.uniform(0, 1, alpha.shape) for name in ("metallic", "roughness")}
    uploaded = {"albedo": mi.Color3f(0, 0.5, 1)}
    uploaded |= {name: upload(x.astype(np.float32)) for name, x in maps.items()}
    depth = upload(rng.uniform(2, 2.1, alpha.size).astype(np.float32))
    frame, half = replace(frame_of(radiance, alpha), maps=uploaded, depth=depth), alpha / 2
    frame = replace(frame, object_alpha=frame.alpha / 2)
    light = EnvironmentLight.from_radiance(rng.uniform(0.1, 2, (8, 16, 3))).prefilter()

    def loss(iteration: int = 1, **weights: LossWeight) -> float:
        weights = {"l1": LossWeight(0.8)} | weights
        return float(objective(LossInputs.of(frame, target, data, light), weights, iteration)[0][0])

    rest, expected = loss(), 0.3 * reference.undecided(maps["metallic"], half)
    assert loss(half_metal=LossWeight(0.3)) - rest == pytest.approx(expected, rel=1e-3)
    rising = LossWeight(0.3, start=10, rise=100)
    for iteration, share in ((10, 0), (11, 0.01), (60, 0.5), (500, 1)):
        added = loss(iteration, half_metal=rising) - rest
        assert added == pytest.approx(share * expected, rel=1e-2, abs=1e-6)
    expected = 0.3 * reference.undecided(alpha, np.ones(1))
    assert loss(half_opaque=LossWeight(0.3)) - rest == pytest.approx(expected, rel=1e-3)
    smooth = np.stack([half * maps["roughness"], half * maps["metallic"]], axis=-1)
    guide = np.stack([np.array(plane).reshape(alpha.shape) for plane in target.image], axis=-1)
    expected = 0.2 * reference.smoothness(smooth, guide, 10.0)
    assert loss(materials=LossWeight(0.2)) - rest == pytest.approx(expected, rel=1e-3)
    normals = normals_from_depth(depth, frame.alpha, target.camera)
    mirror = frame.alpha * 0.5 * uploaded["metallic"] * (1 - uploaded["roughness"]) ** 4
    expected = 9 * float(losses.normal_consistency(frame.normal, *normals, mirror, frame.alpha)[0])
    assert loss(mirror_normal=LossWeight(9)) - rest == pytest.approx(expected, rel=1e-3) and expected > 1e-5
    expected = 0.4 * float(losses.light_colour(light)[0])
    assert loss(light_colour=LossWeight(0.4)) - rest == pytest.approx(expected, rel=1e-3) and expected > 0.01


@pytest.mark.parametrize("prior", ["half_metal", "materials", "light_colour", "mirror_normal"])
def test_prior_needs_what_it_is_about(prior: str) -> None:
    weight = [f"loss.{prior}=0.1"]
    with pytest.raises(InputError, match=rf"loss\.{prior}: needs .*, or drop the loss"):
        methods.load("base_2dgs", "quick", weight)
    methods.load("ref_gaussian", "quick", weight)
