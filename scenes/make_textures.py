"""Makes scenes/textures/*.png, the printed surfaces of the rooms: wood, cloth, paper, posters, tiles, a can.

Run from the repository root: python scenes/make_textures.py

Every texture is drawn from a seed. None but the tiles repeats itself, so that images of the room can be
matched by what they show.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from scipy.ndimage import gaussian_filter, map_coordinates

PALETTE = 48
"""Colours a file: few enough for small files, enough for soft shades."""


def noise(rng: np.random.Generator, shape: tuple[int, int], scale: tuple[float, float]) -> np.ndarray:
    """Smooth noise (rows, columns) of standard deviation 1; `scale` is its size in pixels along both axes."""
    field = gaussian_filter(rng.normal(size=shape), scale, mode="wrap")
    return field / field.std()


def mix(a: np.ndarray | tuple[float, ...], b: tuple[float, ...], share: np.ndarray) -> np.ndarray:
    """Colours from a to b (…, 3) by a share in 0 … 1."""
    weight = np.clip(share, 0, 1)[..., None]
    return np.array(a) * (1 - weight) + np.array(b) * weight


def wood(rng: np.random.Generator, size: int = 768, planks: int = 6) -> np.ndarray:
    """Planks along x, each with grain, knots and a tone of its own."""
    rows, columns = np.mgrid[:size, :size]
    plank = rows * planks // size
    warp = 9 * noise(rng, (size, size), (26, 60)) + 260 * rng.random(planks)[plank]
    grain = np.sin((rows + warp) * 0.21) + 0.6 * noise(rng, (size, size), (0.8, 18))
    tone = rng.uniform(-0.25, 0.25, planks)[plank] + 0.12 * noise(rng, (size, size), (40, 90))
    colour = mix((0.58, 0.40, 0.24), (0.32, 0.19, 0.10), 0.45 + 0.18 * grain + tone)
    for _ in range(14):
        y, x, r = *rng.uniform(0, size, 2), rng.uniform(5, 13)
        distance = np.hypot((rows - y) * 1.6, columns - x) / r
        colour = mix(colour, (0.16, 0.09, 0.05), np.exp(-(distance**2)) * (0.7 + 0.3 * np.cos(9 * distance)))
    seam = np.abs((rows * planks / size) % 1 - 0.5) > 0.5 - 1.2 * planks / size
    return mix(colour, (0.10, 0.06, 0.04), seam.astype(float))


def collage(
    rng: np.random.Generator, ground: tuple[float, ...], shapes: int, largest: float, size: int
) -> np.ndarray:
    """Discs, bars and rings of random colours over each other; `largest` as part of the side."""
    rows, columns = np.mgrid[:size, :size]
    colour = np.ones((size, size, 3)) * ground
    for _ in range(shapes):
        y, x, r = *rng.uniform(0, size, 2), size * largest * rng.uniform(0.2, 1) ** 2
        angle = rng.uniform(0, np.pi)
        u = (columns - x) * np.cos(angle) + (rows - y) * np.sin(angle)
        v = (rows - y) * np.cos(angle) - (columns - x) * np.sin(angle)
        outline = [
            np.hypot(u, v) - r,
            np.maximum(abs(u) - r, abs(v) - 0.3 * r),
            abs(np.hypot(u, v) - r) - 0.15 * r,
        ]
        paint = tuple(rng.uniform(0.03, 0.9, 3))
        colour = mix(colour, paint, 0.5 - outline[rng.integers(3)])
    return colour


def cloth(rng: np.random.Generator, size: int = 512) -> np.ndarray:
    """A printed cloth: a warped check with a border and shapes."""
    rows, columns = np.mgrid[:size, :size]
    at = np.stack([rows, columns]) + 3 * np.stack([noise(rng, (size, size), (30, 30)) for _ in "xy"])
    check = ((at[0] // 32 + at[1] // 32) % 2).astype(float)
    pattern = collage(rng, (0.72, 0.66, 0.52), 260, 0.05, size)
    soft = gaussian_filter(check, 1)
    colour = pattern * (0.62 + 0.38 * soft[..., None])
    edge = np.minimum(np.minimum(rows, size - 1 - rows), np.minimum(columns, size - 1 - columns))
    return mix(colour, (0.35, 0.05, 0.06), ((edge > 14) & (edge < 30)).astype(float))


def paper(rng: np.random.Generator, size: int = 512) -> np.ndarray:
    """Wallpaper: pale stripes with stains and small prints."""
    stripes = np.sin(np.arange(size) * 2 * np.pi / 24 + 0.6 * noise(rng, (size, size), (60, 8)))
    base = mix(
        (0.74, 0.70, 0.58), (0.55, 0.60, 0.55), 0.5 + 0.3 * stripes + 0.2 * noise(rng, (size, size), (50, 50))
    )
    prints = collage(rng, (1.0, 1.0, 1.0), 420, 0.03, size)
    return base * (0.35 + 0.65 * prints)


def tiles(rng: np.random.Generator, size: int = 512, count: int = 4) -> np.ndarray:
    """Bright tiles of slightly different tones with thin grey grout, which continue at the edges."""
    rows, columns = np.mgrid[:size, :size]
    tone = rng.normal(0, 0.012, (count, count, 1)) + rng.normal(0, 0.004, (count, count, 3))
    colour = np.array([0.90, 0.89, 0.86]) + tone[rows * count // size, columns * count // size]
    colour += 0.006 * noise(rng, (size, size), (9, 9))[..., None]
    grout = np.abs(np.stack([rows, columns]) * count / size % 1 - 0.5).max(axis=0) > 0.487
    return mix(colour, (0.56, 0.54, 0.50), grout.astype(float))


def can_label(rng: np.random.Generator, height: int = 256) -> tuple[np.ndarray, np.ndarray]:
    """Colour and metallic (rows, columns, 3) of a can's wall: metal under ink, none under white."""
    width = 2 * height
    rows, columns = np.mgrid[:height, :width]
    angle, v = columns * 2 * np.pi / width, rows / height
    colour = mix((0.05, 0.20, 0.55), (0.02, 0.07, 0.30), v)
    wave = v - 0.55 + 0.14 * np.cos(2 * angle)
    white = (np.abs(wave) < 0.1).astype(float)
    colour = mix(colour, (0.85, 0.62, 0.20), (np.abs(wave - 0.16) < 0.025).astype(float))
    for _ in range(46):  # drops
        y, x, r = rng.uniform(0.06, 0.94), rng.uniform(0, width), rng.uniform(0.008, 0.03) * height
        across = (columns - x + width / 2) % width - width / 2
        colour = mix(colour, (0.55, 0.75, 0.92), 0.8 * np.clip(r - np.hypot(rows - y * height, across), 0, 1))
    paint = Image.new("L", (width, height))
    draw = ImageDraw.Draw(paint)
    for x in (0.25, 0.75):
        draw.text((x * width, 0.26 * height), "LUMEN", 255, ImageFont.load_default(48), anchor="mm")
    for i in range(9):  # ingredients
        top, end = (0.74 + 0.02 * i) * height, (0.50 + 0.06 * rng.random()) * width
        draw.rectangle((0.45 * width, top, end, top + 0.01 * height - 1), fill=255)
    white = np.maximum(white, np.asarray(paint) / 255)
    return mix(colour, (0.88, 0.87, 0.84), white), 1 - np.repeat(white[..., None], 3, axis=-1)


