"""The recovered materials beside the true ones, on the foreground, and apart where it is concave.

Pictures fix light and albedo only up to a factor a channel: twice the light on half the albedo looks the
same. So albedo is compared after one least-squares scale a channel, the same for all pixels of all views, and
the light after its own (`metrics.environment`); both scales are reported.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from mi_refgs.data.view import View
from mi_refgs.errors import InputError
from mi_refgs.evaluation import metrics
from mi_refgs.evaluation.images import RenderedView, on_white, side_by_side
from mi_refgs.evaluation.surface import NO_SURFACE
from mi_refgs.io.images import psnr_of, srgb_from_linear
from mi_refgs.runs.relightable import relightable
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.shade.shading import Shading
from mi_refgs.splat import Camera

KNOWN_SHARE = 0.5
"""Share of a pixel for which a true material must stand."""
CONCAVE = "_concave"
"""Suffix of the numbers of concave pixels alone."""
NAMES = ("albedo", "roughness", "metallic")
KEYS = ("albedo_psnr", "roughness_mae", "metallic_mae")


@dataclass
class _Sums:
    """Sums over pixels that are enough for every error, whatever the scale."""

    count: int = 0
    own: Any = 0.0  # Σ ours², a channel
    cross: Any = 0.0  # Σ ours · true
    true: Any = 0.0  # Σ true²
    apart: Any = 0.0  # Σ |ours - true|

    def add(self, ours: np.ndarray, true: np.ndarray) -> None:
        """Count pixels (P, C)."""
        ours, true = ours.astype(np.float64), true.astype(np.float64)
        self.count += len(ours)
        self.own = self.own + np.sum(ours**2, axis=0)
        self.cross = self.cross + np.sum(ours * true, axis=0)
        self.true = self.true + np.sum(true**2, axis=0)
        self.apart = self.apart + np.sum(np.abs(ours - true), axis=0)

    def scale(self) -> np.ndarray:
        """What brings ours nearest to the truth, a channel; 1 without a pixel."""
        return np.asarray(self.cross / np.maximum(self.own, 1e-30)) if self.count else np.ones(3)

    def psnr(self, scale: np.ndarray) -> float | None:
        """PSNR in dB after a scale, of linear values with a peak of 1; None without a pixel."""
        if not self.count:
            return None
        squared = scale**2 * self.own - 2 * scale * self.cross + self.true
        return psnr_of(float(np.mean(squared)) / self.count)

    def mae(self) -> float | None:
        """Mean absolute error; None without a pixel."""
        return float(np.mean(self.apart)) / self.count if self.count else None


@dataclass
class Decomposition:
    """Adds up the errors of materials, and of concave pixels, view by view."""

    sums: dict[str, _Sums] = field(default_factory=dict)
    ours: set[str] = field(default_factory=set)  # maps that the run has
    foreground: int = 0
    concave: int | None = None  # pixels; None where no view tells which
    angles: list[np.ndarray] = field(default_factory=list)  # degrees, of concave pixels
    squares: list[np.ndarray] = field(default_factory=list)  # of differences of displayed pictures there

    def add(
        self, shot: RenderedView, maps: dict[str, np.ndarray], view: View, concave: np.ndarray | None
    ) -> None:
        """Count a view: its picture and normals, our maps by material, and which pixels are concave."""
        front = view.covered() > metrics.FOREGROUND_ALPHA
        self.foreground += int(front.sum())
        places = {"": front}
        if concave is not None:
            places[CONCAVE] = inside = front & concave
            self.concave = (self.concave or 0) + int(inside.sum())
            self.squares.append(np.square(np.clip(shot.image, 0, 1) - np.clip(view.displayed, 0, 1))[inside])
            if view.normal is not None:
                angle = metrics.angle_deg(shot.normal, view.normal)
                self.angles.append(angle[inside & np.any(view.normal != 0, axis=-1)])
        self.ours |= {*maps}
        for name, true in view.materials.items():
            for suffix, place in places.items() if name in maps else ():
                known = place & (true[..., -1] > KNOWN_SHARE)
                ours = maps[name].reshape(*known.shape, -1)
                self.sums.setdefault(name + suffix, _Sums()).add(ours[known], true[known][:, :-1])

    def scale(self) -> np.ndarray:
        """The scale (3,) of albedo; 1 where there is none to compare."""
        return self.sums.get("albedo", _Sums()).scale()

    def result(self) -> dict[str, Any]:
        """Numbers of metrics.json by key; None where nothing was compared, and why."""
        found: dict[str, Any] = {}
        for suffix in ("", CONCAVE):
            albedo, roughness, metallic = (self.sums.get(name + suffix, _Sums()) for name in NAMES)
            values = (albedo.psnr(self.scale()), roughness.mae(), metallic.mae())
            found |= {key + suffix: value for key, value in zip(KEYS, values, strict=True)}
        found["albedo_scale"] = None if found["albedo_psnr"] is None else [float(x) for x in self.scale()]
        found["concave_share"] = None if self.concave is None else self.concave / max(self.foreground, 1)
        found[f"normal_mae_deg{CONCAVE}"] = _mean(self.angles)
        error = _mean(self.squares)
        found[f"psnr{CONCAVE}"] = None if error is None else psnr_of(error)
        for name, key in zip(NAMES, KEYS, strict=True):
            why = f"the data set defines no {name}" if name in self.ours else f"the run has no {name}"
            found[f"{name}_reason"] = why if found[key] is None else None
        found["concave_reason"] = NO_SURFACE if self.concave is None else None
        return found


def _mean(parts: list[np.ndarray]) -> float | None:
    values = np.concatenate([part.ravel() for part in parts]) if parts else np.empty(0)
    return float(np.mean(values, dtype=np.float64)) if len(values) else None


def material_maps(
    fitted: TrainedScene, samples: int = 1
) -> Callable[[Camera, RenderedView], dict[str, np.ndarray]]:
    """A function from a view's camera and render to its maps of materials, (H, W) or (H, W, 3) by name.

    `samples` a pixel as that render has.

    Where the diffuse part was fitted as a colour, the albedo is that which `relightable` makes of it: the
    channel alone says what colour a metal has.
    """
    if fitted.shading.diffuse != "sh":
        return lambda camera, shot: shot.maps
    try:
        scene = relightable(fitted)
    except InputError:  # without light or materials there is nothing to make it of
        return lambda camera, shot: {n: m for n, m in shot.maps.items() if n != "albedo"}
    view = replace(scene, shading=Shading("pixel", "split_sum", "irradiance")).renderer(samples=samples)
    return lambda camera, shot: RenderedView.maps_of(view(camera), *shot.alpha.shape)


def panels(
    shot: RenderedView, maps: dict[str, np.ndarray], view: View, scale: np.ndarray, concave: np.ndarray | None
) -> dict[str, np.ndarray]:
    """Ours beside the truth, map by map, by title; albedo after its scale."""
    pairs: dict[str, tuple[np.ndarray, ...]] = {"picture": (shot.image, view.displayed)}
    covered = view.covered()
    if view.normal is not None:
        normals = on_white(0.5 + 0.5 * shot.normal, shot.alpha), on_white(0.5 + 0.5 * view.normal, covered)
        pairs["normals"] = normals
    for name in NAMES:
        if name not in maps:
            continue
        factor = scale if name == "albedo" else 1.0
        both = [maps[name].reshape(*shot.alpha.shape, -1) * factor]
        both += [view.materials[name][..., :-1]] if name in view.materials else []
        shown = [srgb_from_linear(x) if x.shape[-1] == 3 else np.repeat(x, 3, axis=-1) for x in both]
        shares = [shot.alpha, view.materials[name][..., -1]] if len(both) > 1 else [shot.alpha]
        pairs[name] = tuple(on_white(x, a) for x, a in zip(shown, shares, strict=True))
    found = {}
    for name, pictures in pairs.items():
        found[f"{name}: ours{' | true' if len(pictures) > 1 else ''}"] = side_by_side(pictures)
    if concave is not None:
        found["concave"] = on_white(np.repeat(0.75 * concave[..., None], 3, axis=-1) * [1, 0.4, 0], covered)
    return {title: np.clip(picture, 0, 1) for title, picture in found.items()}
