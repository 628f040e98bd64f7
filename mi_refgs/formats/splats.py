"""A scene as 3D Gaussians with spherical-harmonic colours: what viewers of 3DGS files show.

They project each Gaussian by EWA, add 0.3 pixel² to its covariance, and blend display-encoded colours that
depend on the direction alone. [3DGS, Kerbl et al. 2023, §4] A surfel becomes a Gaussian whose third axis is
thin; that filter widens outlines by about INSET pixels, by which it moves inwards.

Colours come from pictures of the scene, so that shading, occlusion and light from other parts are in them.
With w the blended weights, e_p the encoded colour that pixel p of view v shows and Y the harmonics in the
direction from the camera to the Gaussian, the coefficients c minimise

    Σ_v Σ_p |Σ_i w_ip (½ + Y(d_iv)·c_i) - A_p e_p|²  +  Σ_i λ W_i Σ_lm l² |c_i,lm|²

by conjugate gradients; W_i is the weight of a Gaussian in all views, l the degree of a coefficient. The first
step is that of the preconditioner: for each Gaussian alone, the least squares of what it is seen before.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.spatial import cKDTree

from mi_refgs.errors import InputError
from mi_refgs.formats.format import Shot
from mi_refgs.formats.last_made import LastMade
from mi_refgs.kernels.device import upload
from mi_refgs.render.display import display_image
from mi_refgs.render.surroundings import together
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.shade.sh import sh_basis
from mi_refgs.splat import Camera, splat
from mi_refgs.surfels.attributes import MAX_SH_DEGREE
from mi_refgs.surfels.table import Surfels

THIN = 0.01
"""Third standard deviation of a surfel in its shorter one: below every filter. Thicker ones widen outlines:
of a ring at 200², alpha is 21.1 dB from the surfels' with 0.1, and 21.5 with 0.01 and with 0.001."""
INSET = 0.8
"""Pixels of the training cameras by which surfels move inwards: of the same ring alpha is 24.0, 34.3, 34.9
and 30.2 dB from the surfels' with 0, 0.6, 0.8 and 1, of a chair with the last three 30.4, 33.4 and 34.4."""
SEEN = 0.5
"""Blended weight in pixels, over these views, from which on a surfel is taken to be seen."""
VIEWS = 64
"""Pictures that colours are fitted to, at most."""
PIXELS = 400**2
"""Of each of them, at most: colours need no more, and time grows with it."""
STEPS = 3
"""Of conjugate gradients after the first; a chair gains 2.8 dB by two."""
DAMPING = 0.1
"""λ, over the 1/4π that Y² has in the mean. Of a smooth ball in 20 views, the inside of other views is 33.7
dB from the surfels' without the factor l², 36.8 with it; of a smooth metal one 31.2 and 33.1."""


_MADE: LastMade[Surfels] = LastMade()


def gaussians(trained: TrainedScene, shots: Sequence[Shot], degree: int, alone: bool) -> Surfels:
    """The scene as a table of 3D Gaussians whose radiance_sh of `degree` are display-encoded.

    `alone`: without the surroundings; the background is never among them. Raises InputError for a degree out
    of range, and for a scene without surfels.
    """
    asked = (*shots, degree, alone)
    return _MADE.get(trained, asked, lambda: _gaussians(trained, shots, degree, alone))