def bent(rng: np.random.Generator, image: np.ndarray, reach: float) -> np.ndarray:
    """An image with its lines bent by up to about `reach` pixels."""
    size = image.shape[0]
    rows, columns = np.mgrid[:size, :size]
    moved = [a + reach * noise(rng, (size, size), (40, 40)) for a in (rows, columns)]
    planes = [map_coordinates(plane, moved, order=1, mode="wrap") for plane in np.moveaxis(image, -1, 0)]
    return np.stack(planes, axis=-1)


def main() -> None:
    """Write the textures beside this script."""
    target = Path(__file__).parent / "textures"
    target.mkdir(exist_ok=True)
    rng = np.random.default_rng(7)
    textures = {
        "wood": wood(rng),
        "cloth": cloth(rng),
        "rug": bent(rng, collage(rng, (0.30, 0.10, 0.09), 700, 0.08, 512), 4),
        "paper": paper(rng),
        "poster_a": collage(rng, (0.85, 0.83, 0.76), 90, 0.22, 256),
        "poster_b": collage(rng, (0.10, 0.16, 0.30), 120, 0.18, 256),
        "books": np.repeat(
            mix(rng.uniform(0.05, 0.75, (1, 48, 3)), (0.02, 0.02, 0.02), rng.random((32, 48)) ** 6), 8, 0
        ),
    }
    rng = np.random.default_rng(8)
    textures["tiles"] = tiles(rng)
    textures["can_label"], textures["can_metallic"] = can_label(rng)
    for name, colour in textures.items():
        wide = np.repeat(colour, 6, axis=1) if name == "books" else colour
        image = Image.fromarray((255 * np.clip(wide, 0, 1)).astype(np.uint8))
        image.quantize(PALETTE, dither=Image.Dither.NONE).convert("P").save(
            target / f"{name}.png", optimize=True
        )


if __name__ == "__main__":
    main()
