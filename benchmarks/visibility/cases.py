"""Settings of a run, rules of visibility, and the concave scenes: triangle meshes with smooth normals."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from benchmarks.common.view import Look
from mi_refgs.occlusion.mesh import read_mesh
from mi_refgs.shade.options import ShadingOptions

METALLIC = 1.0  # A metal has no diffuse term: the whole image is the specular one
VOXEL = 5e-5
"""Resolution the occluder is told, for objects of size 2. Mesh and points are exact: a ray leaves the surface
by no more than rounding requires."""


@dataclass(frozen=True)
class Settings:
    """One run; numbers of rays rise."""

    scenes: tuple[str, ...] = ("bowl", "deep_bowl", "plates")
    meshes: tuple[str, ...] = ()  # files
    roughness: tuple[float, ...] = (0.1, 0.3, 0.6)
    rays: tuple[int, ...] = (3, 4, 8)  # of the lobe
    size: int = 48  # edge of the images whose error is measured
    timing_size: int = 192  # of those that are timed
    light_height: int = 128  # rows, for the path tracer and the prefiltered light alike
    spp: int = 64  # of each batch of the references
    batches: int = 8
    lattice: int = 610  # directions of the fitted harmonics
    bounces: tuple[int, ...] = (1, 2, 3, 4)  # of traced light
    dominant: tuple[bool, ...] = (False, True)  # for traced light: off, and on
    detail: int = 1  # 0: coarse meshes
    timing_seconds: float = 0.2  # spent on each time, at least
    timing_rounds: int = 25  # of each time, at most


PAGE = Settings()
SMALL = Settings(
    scenes=("bowl", "plates"),
    roughness=(0.3,),
    rays=(4, 64),
    size=32,
    timing_size=64,
    light_height=64,
    spp=16,
    lattice=233,
    bounces=(1, 4),
    dominant=(False,),
    detail=0,
    timing_seconds=0.02,
    timing_rounds=1,
)


# ---------------- rules ----------------


@dataclass(frozen=True)
class Rule:
    """How visibility and indirect light are found; 0 rays: not at all."""

    rays: int
    bounces: int = 0
    dominant: bool = False

    @property
    def name(self) -> str:
        """In the report."""
        base = {0: "no occlusion", 1: "mirror ray"}.get(self.rays, f"{self.rays} rays")
        bounces = f", {self.bounces} bounce{'s' * (self.bounces > 1)}" if self.bounces else ""
        return base + bounces + ", dominant" * self.dominant

    def options(self) -> ShadingOptions:
        """As the product is told."""
        return ShadingOptions(
            diffuse="irradiance",
            dominant=self.dominant,
            visibility_rays=max(self.rays, 1),
            traced_bounces=self.bounces,
        )


PAPER = Rule(1)  # one mirror ray for the whole lobe, and no traced light


def rules(settings: Settings) -> Iterator[Rule]:
    """All that are measured."""
    yield Rule(0)
    for rays in (1, *settings.rays):
        yield Rule(rays)
    for bounces in settings.bounces:
        for dominant in settings.dominant:
            for rays in (1, *settings.rays):
                yield Rule(rays, bounces, dominant)


BOWLS = {"bowl": (60.0, -0.15), "deep_bowl": (90.0, -0.42)}
"""Degrees from a bowl's lowest point to its rim, of radius 1 at height 0; height of the torus in it."""
WALL = 0.08
RING = (0.45, 0.17)  # radii of the torus
PLATE = (0.1, 1.4, 1.6)
PLATE_DISTANCE, PLATE_ANGLE = 0.8, 30.0
"""From the middle to each plate, and the degrees by which each opens towards the camera: a mirror ray of the
one meets the other."""


@dataclass(frozen=True)
class Concave:
    """A named mesh of size about 2, and the camera that looks into it."""

    name: str
    mesh: Any  # trimesh.Trimesh
    look: Look


def _bowl(name: str, detail: int) -> Concave:
    """A torus that hovers in a bowl with a round rim: a part of a spherical shell."""
    degrees, height = BOWLS[name]
    sections, widest = 64 * (1 + detail), np.radians(degrees)
    θ = np.linspace(0, widest, sections // 4 + 1)[:, None]
    away, along = (np.concatenate(x, -1) for x in ((np.sin(θ), -np.cos(θ)), (np.cos(θ), np.sin(θ))))
    radius = 1 / np.sin(widest)
    turn = np.linspace(0, np.pi, 9)[1:-1, None]
    rim = (radius + WALL / 2) * away[-1] + WALL / 2 * (np.cos(turn) * away[-1] + np.sin(turn) * along[-1])
    line = np.concatenate([(radius + WALL) * away, rim, radius * away[::-1]])
    line[:, 1] += radius * np.cos(widest)
    bowl = trimesh.creation.revolve(line, sections=sections)
    torus = trimesh.creation.torus(*RING, major_sections=sections, minor_sections=sections // 2)
    torus.apply_translation([0, 0, height])
    whole = trimesh.util.concatenate([_outward(part) for part in (bowl, torus)])
    whole.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0]))
    return Concave(name, whole, Look((0, 2.6, 2.4), (0, -0.25, 0), 33))


def _plates(detail: int) -> Concave:
    """Two plates that face each other, opened towards the camera."""
    plates = []
    for side in (-1, 1):
        box = trimesh.creation.box(PLATE)
        # Corners of their own for every triangle: vertex normals are then those of the faces.
        plate = trimesh.Trimesh(box.triangles.reshape(-1, 3), np.arange(36).reshape(-1, 3), process=False)
        for _ in range(3 + detail):
            plate = plate.subdivide()
        turn = trimesh.transformations.rotation_matrix(side * np.radians(PLATE_ANGLE), [0, 1, 0])
        turn[0, 3] = side * PLATE_DISTANCE
        plates.append(plate.apply_transform(turn))
    return Concave("plates", trimesh.util.concatenate(plates), Look((0.2, 0.5, 4.2), (0, 0, 0), 32))


def _outward(mesh: Any) -> Any:
    if mesh.volume < 0:
        mesh.invert()
    return mesh


def _file(name: str) -> Concave:
    """A triangle mesh of any format of trimesh, closed and with outward faces, scaled to a radius of 1."""
    loaded = read_mesh(name)
    # Processing merges vertices at one place, such as those along the seams of a texture.
    mesh = trimesh.Trimesh(loaded.vertices, loaded.faces, process=True)
    mesh.apply_translation(-mesh.bounds.mean(0))
    mesh.apply_scale(1 / np.linalg.norm(mesh.vertices, axis=1).max())
    return Concave(Path(name).stem, _outward(mesh), Look((1.5, 1.6, 3.2), (0, 0, 0), 31))


def make_scene(name: str, detail: int) -> Concave:
    """A built-in scene (a bowl or "plates"), or the mesh file of that name.

    Raises InputError if that cannot be read."""
    if name in BOWLS:
        return _bowl(name, detail)
    return _plates(detail) if name == "plates" else _file(name)
