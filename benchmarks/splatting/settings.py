"""What is measured: numbers of surfels, sizes of images, how large the surfels are; in three sizes."""

from __future__ import annotations

from dataclasses import dataclass

Grid = tuple[tuple[int, int], ...]
"""(Surfels, edge of the image in pixels)."""


@dataclass(frozen=True)
class Settings:
    """One run; `spreads` are the standard deviations of surfels in units of √(sphere's area / surfels)."""

    surfels: tuple[int, ...] = (1_000, 10_000, 50_000, 200_000)
    sizes: tuple[int, ...] = (128, 256, 512, 1024)
    spreads: tuple[float, ...] = (0.75, 1.5)
    scenes: tuple[str, ...] = ()  # run folders of `refgs train`
    repeats: int = 9  # of each of our times; at least three of a slow one
    seconds: float = 2.5  # spent on ours in one case, roughly
    volprim: Grid = (
        *((n, size) for n in (1_000, 10_000, 50_000, 200_000) for size in (128, 256)),
        (50_000, 512),
    )
    volprim_repeats: int = 2
    errors: Grid = ((1_000, 256), (10_000, 256), (50_000, 256), (50_000, 512))
    crop: int = 32  # pixels, edge of the part whose error is measured
    memory: Grid = (
        (1_000, 256),
        (1_000, 1024),
        (50_000, 256),
        (50_000, 512),
        (200_000, 256),
        (200_000, 1024),
        (1_000_000, 512),
        (1_000_000, 1024),
    )
    compiled: tuple[int, int] = (10_000, 256)  # cold and warm compile times
    step: tuple[int, int] = (20_000, 200)  # of the training step
    steps: int = 30
    large_step: tuple[int, int] = (1_000_000, 1024)  # memory of one training step
    triad: int = 1 << 25  # floats of each array that measures the bandwidth


PAGE = Settings()
FULL = Settings(
    repeats=15,
    seconds=6.0,
    volprim=tuple((n, size) for n in PAGE.surfels for size in (128, 256, 512)),
    volprim_repeats=3,
    errors=tuple((n, size) for n in PAGE.surfels for size in (128, 256, 512)),
)
SMALL = Settings(
    surfels=(200, 2_000),
    sizes=(32, 64),
    spreads=(1.5,),
    repeats=3,
    seconds=0.1,
    volprim=((200, 32),),
    volprim_repeats=1,
    errors=((200, 32), (2_000, 64)),
    crop=16,
    memory=((200, 32),),
    compiled=(200, 32),
    step=(500, 32),
    steps=3,
    large_step=(500, 32),
    triad=1 << 20,
)
