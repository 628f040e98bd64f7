"""Gains that photographs tell before a fit: by EXIF data, and by points that several of them show."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mi_refgs.data.exposure import SEEN, told_gains
from mi_refgs.data.images import Pixels
from mi_refgs.data.view import FileCamera, View
from mi_refgs.io.images import srgb_from_linear
from mi_refgs.reference.camera import look_at
from tests.helpers import unit

VIEWS, POINTS, SIZE = 8, 150, 96


def taken(log: np.ndarray, rng: np.random.Generator) -> list[View]:
    """Views of coloured points, with log gains (V, 3); each tenth glitters, and some hide others."""
    points, colours = rng.uniform(-0.5, 0.5, (POINTS, 3)), rng.uniform(0.05, 0.5, (POINTS, 3))
    tracks, pinhole, views = np.pad(points, ((0, 0), (2, 0))), (115.0, 115.0, SIZE / 2, SIZE / 2), []
    for gain, origin in zip(np.exp(log), unit(rng.normal(size=(VIEWS, 3))), strict=True):
        image = np.full((SIZE, SIZE, 3), 0.5, np.float32)
        view = View("a", SIZE, SIZE, *pinhole, look_at(3 * origin, np.zeros(3)), Pixels(image), tracks=tracks)
        glitter = np.where(rng.random((POINTS, 1)) < 0.1, 3, 1)
        for row, column, colour in zip(*view.project(points)[:2], colours * glitter, strict=True):
            patch = slice(round(row) - 1, round(row) + 2), slice(round(column) - 1, round(column) + 2)
            image[patch] = np.clip(srgb_from_linear(colour * gain), 0, 1)
        views.append(view)
    return views


def with_exif(views: list[View], log: np.ndarray, folder: Path, iso: float = 100, f: float = 2) -> list[View]:
    """The views with files whose EXIF data have log gains (V,)."""
    found = []
    for i, (view, time) in enumerate(zip(views, 0.01 * np.exp(log), strict=True)):
        exif, path = Image.Exif(), folder / f"{i}.jpg"
        exif[0x8769] = {0x829A: float(time), 0x829D: float(f), 0x8827: iso}
        Image.new("RGB", (SIZE, SIZE)).save(path, exif=exif)
        found.append(replace(view, file=FileCamera(path, SIZE, SIZE, (1.0, 1.0, 0.0, 0.0))))
    return found


@pytest.fixture
def log(rng: np.random.Generator) -> np.ndarray:
    """Log gains (V, 3): exposure, and a fifth of it white balance."""
    gains = rng.normal(size=(VIEWS, 1)) + 0.2 * rng.normal(size=(VIEWS, 3))
    return np.asarray(2 * SEEN * gains / gains.std())


def test_gains_are_those_of_the_points(log: np.ndarray, rng: np.random.Generator) -> None:
    np.testing.assert_allclose(np.asarray(told_gains(taken(log, rng))), log - log.mean(axis=0), atol=0.03)
    assert told_gains(taken(0.3 * log, rng)) is None  # surfaces that shine would seem to change as much
    bare = [replace(view, tracks=None) for view in taken(log, rng)]
    assert told_gains(bare) is None and told_gains([*bare[:1], *taken(log, rng)[1:]]) is None
    white = [replace(view, pixels=Pixels(np.ones_like(view.image))) for view in taken(0 * log, rng)]
    assert told_gains([*white[:1], *taken(0 * log, rng)[1:]]) is None  # it shows no colour of a point


def test_gains_in_exif_count_unless_points_contradict(
    log: np.ndarray, rng: np.random.Generator, tmp_path: Path
) -> None:
    grey, views = log[:, 0], taken(np.repeat(log[:, :1], 3, axis=1), rng)
    written, expected = with_exif(views, grey, tmp_path), grey[:, None] - grey.mean()
    for given in (written, [replace(view, tracks=None) for view in written]):
        np.testing.assert_allclose(np.asarray(told_gains(given)), np.tile(expected, 3), atol=1e-3)
    for exif in (-grey, np.zeros(VIEWS)):
        np.testing.assert_allclose(told_gains(with_exif(views, exif, tmp_path)), told_gains(views))  # type: ignore[arg-type]
    bare = [replace(view, tracks=None) for view in views]
    assert told_gains(with_exif(bare, grey, tmp_path, iso=0)) is None  # nobody knows
    manual = np.asarray(told_gains(with_exif(bare, grey, tmp_path, f=0)))  # a lens without contacts
    np.testing.assert_allclose(manual, np.tile(expected, 3), atol=1e-3)
    assert told_gains(with_exif(bare, 0.02 * grey, tmp_path)) is None
