"""Convert a scene to 3D Gaussians with spherical-harmonic (SH) colours, for viewers of 3DGS files.

Such viewers project each Gaussian by EWA, add 0.3 pixel² to its covariance, and blend display-encoded colours
that depend on the direction alone. [3DGS, Kerbl et al. 2023, §4] A surfel becomes a Gaussian whose third axis
is thin; that filter widens outlines by about INSET pixels, by which the Gaussian moves inwards.

Colours are fitted to renders of the scene, so that they include shading, occlusion and indirect light. With w
the blending weights, e_p the encoded colour and A_p the alpha of pixel p of view v, and Y the SH in the
direction d_iv from the camera to the Gaussian, the coefficients c minimise

    Σ_v Σ_p |Σ_i w_ip (½ + Y(d_iv)·c_i) - A_p e_p|²  +  Σ_i λ W_i Σ_lm l² |c_i,lm|²

by conjugate gradients; W_i is the weight of a Gaussian in all views, l the degree of a coefficient. The
preconditioner, whose solution is the first step, is the least-squares problem of each Gaussian by itself."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.sparse.linalg import LinearOperator, cg
from scipy.spatial import cKDTree

from mi_refgs.data.view import evenly_spread
from mi_refgs.errors import InputError, require_between
from mi_refgs.formats.format import Shot
from mi_refgs.kernels.device import upload
from mi_refgs.render.display import display_image
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.shade.sh import sh_basis
from mi_refgs.splat import Camera
from mi_refgs.splat.weights import BlendedView
from mi_refgs.surfels.attributes import MAX_SH_DEGREE
from mi_refgs.surfels.ply import write_ply as write_surfels
from mi_refgs.surfels.primitives.primitive import PRIMITIVES
from mi_refgs.surfels.table import Surfels

THIN = 0.01  # third standard deviation of a surfel relative to its shorter one: thicker ones widen outlines
INSET = 0.8  # pixels of the training cameras by which surfels move inwards
SEEN = 0.5  # blended weight, in pixels over these views, above which a surfel counts as seen
VIEWS = 64  # maximum number of renders that colours are fitted to
PIXELS = 400**2  # maximum number of pixels per render: colours need no more, and time grows with it
STEPS = 3  # conjugate-gradient steps after the first
DAMPING = 0.1  # λ, over the 1/4π that Y² is on average


def write_ply(
    trained: TrainedScene, target: Path, shots: Sequence[Shot], *, degree: int, object: bool
) -> list[Path]:
    """The PLY file of 3D Gaussian Splatting, which its viewers, editors and converters read.

        x y z  nx ny nz  f_dc_0..2  f_rest_0..  opacity  scale_0..2  rot_0..3      little-endian float32

    Logits, logarithms and display-encoded colours, as in `surfels.ply`. The colours are fitted to renders."""
    write_surfels(target, gaussians(trained, shots, degree, object))
    return [target]


def gaussians(trained: TrainedScene, shots: Sequence[Shot], degree: int, object_only: bool) -> Surfels:
    """The scene as 3D Gaussians with display-encoded radiance_sh; `object_only`: without background ones."""
    require_between(degree, "--degree", 0, MAX_SH_DEGREE)
    if object_only:
        trained = replace(trained, surroundings=None)
    around, tables = trained.surroundings, [trained.surfels.detach()]
    if around is not None:
        tables.append(around.surfels.detach())
    tables = [table for table in tables if table.count]
    if not tables:
        raise InputError("there are none", "surfels", remedy="nothing can be exported")
    # Training cameras, spread evenly over all of them, of at most PIXELS.
    chosen = [shot.camera for shot in shots if shot.split == "train"] or [shot.camera for shot in shots]
    cameras = []
    for camera in (chosen[i] for i in evenly_spread(len(chosen), VIEWS)):
        factor, side = (camera.width * camera.height / PIXELS) ** 0.5, max(camera.width, camera.height)
        cameras.append(camera if factor <= 1 else camera.resized(round(side / factor)))
    # Geometry: surfels get a thin third axis, and move inwards.
    parts = [_geometry(table) for table in tables]
    raw = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    flat = np.concatenate([np.full(one.count, one.primitive.widths.get("scale") == 2) for one in tables])
    if flat.any():
        raw["position"] = np.where(flat[:, None], _inset(tables, cameras), raw["position"])
    # Colours: those of an imported file are encoded already.
    if trained.shading.model.encoded and around is None:
        own = trained.surfels.to_numpy()["radiance_sh"]
        sh = np.zeros((len(own), 3 * (degree + 1) ** 2), np.float32)
        sh[:, : own.shape[1]] = own[:, : sh.shape[1]]
    else:
        sh = _ColourFit(trained, Surfels.from_numpy(raw), cameras, degree).solve()
    return Surfels.from_numpy(raw | {"radiance_sh": sh})


def _geometry(table: Surfels) -> dict[str, np.ndarray]:
    """Return raw geometry with three standard deviations."""
    raw, gaussian = table.to_numpy(), PRIMITIVES["gaussian"]
    if "scale" not in raw:
        raw |= gaussian.like(*table.primitive.extent(raw))
    raw = {name: raw[name] for name in gaussian.widths}
    if raw["scale"].shape[1] == 2:
        thin = raw["scale"].min(axis=1, keepdims=True) + np.float32(np.log(THIN))
        raw["scale"] = np.concatenate([raw["scale"], thin], axis=1)
    return raw


def _inset(tables: Sequence[Surfels], cameras: Sequence[Camera]) -> np.ndarray:
    """Return positions (N, 3) float32 moved by INSET pixels away from the side that the cameras see."""
    position = np.concatenate([table.position().numpy().T for table in tables])
    normal = np.concatenate([table.primitive.normal(table).numpy().T for table in tables])
    place = mi.Point3f(*(upload(column) for column in np.ascontiguousarray(position.T)))
    side, pixels, total = (np.zeros(len(position)) for _ in range(3))
    for camera in cameras:
        view = BlendedView.of(tables, camera, [0])
        weight = view.sums([view.maps.alpha])[0]
        cosine = np.sum(normal * dr.normalize(camera.towards(place)).numpy().T, axis=1)
        side -= weight * np.sign(cosine)
        pixels += weight * np.maximum(camera.to_camera(place).z.numpy(), 0) / camera.focal
        total += weight
    outward = np.sign(side)[:, None] * normal
    distance = INSET * pixels / np.maximum(total, 1e-12)
    seen = total > SEEN
    if seen.any() and not seen.all():  # hidden ones become visible where those before them have moved
        nearest = cKDTree(position[seen]).query(position[~seen])[1]
        turned = np.sum(normal[~seen] * outward[seen][nearest], axis=1, keepdims=True)
        outward[~seen] = np.sign(turned) * normal[~seen]
        distance[~seen] = distance[seen][nearest]
    return (position - distance[:, None] * outward).astype(np.float32)


class _ColourFit:
    """The least-squares problem of the colours. `terms` is the number of SH functions."""

    def __init__(self, trained: TrainedScene, table: Surfels, cameras: Sequence[Camera], degree: int) -> None:
        self.trained, self.table, self.cameras, self.degree = trained, table, cameras, degree
        self.terms = (degree + 1) ** 2
        self.position = table.position()
        self.ridge = np.zeros((table.count, self.terms))

    def solve(self) -> np.ndarray:
        """Return coefficients (N, 3 terms) float32; unseen Gaussians get those of the nearest seen one."""
        right, inverse, weight = self._preconditioner()
        shape = right.shape

        def operator(function: Callable[[np.ndarray], np.ndarray]) -> LinearOperator:
            return LinearOperator((right.size,) * 2, lambda x: function(x.reshape(shape)).ravel())

        matrix, first = operator(self._normal_equations), operator(lambda x: inverse @ x)
        found = cg(matrix, right.ravel(), rtol=0, maxiter=STEPS + 1, M=first)[0].reshape(shape)
        seen = weight > 0
        if seen.any() and not seen.all():
            position = self.position.numpy().T
            found[~seen] = found[seen][cKDTree(position[seen]).query(position[~seen])[1]]
        return found.reshape(len(found), -1).astype(np.float32)

    def _preconditioner(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the right-hand side (N, terms, 3), inverses of the Gaussians' own matrices, weights (N,)."""
        count, terms = self.table.count, self.terms
        own, right = np.zeros((count, terms, terms), np.float32), np.zeros((count, terms, 3))
        weight = np.zeros(count)
        render = self.trained.renderer(aovs=False)
        for camera in self.cameras:
            basis = self._basis(camera)
            view = BlendedView.of([self.table], camera, [0] * 4)
            frame = render(camera)
            encoded = display_image(list(frame.radiance), frame.alpha, [0.0] * 3)
            images = [dr.minimum(x, frame.alpha) - 0.5 * view.maps.alpha for x in encoded]
            *sums, share = view.sums([*images, view.maps.alpha])
            own += (share[:, None] * basis)[:, :, None].astype(np.float32) * basis[:, None].astype(np.float32)
            right += basis[:, :, None] * np.stack(sums, axis=1)[:, None]
            weight += share
        level = np.sqrt(np.arange(terms)).astype(int)
        self.ridge[:] = DAMPING / (4 * np.pi) * weight[:, None] * level**2
        diagonal = np.arange(terms)
        # Gaussians that no view sees: any matrix that can be inverted.
        own[:, diagonal, diagonal] += self.ridge + np.maximum(1e-6 * weight, 1e-6)[:, None]
        return right, np.linalg.inv(own), weight

    def _normal_equations(self, coefficients: np.ndarray) -> np.ndarray:
        """Apply the matrix of the normal equations to coefficients (N, terms, 3)."""
        out = self.ridge[:, :, None] * coefficients
        for camera in self.cameras:
            basis = self._basis(camera)
            colours = [upload(plane) for plane in np.einsum("nk,nkc->cn", basis, coefficients)]
            view = BlendedView.of([self.table], camera, colours)
            out += basis[:, :, None] * np.stack(view.sums(view.maps.features), axis=1)[:, None]
        return out

    def _basis(self, camera: Camera) -> np.ndarray:
        """Return the SH functions (N, terms) float64 of the direction from the camera to each Gaussian."""
        functions = sh_basis(dr.normalize(camera.towards(self.position)), self.degree)
        return np.stack([np.array(f + dr.zeros(mi.Float, self.table.count)) for f in functions], axis=1)
