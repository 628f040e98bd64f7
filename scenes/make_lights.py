"""Makes scenes/lights/*.exr, the environments of the example scenes: a photo studio, and an evening sky.

Run from the repository root: python scenes/make_lights.py

Every map is analytic, and lat-long in Mitsuba's `envmap` orientation (y up); the scenes turn it to z up.
Edges are blurred over about two degrees, the width that a 64 × 128 map can hold, so that a recovered light
can be compared with it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mi_refgs.io.exr import write_exr
from mi_refgs.io.images import box_downscale

HEIGHT = 128  # rows; twice as many columns
OVERSAMPLING = 4  # samples per texel and axis
EDGE = np.radians(2.0)  # width of a blurred edge

Vector = tuple[float, float, float]


def direction(azimuth: float, elevation: float) -> np.ndarray:
    """Unit vector, z up, from degrees."""
    a, e = np.radians([azimuth, elevation])
    return np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])


def step(distance: np.ndarray) -> np.ndarray:
    """Smooth 0 → 1 across an edge where `distance` (radians) crosses zero."""
    t = np.clip(distance / EDGE + 0.5, 0, 1)
    return t * t * (3 - 2 * t)


def tangent(d: np.ndarray, azimuth: float, elevation: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Angles (radians) right and up of a panel's centre, and whether a direction points to its side."""
    forward = direction(azimuth, elevation)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    depth = np.maximum(d @ forward, 1e-3)
    return np.arctan(d @ right / depth), np.arctan(d @ up / depth), (d @ forward > 0.1)


def panel(d: np.ndarray, azimuth: float, elevation: float, width: float, height: float) -> np.ndarray:
    """Coverage of a rectangular softbox, `width` × `height` degrees."""
    x, y, front = tangent(d, azimuth, elevation)
    w, h = np.radians([width, height]) / 2
    return step(w - np.abs(x)) * step(h - np.abs(y)) * front


def window(d: np.ndarray, azimuth: float, elevation: float, width: float, height: float) -> np.ndarray:
    """Coverage of a window of 3 × 2 panes."""
    x, y, _ = tangent(d, azimuth, elevation)
    bar = np.radians(1.6)
    third = np.radians(width) / 3
    bars = step(np.abs(np.abs(x) - third / 2) - bar) * step(np.abs(y) - bar)
    return panel(d, azimuth, elevation, width, height) * bars


def ring(d: np.ndarray, azimuth: float, elevation: float, inner: float, outer: float) -> np.ndarray:
    """Coverage of a ring light between two angles (degrees) around its centre."""
    angle = np.arccos(np.clip(d @ direction(azimuth, elevation), -1, 1))
    return step(angle - np.radians(inner)) * step(np.radians(outer) - angle)


def studio(d: np.ndarray) -> np.ndarray:
    """Radiance (…, 3) from unit directions (…, 3), z up."""
    z = d[..., 2]
    height = np.clip(z, 0, 1)[..., None]
    wall, ceiling = np.array([0.46, 0.39, 0.34]), np.array([0.10, 0.14, 0.22])
    radiance = wall + (ceiling - wall) * height**0.6

    # Floor: a checkerboard 1.4 below the centre that fades into the wall's colour towards the horizon.
    reach = 1.4 / np.maximum(-z, 0.02)
    x, y = (d[..., i] * reach for i in (0, 1))
    pattern = np.sin(np.pi * x / 1.3) * np.sin(np.pi * y / 1.3)
    tile = (0.5 + 0.5 * np.tanh(pattern / 0.15))[..., None]
    floor = tile * np.array([0.40, 0.33, 0.24]) + (1 - tile) * np.array([0.05, 0.06, 0.08])
    fade = np.clip((np.hypot(x, y) - 2.5) / 5, 0, 1)[..., None]
    floor = floor + (np.array([0.24, 0.21, 0.19]) - floor) * fade
    below = step(-np.arcsin(np.clip(z, -1, 1)))[..., None]
    radiance = radiance + (floor - radiance) * below

    def add(coverage: np.ndarray, colour: Vector) -> None:
        nonlocal radiance
        radiance = radiance + (np.array(colour) - radiance) * coverage[..., None]

    add(panel(d, 35, 48, 28, 20), (9.0, 8.3, 7.2))  # key softbox
    add(panel(d, 165, 30, 9, 40), (1.9, 2.3, 2.9))  # cool strip
    add(panel(d, 182, 30, 9, 40), (1.9, 2.3, 2.9))  # and its twin
    add(window(d, -70, 26, 52, 38), (0.85, 1.0, 1.2))
    add(ring(d, 250, 64, 7, 12), (4.0, 3.5, 2.7))
    for azimuth, colour in (
        (-15, (0.85, 0.10, 0.06)),
        (12, (0.90, 0.55, 0.05)),
        (70, (0.10, 0.50, 0.14)),
        (100, (0.06, 0.22, 0.80)),
        (128, (0.55, 0.08, 0.50)),
        (-130, (0.05, 0.45, 0.55)),
        (-160, (0.90, 0.80, 0.62)),
    ):
        add(panel(d, azimuth, 9, 17, 24), colour)
    return radiance


