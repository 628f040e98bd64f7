"""Metal or dielectric, surfel by surfel: which one the images prefer, smoothed over surfaces of equal colour.

Pixels and views see a surfel as y = c - s: their colour c less what a dielectric reflects. Of a dielectric, y
is the same everywhere; of a metal, it is proportional to the reflection. Least squares find that colour or
factor per channel, and the material with the smaller error is preferred.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from scipy.sparse import csr_matrix, diags
from scipy.spatial import cKDTree

from mi_refgs.data.view import evenly_spread
from mi_refgs.fitting import per_view
from mi_refgs.fitting.train import FEW_VIEWS, Trainer
from mi_refgs.io.images import SATURATED, srgb_from_linear
from mi_refgs.kernels.device import upload
from mi_refgs.methods.extensions import Event, register_event
from mi_refgs.methods.fields import Window
from mi_refgs.render.display import composited, image_array
from mi_refgs.shade.points import RadianceTerms
from mi_refgs.shade.reflectance.split_sum import DIELECTRIC_F0
from mi_refgs.splat.weights import BlendedView
from mi_refgs.surfels.attributes import SH_DC, logit, sigmoid
from mi_refgs.surfels.table import Surfels

DIELECTRIC, METAL = 0.05, 0.95  # metallic afterwards: at 1, colour has no derivative
OPAQUE = 0.8  # opacity of the object from which a pixel counts
LEVEL = 1 / 255  # displayed error below which materials explain equally well: a level of 8 bits
SHADE = 0.01  # linear radiance below which the slope of sRGB stays that of this one
NEIGHBOURS, STEPS = 16, 256  # nearest surfels, to which evidence spreads so many times
CHROMA = 0.02  # standard deviation of shares of red, green and blue on one material
DARK = 0.1  # sum of displayed red, green and blue below which shares are noise
FITTED = 0.2  # dB by which metallic as it was learnt counts from 0 to 1: it decides where images do not


@register_event
@dataclass(frozen=True)
class MetalEvidence(Event[Trainer]):
    """Makes each surfel a metal or a dielectric, as images and its neighbours say; metallic then stays.
    `confidence` becomes the share of the other material's squared error that this one avoids."""

    name: ClassVar[str] = "metal_evidence"
    attributes: ClassVar[tuple[str, ...]] = ("albedo", "metallic", "roughness")
    when: Window  # iterations at which it happens

    def due(self, trainer: Trainer) -> bool:
        return self.when.due(trainer.iteration) and trainer.shading().model.light != "none"

    def apply(self, trainer: Trainer) -> None:
        errors, tint, colour, pixels = fitted(moments(trainer))
        raw = trainer.surfels.to_numpy()
        gain = preferred(trainer.surfels, errors, pixels, colour)
        metal = gain > 0
        was = sigmoid(raw["metallic"][:, 0]) > 0.5
        # A surfel that changes continues with the colour that was fitted to it.
        raw["metallic"] = np.where(metal, logit(METAL), logit(DIELECTRIC))[:, None].astype(np.float32)
        raw["albedo"] = np.where((metal & ~was)[:, None], logit(np.clip(tint, 0.02, 0.98)), raw["albedo"])
        if "radiance_sh" in raw:
            raw["radiance_sh"][was & ~metal] = 0
            raw["radiance_sh"][was & ~metal, :3] = ((colour - 0.5) / SH_DC)[was & ~metal]
        if "confidence" in raw:
            raw["confidence"] = logit(1 - 10 ** (-np.abs(gain[:, None]) / 10)).astype(np.float32)
        trainer.fit.tables[0].replace(Surfels.from_numpy(raw), ("metallic", "albedo", "radiance_sh"))
        trainer.fit.optimiser.factors["metallic"] = 0.0
        trainer.tell(f"metal: {metal.mean():.0%} of the surfels, {np.mean(metal != was):.0%} changed")


