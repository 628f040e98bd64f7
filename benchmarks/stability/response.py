"""The camera's response and the losses at their ends: values and slopes against float64."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from benchmarks.stability.cases import Array
from mi_refgs.fitting import losses
from mi_refgs.io.images import SATURATED
from mi_refgs.kernels.device import upload
from mi_refgs.reference import losses as reference
from mi_refgs.render import display

SIZE = (11, 9)  # height and width of the images
NOISE = 1e-4
"""Below this a gradient of the loss is compared absolutely: differences of float64 tell no more, and a
pixel of the plain image has 1e-2."""
JOINT = 0.0031308
CURVE = {
    "0": 0.0,
    "1e-30": 1e-30,
    "1e-8": 1e-8,
    "just below the joint": JOINT * (1 - 1e-5),
    "the joint": JOINT,
    "just above the joint": JOINT * (1 + 1e-5),
    "1": 1.0,
    "1e6": 1e6,
}


def measure() -> dict[str, Any]:
    """Rows of the sRGB curve, and of losses under extreme images."""
    curve = [_curve(name, x) for name, x in CURVE.items()]
    return {"curve": curve, "losses": [_loss(*x) for x in images()]}


def _curve(name: str, at: float) -> dict[str, Any]:
    x = float(np.float32(at))
    plane = mi.Float([x, x])
    dr.enable_grad(plane)
    value = display.srgb_from_linear(plane)
    dr.backward(dr.sum(value))
    straight = np.float32(x) <= np.float32(JOINT)
    exact = 12.92 * x if straight else float(reference.srgb(np.array(x)))
    slope = 12.92 if straight else 1.055 / 2.4 * x ** (1 / 2.4 - 1)
    errors = {"value": _relative(value[0], exact), "slope": _relative(dr.grad(plane)[0], slope)}
    return {"at": name} | errors


def _relative(found: Any, exact: float) -> float:
    found = float(found)
    if not np.isfinite(found):
        return float("inf")
    return abs(found - exact) / abs(exact) if exact else abs(found)


def images() -> list[tuple[str, Array, Array, Array, Array]]:
    """Name, radiance (H, W, 3) premultiplied, alpha (H, W), target (H, W, 3) encoded, target alpha."""
    rng = np.random.default_rng(31)
    h, w = SIZE
    colour, alpha = rng.uniform(0.05, 0.9, (h, w, 3)), rng.uniform(0.3, 1, (h, w))
    target, ones, none = rng.uniform(0.1, 0.9, (h, w, 3)), np.ones((h, w)), np.zeros((h, w))
    speck = colour.copy()
    speck[4, 5] = 1e6
    a = alpha[..., None]
    return [
        ("plain", colour * a, alpha, target, ones),
        ("over-exposed target", 50 * colour * a, alpha, np.ones((h, w, 3)), ones),
        ("over-exposed target, dark render", 0.01 * colour * a, alpha, np.ones((h, w, 3)), ones),
        ("under-exposed target", colour * a, alpha, np.zeros((h, w, 3)), ones),
        ("under-exposed target, black render", 1e-8 * colour * a, alpha, np.zeros((h, w, 3)), ones),
        ("black render", 0 * colour, alpha, target, ones),
        ("one pixel of 1e6", speck * a, alpha, target, ones),
        ("all transparent, as the target", 0 * colour, none, 0.5 * np.ones((h, w, 3)), none),
        ("all transparent, target is not", 0 * colour, none, target, ones),
        ("nearly transparent", 1e-5 * colour, 1e-5 * ones, target, ones),
    ]


def _loss(name: str, radiance: Array, alpha: Array, target: Array, target_alpha: Array) -> dict[str, Any]:
    """0.8 L1 + 0.2 (1 - SSIM) + 0.2 L1 of alpha, over grey, highlights clipped as in a fit."""
    radiance, alpha, target, target_alpha = (
        np.asarray(x, np.float32).astype(np.float64) for x in (radiance, alpha, target, target_alpha)
    )
    planes, a = [upload(radiance[..., i]) for i in range(3)], upload(alpha)
    dr.enable_grad(planes, a)
    goal = [upload(target[..., i]) for i in range(3)]
    image = display.display_image(planes, a, [0.5] * 3)
    image = losses.clip_highlights(image, goal, losses.saturated(goal))
    loss = 0.8 * losses.l1(image, goal) + 0.2 * losses.d_ssim(image, goal, SIZE[1], SIZE[0])
    loss += 0.2 * losses.alpha_loss(a, upload(target_alpha))
    dr.backward(loss)
    found = np.stack([dr.grad(x).numpy() for x in (*planes, a)], 1).reshape(*SIZE, 4)

    def exact(values: Array) -> float:
        image = reference.display_image(values[..., :3], values[..., 3], (0.5, 0.5, 0.5))
        image = np.where((target >= SATURATED) & (image > target), target, image)
        value = 0.8 * reference.l1(image, target) + 0.2 * (1 - reference.ssim(image, target))
        return value + 0.2 * reference.l1(values[..., 3], target_alpha)

    values = np.concatenate([radiance, alpha[..., None]], axis=-1)
    places = [(r, c) for r in (0, 4, 7) for c in (1, 5)]
    slopes = np.array([_slopes(exact, values, place) for place in places])
    ours = np.array([found[place] for place in places])
    scale = float(np.linalg.norm(slopes))
    return {
        "name": name,
        "value": _relative(float(loss[0]), exact(values)),
        "slope": float(np.linalg.norm(ours - slopes)) / max(scale, NOISE),
        "non_finite": int(np.sum(~np.isfinite(found))) + int(not np.isfinite(float(loss[0]))),
    }


def _slopes(exact: Callable[[Array], float], values: Array, place: tuple[int, int]) -> Array:
    """Derivatives (4,) by radiance and alpha of a pixel; at equality the slope of |x| is 0, as central
    differences have it."""

    def difference(i: int) -> float:
        step = 1e-6 * max(abs(values[place][i]), 1e-3) if i < 3 else 1e-7
        moved = np.zeros_like(values)
        moved[place][i] = step
        return (exact(values + moved) - exact(values - moved)) / (2 * step)

    return np.array([difference(i) for i in range(4)])