def _gaussians(trained: TrainedScene, shots: Sequence[Shot], degree: int, alone: bool) -> Surfels:
    if not 0 <= degree <= MAX_SH_DEGREE:
        raise InputError(f"--degree: {degree} is out of range; give 0 to {MAX_SH_DEGREE}")
    if alone:
        trained = replace(trained, surroundings=None)
    around = trained.surroundings
    table = trained.surfels.detach()
    if around is not None and around.surfels.count:
        table = together(table, around.surfels)
    if not table.count:
        raise InputError("surfels: there are none; nothing can be exported")
    cameras = _cameras(shots)
    raw = {name: table.to_numpy()[name] for name in table.primitive.widths}
    if raw["scale"].shape[1] == 2:
        raw["position"] = _inset(table, cameras)
        thin = raw["scale"].min(axis=1, keepdims=True) + np.float32(np.log(THIN))
        raw["scale"] = np.concatenate([raw["scale"], thin], axis=1)
    if trained.shading.model.encoded and around is None:
        own = trained.surfels.to_numpy()["radiance_sh"]
        columns = 3 * (degree + 1) ** 2
        harmonics = np.zeros((len(own), columns), np.float32)
        harmonics[:, : own.shape[1]] = own[:, :columns]
    else:
        harmonics = _Colours(trained, Surfels.from_numpy(raw), cameras, degree).fitted()
    return Surfels.from_numpy(raw | {"radiance_sh": harmonics})


def _cameras(shots: Sequence[Shot]) -> list[Camera]:
    """Training cameras, spread evenly over all of them, of not too many pixels."""
    chosen = [shot.camera for shot in shots if shot.split == "train"] or [shot.camera for shot in shots]
    index = np.linspace(0, len(chosen) - 1, min(len(chosen), VIEWS)).round().astype(int)
    return [_smaller(chosen[i]) for i in index]


def _smaller(camera: Camera) -> Camera:
    factor = max((camera.width * camera.height / PIXELS) ** 0.5, 1)
    if factor == 1:
        return camera
    size = max(round(camera.width / factor), 1), max(round(camera.height / factor), 1)
    return camera.resized(size)


def _inset(table: Surfels, cameras: Sequence[Camera]) -> np.ndarray:
    """Positions (N, 3) float32 moved by INSET pixels away from the side that the cameras see."""
    position, normal = table.position(), table.primitive.normal(table)
    side, pixels, total = np.zeros(table.count), np.zeros(table.count), np.zeros(table.count)
    for camera in cameras:
        weight = _Seen.of(table, [], camera).gathered([])[-1]
        cosine = dr.dot(normal, dr.normalize(camera.towards(position))).numpy()
        side -= weight * np.sign(cosine)
        pixels += weight * np.maximum(camera.to_camera(position).z.numpy(), 0) / camera.focal
        total += weight
    normal, position = normal.numpy().T, position.numpy().T
    outward = np.sign(side)[:, None] * normal
    distance = INSET * pixels / np.maximum(total, 1e-12)
    seen = total > SEEN
    if seen.any() and not seen.all():  # hidden ones show where those before them have moved
        nearest = cKDTree(position[seen]).query(position[~seen])[1]
        turned = np.sum(normal[~seen] * outward[seen][nearest], axis=1, keepdims=True)
        outward[~seen] = np.sign(turned) * normal[~seen]
        distance[~seen] = distance[seen][nearest]
    return (position - distance[:, None] * outward).astype(np.float32)


@dataclass(frozen=True)
class _Seen:
    """Blended colours of a view, attached to the colours of the rows."""

    inputs: list[Any]  # mi.Float (N,): colour planes, then one of zeros
    planes: list[Any]  # mi.Float (H·W,): blended
    alpha: Any

    @staticmethod
    def of(table: Surfels, colours: Sequence[np.ndarray], camera: Camera) -> _Seen:
        inputs = [*(upload(plane) for plane in colours), dr.opaque(mi.Float, 0, table.count)]
        dr.enable_grad(inputs)
        blended = splat(table, inputs, camera)
        return _Seen(inputs, list(blended.features), dr.detach(blended.alpha))

    def gathered(self, pictures: Sequence[Any]) -> list[np.ndarray]:
        """Σ_p w_ip x_p (N,) float64 of planes x of pixels, one for each colour, and of alpha: a weight."""
        total = sum(
            (dr.sum(plane * x) for plane, x in zip(self.planes, [*pictures, self.alpha], strict=True)),
            mi.Float(0),
        )
        if dr.grad_enabled(total):  # unless the view sees nothing
            dr.backward(total)
        return [np.array(dr.grad(plane), dtype=np.float64) for plane in self.inputs]


