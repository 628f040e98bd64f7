"""Error of the method, not of its implementation: what each rule of sorting and cutting does to an image.

Everything here is float64: the same scene with one rule replaced by what it stands for."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks.common.scenes import discs, facing
from benchmarks.stability.cases import Array, Case, Raw, camera, filled, plain, sky
from benchmarks.stability.exact import light_of, scene_of
from mi_refgs.reference import image as reference
from mi_refgs.reference.camera import camera_frame
from mi_refgs.reference.splat import sorted_rows

WIDTH, HEIGHT = 48, 40
SAMPLES = 4  # along each axis of a pixel, for the mean that the low-pass stands for
NEARLY_ONE = 1 - 1e-9
OPACITIES = (0.9, 0.3, 0.1, 0.05)


def scenes() -> Iterator[Case]:
    """Scenes whose surfels hide each other in different ways."""
    eye = camera(width=WIDTH, height=HEIGHT)
    flat: dict[str, Any] = {"camera": eye, "at": "surfel", "reflectance": "radiance"}
    rng = np.random.default_rng(21)
    ball = discs(400)
    ball["scale"] = np.log(rng.uniform(0.06, 0.16, (400, 2)))
    yield plain("sphere of surfels", raw=ball, **flat)
    mirror = discs(600)
    normal = mirror["position"]
    mirror |= {
        "position": normal * (1 + 0.004 * rng.normal(size=(600, 1))),
        "rotation": facing(normal) + 0.02 * rng.normal(size=(600, 4)),
        "scale": np.log(rng.uniform(0.05, 0.12, (600, 2))),
        "opacity": rng.uniform(0, 7, (600, 1)),
    }
    mirror |= filled(600, metallic=4, roughness=-2)
    yield plain("curved near-mirror", raw=mirror, camera=eye, light=sky(32))
    yield plain("planes through each other", raw=_planes(rng), **flat)
    mist = discs(300)
    mist |= {
        "position": rng.uniform(-1, 1, (300, 3)),
        "rotation": rng.normal(size=(300, 4)),
        "scale": np.log(rng.uniform(0.1, 0.4, (300, 2))),
        "opacity": rng.uniform(-3, -1, (300, 1)),
    }
    yield plain("mist of faint surfels", raw=mist, **flat)


def _planes(rng: np.random.Generator) -> Raw:
    """Two crossing sheets of opaque discs, each of one colour."""
    raw = discs(240)
    normals = np.array([[0.6, 0, 0.8], [0.8, 0, -0.6]])[np.arange(240) % 2]
    flat = rng.uniform(-1, 1, (240, 3))
    raw["position"] = flat - np.sum(flat * normals, 1, keepdims=True) * normals
    raw["rotation"] = facing(normals)
    sides = np.where(np.arange(240) % 2, 1.2, -1.2)[:, None]
    raw["radiance_sh"] = np.where(np.arange(27) < 3, 1.0, 0) * sides
    return raw | filled(240, scale=np.log(0.15), opacity=8)


def measure() -> dict[str, Any]:
    """Rows of every scene and rule, and the bias of the gradient that the cut at α_min has."""
    rows = [row for case in scenes() for row in _rules(case.rounded())]
    return {"rules": rows, "gradient": [_cut(opacity) for opacity in OPACITIES]}


def _rules(case: Case) -> Iterator[dict[str, Any]]:
    light = light_of(case.light) if case.reflectance == "split_sum" else None
    pixels, raw = np.arange(WIDTH * HEIGHT), {n: np.asarray(x, np.float64) for n, x in case.raw.items()}
    base = scene_of(case, pixels, sorted_rows([raw], case.camera, pixels), light)
    pixel_sorted = replace(base, order=_by_pixel(base))
    depth = camera_frame(base.raw, base.camera)[0][:, 2]
    by_centre = np.broadcast_to(np.argsort(depth, kind="stable")[:, None], base.order.shape)
    exact, fine = _radiance(pixel_sorted), _supersampled(case, light)

    def ruled(**rules: Any) -> Array:
        return _radiance(replace(pixel_sorted, rules=replace(base.rules, **rules)))

    for name, ours, truth in (
        ("sorted by tile → by pixel", _radiance(base), exact),
        ("sorted by centre → by pixel", _radiance(replace(base, order=by_centre)), exact),
        ("ALPHA_MIN 1/255 → 0", exact, ruled(alpha_min=0.0)),
        ("ALPHA_MAX 0.99 → 1", exact, ruled(alpha_max=NEARLY_ONE)),
        ("TRANSMITTANCE_MIN 1e-4 → 0", exact, ruled(transmittance_min=0.0)),
        ("EDGE_ON_COSINE 1e-4 → 0", exact, ruled(edge_on=0.0)),
        ("low-pass → mean of the pixel", exact, fine),
        ("no low-pass → mean of the pixel", ruled(low_pass=None), fine),
    ):
        scale = float(np.mean(np.abs(truth)))
        errors = {"bias": np.mean(ours - truth) / scale, "mean": np.mean(np.abs(ours - truth)) / scale}
        yield {"scene": case.name, "rule": name} | {key: float(x) for key, x in errors.items()}


def _radiance(scene: reference.Scene) -> Array:
    return reference.render(scene).maps["radiance"]


def _by_pixel(scene: reference.Scene) -> Array:
    """Order (N, P) by the depth of each pixel's own sample."""
    return np.argsort(reference.sample_depth(scene), axis=0, kind="stable")


