"""What is measured: shapes, materials, lights, resolutions, sample counts; in three sizes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import mitsuba as mi

from benchmarks.common.lights import BUILT_IN, ROOT
from benchmarks.common.view import Look

MESHES = ROOT / "scenes" / "meshes"

SHAPES: dict[str, Look] = {
    "sphere": Look((0, 0.6, 4), (0, 0, 0), 30),
    "rounded_cube": Look((1.6, 1.2, 3.4), (0, 0, 0), 33),
    "patch": Look((0, 1, 0), (-1, 0.8, 0), 18),  # a floor from 2° to 20° above it, looking at the low sun
    "torus": Look((0, -2.4, 2.6), (0, 0, 0), 36),
}
"""The cameras of the shapes. All are convex but the torus, which shadows and mirrors itself."""
CONVEX = ("sphere", "rounded_cube", "patch")


def shape(name: str) -> dict[str, Any]:
    """Mitsuba's description of a shape."""
    if name == "sphere":
        return {"type": "sphere"}
    if name == "patch":
        turn = mi.ScalarTransform4f().rotate([1, 0, 0], -90) @ mi.ScalarTransform4f().scale(100)
        return {"type": "rectangle", "to_world": turn}
    return {"type": "ply", "filename": str(MESHES / f"{name}.ply")}


@dataclass(frozen=True)
class Settings:
    """One run; heights and sample counts rise."""

    shapes: tuple[str, ...] = ("sphere", "rounded_cube", "patch")
    lights: tuple[str, ...] = BUILT_IN
    roughness: tuple[float, ...] = (0.05, 0.1, 0.2, 0.3, 0.45, 0.6, 0.8, 1.0)
    metallic: tuple[float, ...] = (0.0, 0.5, 1.0)
    size: int = 48  # edge of the pictures whose error is measured
    timing_size: int = 512  # of those that are timed: large enough that launching a kernel costs nothing
    truth_height: int = 512
    heights: tuple[int, ...] = (16, 32, 64, 128, 256)
    height: int = 64  # rows where one number is asked for: the product's default
    level_sets: tuple[str, ...] = ("few", "many")
    spp: tuple[int, ...] = (1, 4, 16, 64)
    timed_spp: tuple[int, ...] = (1, 4, 16)
    samples: tuple[int, ...] = (1, 4, 16, 64, 256, 1024)
    lattice: int = 377  # points of the reference's lattices, and as many of the light
    batches: int = 8
    budget_shapes: tuple[str, ...] = ("sphere", "patch", "torus")
    budget_metallic: tuple[float, ...] = (0.0, 1.0)
    full_depth_spp: int = 256
    surfels: int = 6000  # on the sphere of the surfels' budget
    timing_seconds: float = 0.25  # spent on each time, at least
    timing_rounds: int = 25  # of each time, at most


PAGE = Settings()
SMALL = Settings(
    shapes=("sphere", "patch"),
    lights=("constant", "gradient", "checker", "sunsky"),
    roughness=(0.1, 0.3, 0.8),
    metallic=(0.5,),
    size=32,
    timing_size=32,
    truth_height=64,
    heights=(16, 32, 64),
    height=32,
    level_sets=("few",),
    spp=(1, 4, 16),
    samples=(1, 16, 256),
    lattice=233,
    budget_shapes=("sphere", "torus"),
    budget_metallic=(1.0,),
    full_depth_spp=16,
    surfels=2000,
    timing_seconds=0.05,
    timing_rounds=1,
)
FULL = replace(
    PAGE,
    size=128,
    spp=(1, 4, 16, 64, 256),
    timed_spp=(1, 4, 16, 64),
    lattice=1597,
    batches=16,
    full_depth_spp=1024,
    timing_seconds=2.0,
)