def sky(d: np.ndarray) -> np.ndarray:
    """Radiance (…, 3) of a clear evening from unit directions (…, 3), z up: low sun, clouds, hills, grass."""
    z = d[..., 2]
    azimuth = np.arctan2(d[..., 1], d[..., 0])
    height = np.clip(z, 0, 1)[..., None]
    horizon, zenith = np.array([0.95, 0.75, 0.55]), np.array([0.16, 0.30, 0.72])
    radiance = horizon + (zenith - horizon) * height**0.45
    cloud = np.sin(5 * azimuth + 4 * z) * np.sin(11 * z + 2 * np.cos(3 * azimuth))
    cover = (np.clip(cloud - 0.25, 0, 1) * np.clip(4 * z, 0, 1))[..., None]
    radiance = radiance + (np.array([1.3, 1.2, 1.15]) - radiance) * cover
    angle = np.arccos(np.clip(d @ direction(-50, 24), -1, 1))
    radiance = radiance + np.exp(-((angle / np.radians(14)) ** 2))[..., None] * np.array([1.6, 1.1, 0.6])
    sun = step(np.radians(4) - angle)[..., None]
    radiance = radiance + (np.array([60.0, 46.0, 30.0]) - radiance) * sun
    ridge = 0.07 + 0.04 * np.sin(3 * azimuth) + 0.02 * np.sin(7 * azimuth + 1)
    hills = step(ridge - np.arcsin(np.clip(z, -1, 1)))[..., None]
    radiance = radiance + (np.array([0.10, 0.13, 0.11]) - radiance) * hills
    grass = step(-np.arcsin(np.clip(z, -1, 1)))[..., None]
    meadow = (
        np.array([0.13, 0.19, 0.06]) * (1 + 0.35 * np.sin(9 * azimuth) * np.clip(-2 * z, 0, 1))[..., None]
    )
    return radiance + (meadow - radiance) * grass


def lat_long_directions(height: int) -> np.ndarray:
    """World directions (height, 2·height, 3), z up, of a map that a scene turns by +90° about x."""
    rows, columns = np.arange(height) + 0.5, np.arange(2 * height) + 0.5
    theta, phi = np.meshgrid(np.pi / height * rows, np.pi / height * columns, indexing="ij")
    x, y, z = np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi)
    return np.stack([x, -z, y], axis=-1)


def main() -> None:
    """Write the maps beside this script."""
    directions = lat_long_directions(HEIGHT * OVERSAMPLING)
    target = Path(__file__).parent / "lights"
    target.mkdir(exist_ok=True)
    for name, radiance in (("studio", studio), ("sky", sky)):
        write_exr(target / f"{name}.exr", box_downscale(radiance(directions), OVERSAMPLING), half=True)


if __name__ == "__main__":
    main()