def _supersampled(case: Case, light: reference.Light | None) -> Array:
    """Mean radiance over SAMPLES² rays per pixel, without the low-pass."""
    c = case.camera
    fine = replace(
        c, width=SAMPLES * c.width, height=SAMPLES * c.height, fx=SAMPLES * c.fx, fy=SAMPLES * c.fy,
        cx=SAMPLES * c.cx, cy=SAMPLES * c.cy,
    )  # fmt: skip
    found = []
    for row in range(c.height):  # a row of pixels at a time: memory
        pixels = np.arange(SAMPLES * fine.width) + row * SAMPLES * fine.width
        scene = scene_of(replace(case, camera=fine), pixels, np.empty((0, 0), int), light)
        scene = replace(scene, rules=reference.Rules(low_pass=None))
        image = _radiance(replace(scene, order=_by_pixel(scene)))
        found.append(image.reshape(SAMPLES, c.width, SAMPLES, -1).mean((0, 2)))
    return np.concatenate(found)


def _cut(opacity: float) -> dict[str, float]:
    """Relative error of d Σα / d log scale, and of d Σα / d logit, of one surfel: the cut's own derivative
    is missing. Against differences of the sum over a fine grid."""
    c = camera((0, 0, 4.0), width=200, height=200, fov=30)
    raw = {n: x[:1].astype(np.float64) for n, x in discs().items()} | {"position": np.zeros((1, 3))}
    raw |= {"rotation": np.array([[0.1, 0.05, 0, 1.0]]), "scale": np.full((1, 2), np.log(0.25))}
    raw["opacity"] = np.array([[np.log(opacity / (1 - opacity))]])
    pixels = np.arange(c.width * c.height)
    order = np.zeros((1, len(pixels)), int)
    scene = reference.Scene(raw, c, pixels, order, "surfel", "radiance")
    weights = {"alpha": np.ones((len(pixels), 1))}
    gradients = reference.render(scene, weights).gradients

    def total(name: str, step: float) -> float:
        other = replace(scene, raw=raw | {name: raw[name] + step})
        return float(reference.render(other).maps["alpha"].sum())

    row = {"opacity": opacity}
    for name in ("scale", "opacity"):
        slope = (total(name, 0.02) - total(name, -0.02)) / 0.04
        row[f"{name}_bias"] = float(gradients[name].sum()) / slope - 1
    return row