def moments(trainer: Trainer) -> np.ndarray:
    """Pixels (N,) that show each surfel, and sums over these of 1, y, y², x y and x² per channel, times the
    squared slope of the display: (16, N). x is the reflection of a white metal less a dielectric's."""
    fit, data, raw = trainer.fit, trainer.data, trainer.surfels.to_numpy()
    raw["albedo"][:] = logit(1.0)
    extremes = [Surfels.from_numpy(raw | {"metallic": np.full(len(raw["albedo"]), logit(m))}) for m in (0, 1)]
    tables = [trainer.surfels, *([] if fit.surroundings is None else [fit.surroundings.surfels])]
    gains = per_view.gains_of(fit.params)
    sums = np.zeros((16, trainer.surfels.count))
    for index in evenly_spread(len(data.views), FEW_VIEWS):
        view = trainer.read(index)
        camera = view.camera()
        frames = [trainer.view(camera, surfels=surfels) for surfels in extremes]
        terms, size = [frame.terms or RadianceTerms() for frame in frames], (view.height, view.width)
        dull, mirror = (image_array(one.specular + one.indirect, *size) for one in terms)
        around = image_array(composited(frames[0])[0] - terms[0].total(), *size)
        opacity = image_array(frames[0].object_alpha, *size)[..., None]
        seen = view.colour(data.background) / (1 if gains is None else gains[index])
        seen = seen * (1 if view.alpha is None else view.alpha[..., None])
        whole = np.maximum(opacity, OPAQUE)
        y, x = (seen - around - dull) / whole, (mirror - dull) / whole
        shade = np.maximum(seen, SHADE)
        slope = (srgb_from_linear(1.01 * shade) - srgb_from_linear(0.99 * shade)) / (0.02 * shade)
        counts = (opacity > OPAQUE) & (view.displayed < SATURATED).all(axis=-1, keepdims=True)
        weight = np.square(slope) * counts
        maps = np.concatenate([counts, *(weight * value for value in (1, y, y * y, x * y, x * x))], axis=-1)
        planes = [upload(np.float32(plane).ravel()) for plane in np.moveaxis(maps, 2, 0)]
        blended = BlendedView.of(tables, camera, [0] * len(planes))
        sums += [found[: sums.shape[1]] for found in blended.sums(planes)]
    return sums


def fitted(sums: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Squared errors (2, N) as a dielectric and as a metal, the metal's albedo and the dielectric's radiance
    (N, 3), and weights (N,), of `moments`."""
    one, y, yy, xy, xx = sums[1:].reshape(5, 3, -1)
    colour = np.maximum(y / np.maximum(one, 1e-9), 0)
    factor = np.clip(xy / np.maximum(xx, 1e-9), 0, 1)
    dielectric, metal = yy + colour * (colour * one - 2 * y), yy + factor * (factor * xx - 2 * xy)
    errors = np.stack([dielectric, metal]).sum(axis=1)
    return errors, (DIELECTRIC_F0 + (1 - DIELECTRIC_F0) * factor).T, colour.T, sums[0]


def preferred(surfels: Surfels, errors: np.ndarray, weight: np.ndarray, colour: np.ndarray) -> np.ndarray:
    """By how many dB (N,) metal explains the images better, FITTED included, as a mean over surfels nearby of
    the same colour and orientation; 0 where nothing is seen."""
    gain = 10 * np.log10(np.divide(*(errors + 3 * weight * LEVEL**2 + 1e-12)))
    gain += FITTED * (surfels.value("metallic").numpy() - 0.5)
    position, normal = (np.array(x).T for x in (surfels.position(), surfels.primitive.normal(surfels)))
    shade = srgb_from_linear(np.clip(colour, 0, 1))
    shade = shade / np.maximum(shade.sum(axis=1, keepdims=True), DARK)
    distance, near = cKDTree(position).query(position, range(1, min(NEIGHBOURS, len(position)) + 1))
    alike = np.square(distance / np.maximum(np.median(distance, axis=1, keepdims=True), 1e-12))
    alike += np.square((shade[near] - shade[:, None]) / CHROMA).sum(axis=-1)
    link = np.exp(-alike / 2) * np.square((normal[near] * normal[:, None]).sum(axis=-1))
    graph = csr_matrix((link.ravel(), near.ravel(), np.arange(0, near.size + 1, near.shape[1])))
    graph = diags(1 / graph.sum(axis=1).A1) @ graph
    spread = np.stack([weight * gain, weight], axis=1)
    for _ in range(STEPS):
        spread = graph @ spread
    return np.asarray(spread[:, 0] / np.maximum(spread[:, 1], 1e-12))