class _Colours:
    """The least squares of the colours."""

    def __init__(self, trained: TrainedScene, table: Surfels, cameras: Sequence[Camera], degree: int) -> None:
        self.trained, self.table, self.cameras, self.degree = trained, table, cameras, degree
        self.terms = (degree + 1) ** 2
        self.position = table.position()
        self.ridge = np.zeros((table.count, self.terms))

    def fitted(self) -> np.ndarray:
        """Coefficients (N, 3 terms) float32 in the table's order of columns; rows that no view shows have
        those of the nearest one that is shown."""
        right, inverse, weight = self._alone()
        found = self._conjugate_gradients(right, inverse)
        seen = weight > 0
        if seen.any() and not seen.all():
            place = self.position.numpy().T
            found[~seen] = found[seen][cKDTree(place[seen]).query(place[~seen])[1]]
        return found.reshape(len(found), -1).astype(np.float32)

    def _alone(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Right-hand side (N, terms, 3), inverse of each Gaussian's own matrix, and its weight (N,)."""
        count, terms = self.table.count, self.terms
        own, right = np.zeros((count, terms, terms), np.float32), np.zeros((count, terms, 3))
        weight = np.zeros(count)
        view = self.trained.renderer(aovs=False)
        for camera in self.cameras:
            basis = self._basis(camera)
            seen = _Seen.of(self.table, [np.zeros(count, np.float32)] * 3, camera)
            frame = view(camera)
            shown = display_image(list(frame.radiance), frame.alpha, [0.0] * 3)
            *gathered, share = seen.gathered([dr.minimum(x, frame.alpha) - 0.5 * seen.alpha for x in shown])
            own += (share[:, None] * basis)[:, :, None].astype(np.float32) * basis[:, None].astype(np.float32)
            right += basis[:, :, None] * np.stack(gathered, axis=1)[:, None]
            weight += share
        level = np.sqrt(np.arange(terms)).astype(int)
        self.ridge[:] = DAMPING / (4 * np.pi) * weight[:, None] * level**2
        step = np.arange(terms)
        # Rows that no view shows: anything that can be inverted.
        own[:, step, step] += self.ridge + np.maximum(1e-6 * weight, 1e-6)[:, None]
        return right, np.linalg.inv(own), weight

    def _conjugate_gradients(self, right: np.ndarray, inverse: np.ndarray) -> np.ndarray:
        """STEPS preconditioned steps for each colour. [Hestenes and Stiefel 1952]"""
        residual, found = right, np.zeros_like(right)
        moved = inverse @ residual
        direction, product = moved, np.sum(residual * moved, axis=(0, 1))
        for _ in range(STEPS + 1):
            image = self._normal_equations(direction)
            length = product / np.maximum(np.sum(direction * image, axis=(0, 1)), 1e-30)
            found, residual = found + length * direction, residual - length * image
            moved, before = inverse @ residual, product
            product = np.sum(residual * moved, axis=(0, 1))
            direction = moved + product / np.maximum(before, 1e-30) * direction
        return found

    def _normal_equations(self, coefficients: np.ndarray) -> np.ndarray:
        out = self.ridge[:, :, None] * coefficients
        for camera in self.cameras:
            basis = self._basis(camera)
            colour = np.einsum("nk,nkc->cn", basis, coefficients)
            seen = _Seen.of(self.table, [*colour], camera)
            *gathered, _ = seen.gathered([dr.detach(plane) for plane in seen.planes[:3]])
            out += basis[:, :, None] * np.stack(gathered, axis=1)[:, None]
        return out

    def _basis(self, camera: Camera) -> np.ndarray:
        """Harmonics (N, terms) float64 in the direction from the camera to each Gaussian."""
        functions = sh_basis(dr.normalize(camera.towards(self.position)), self.degree)
        return np.stack([np.array(f + dr.zeros(mi.Float, self.table.count)) for f in functions], axis=1)
