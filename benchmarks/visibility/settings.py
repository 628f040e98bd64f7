"""What is measured: scenes, roughness, numbers of rays and samples, in two sizes; and which rules."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from mi_refgs.shade.options import ShadingOptions

METALLIC = 1.0
"""A metal has no diffuse term: the whole picture is the specular one."""
VOXEL = 5e-5
"""Resolution the occluder is told, for objects of size 2. Mesh and points are exact: a ray
leaves the surface by no more than rounding asks for. Ten times as much keeps many rays from the exact
visibility: they then differ from it by 0.003 instead of 0.0004 (plates, roughness 0.1)."""


@dataclass(frozen=True)
class Settings:
    """One run; numbers of rays rise."""

    scenes: tuple[str, ...] = ("bowl", "deep_bowl", "plates")
    meshes: tuple[str, ...] = ()  # files
    roughness: tuple[float, ...] = (0.1, 0.3, 0.6)
    rays: tuple[int, ...] = (3, 4, 8)  # of the lobe, measured and timed
    more_rays: tuple[int, ...] = (16, 64, 256)  # for the curve, and the most for the errors; not timed
    limit: int = 2048  # rays that stand for infinitely many
    size: int = 48  # edge of the pictures whose error is measured
    timing_size: int = 192  # of those that are timed
    light_height: int = 128  # rows, for the path tracer and the prefiltered light alike
    spp: int = 64  # of each batch of the references
    batches: int = 8
    lattice: int = 610  # points of each lattice of the exact visibility
    bounces: tuple[int, ...] = (1, 2, 3, 4)  # of traced light
    dominant: tuple[bool, ...] = (False, True)  # for traced light: off, and on
    detail: int = 1  # 0: coarse meshes
    timing_seconds: float = 0.2  # spent on each time, at least
    timing_rounds: int = 25  # of each time, at most

    @property
    def counts(self) -> tuple[int, ...]:
        """All numbers of rays, one (the mirror ray) included."""
        return tuple(sorted({1, *self.rays, *self.more_rays}))


PAGE = Settings()
SMALL = Settings(
    scenes=("bowl", "plates"),
    roughness=(0.3,),
    rays=(4, 64),
    more_rays=(),
    limit=512,
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


PAPER = Rule(1)
"""One mirror ray for the whole lobe, and no traced light."""


def rules(settings: Settings) -> Iterator[Rule]:
    """All that are measured."""
    yield Rule(0)
    for rays in settings.counts:
        yield Rule(rays)
    for bounces in settings.bounces:
        for dominant in settings.dominant:
            for rays in (1, *settings.rays):
                yield Rule(rays, bounces, dominant)
        if settings.more_rays:
            yield Rule(max(settings.more_rays), bounces)
