"""Errors of the fitted materials on the foreground, and on its concave pixels. Light and albedo share an
unknown scale per channel: albedo is compared after one least-squares scale for all pixels of all views, the
light after its own (`metrics.environment`); both are reported."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from mi_refgs.data.view import View
from mi_refgs.errors import InputError
from mi_refgs.evaluation import metrics
from mi_refgs.evaluation.images import Maps, RenderedView
from mi_refgs.evaluation.surface import NO_SURFACE
from mi_refgs.io.images import psnr_of
from mi_refgs.runs.relightable import relightable
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.splat import Camera

KNOWN_SHARE = 0.5  # fraction of a pixel that a true material must cover for it to count
CONCAVE = "_concave"  # suffix of the numbers of concave pixels
MATERIALS = {"albedo": "albedo_psnr", "roughness": "roughness_mae", "metallic": "metallic_mae"}  # their keys


@dataclass
class _Sums:
    """Sums over pixels from which every error follows, whatever the scale."""

    count: int = 0
    sums: np.ndarray = field(default_factory=lambda: np.zeros((4, 1)))
    """(4, C): Σ ours², Σ ours · true, Σ true², Σ |ours - true|."""

    def add(self, ours: np.ndarray, true: np.ndarray) -> None:
        a, b = ours.astype(np.float64), true.astype(np.float64)
        self.count += len(a)
        self.sums = self.sums + np.stack([a**2, a * b, b**2, np.abs(a - b)]).sum(axis=1)

    def scale(self) -> np.ndarray:
        """Return the least-squares scale of ours (C,); 1 without a pixel."""
        return np.asarray(self.sums[1] / np.maximum(self.sums[0], 1e-30)) if self.count else np.ones(3)

    def psnr(self, scale: np.ndarray) -> float | None:
        """Return the PSNR in dB after a scale, of linear values with a peak of 1; None without a pixel."""
        squared = scale**2 * self.sums[0] - 2 * scale * self.sums[1] + self.sums[2]
        return psnr_of(float(np.mean(squared)) / self.count) if self.count else None

    def mae(self) -> float | None:
        """Return the mean absolute error; None without a pixel."""
        return float(np.mean(self.sums[3])) / self.count if self.count else None


@dataclass
class Decomposition:
    """Accumulates the errors of materials, and of concave pixels, over views."""

    sums: dict[str, _Sums] = field(default_factory=dict)
    ours: set[str] = field(default_factory=set)  # maps that the run has
    foreground: int = 0
    concave: int | None = None  # pixels; None if that is unknown in every view
    angles: list[np.ndarray] = field(default_factory=list)  # degrees, of concave pixels
    squares: list[np.ndarray] = field(default_factory=list)  # squared differences of displayed colours there

    def add(self, rendered: RenderedView, view: View, concave: np.ndarray | None) -> None:
        """Add the pixels of a loaded view; `concave` (H, W) bool is None without a true surface."""
        maps = rendered.maps
        front = view.covered() > metrics.FOREGROUND_ALPHA
        self.foreground += int(front.sum())
        regions = {"": front}
        if concave is not None:
            regions[CONCAVE] = inside = front & concave
            self.concave = (self.concave or 0) + int(inside.sum())
            ours, true = (np.clip(image, 0, 1)[inside] for image in (rendered.image, view.displayed))
            self.squares.append(np.square(ours - true))
            if view.normal is not None:
                angle = metrics.angle_deg(rendered.normal, view.normal)
                self.angles.append(angle[inside & np.any(view.normal != 0, axis=-1)])
        self.ours |= maps.keys()
        for name, true in view.materials.items():
            for suffix, region in regions.items() if name in maps else ():
                known = region & (true[..., -1] > KNOWN_SHARE)
                ours = maps[name].reshape(*known.shape, -1)
                self.sums.setdefault(name + suffix, _Sums()).add(ours[known], true[known][:, :-1])

    def scale(self) -> np.ndarray:
        """Return the scale (3,) of albedo; 1 where there is none to compare."""
        return self.sums.get("albedo", _Sums()).scale()

    def result(self) -> dict[str, Any]:
        """Return the numbers of metrics.json by key; None, with a reason, where nothing was compared."""
        found: dict[str, Any] = {}
        for suffix in ("", CONCAVE):
            albedo, roughness, metallic = (self.sums.get(name + suffix, _Sums()) for name in MATERIALS)
            values = (albedo.psnr(self.scale()), roughness.mae(), metallic.mae())
            found |= {key + suffix: value for key, value in zip(MATERIALS.values(), values, strict=True)}
        found["albedo_scale"] = None if found["albedo_psnr"] is None else [float(x) for x in self.scale()]
        found["concave_share"] = None if self.concave is None else self.concave / max(self.foreground, 1)
        found[f"normal_mae_deg{CONCAVE}"], error = _mean(self.angles), _mean(self.squares)
        found[f"psnr{CONCAVE}"] = None if error is None else psnr_of(error)
        for name, key in MATERIALS.items():
            reason = f"the data set defines no {name}" if name in self.ours else f"the run has no {name}"
            found[f"{name}_reason"] = reason if found[key] is None else None
        found["concave_reason"] = NO_SURFACE if self.concave is None else None
        return found


def _mean(parts: list[np.ndarray]) -> float | None:
    values = np.concatenate([np.empty(0, np.float32), *(part.ravel() for part in parts)])
    return float(np.mean(values, dtype=np.float64)) if len(values) else None


def material_maps(fitted: TrainedScene, samples: int = 1) -> Callable[[Camera, RenderedView], Maps]:
    """Return a function from a camera and its render to maps of materials, (H, W) or (H, W, 3) by name. Where
    the diffuse part was fitted as a colour, albedo is rendered from the materials that `relightable` makes of
    it, with `samples` per pixel: the fitted attribute is only the colour of metals."""
    if "radiance_sh" not in fitted.shading.required_attributes:
        convert = fitted.shading.model.textures  # of MATERIALS; None if it does not convert them
        return lambda camera, rendered: (
            {n: m for n, m in rendered.maps.items() if n not in MATERIALS} | (convert(rendered.maps) or {})
        )
    try:
        scene = relightable(fitted)
    except InputError:  # without light or materials there is no albedo
        return lambda camera, rendered: {n: m for n, m in rendered.maps.items() if n != "albedo"}
    render = replace(scene, shading=scene.shading.untraced()).renderer(samples=samples)
    return lambda camera, rendered: RenderedView.maps_of(render(camera), *rendered.alpha.shape)
