"""Readers of data sets behind one interface: a folder in, views and what is known of the scene out.

A new layout is one file with a `Reader`, and its `register`; which reader serves a folder is found by asking
each in turn.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, TypeVar

import numpy as np

from mi_refgs.data.view import View
from mi_refgs.errors import InputError

HOLDOUT = 8
"""Every eighth picture is a test view where a data set names none (LLFF's habit, kept by 3DGS and 2DGS)."""

Item = TypeVar("Item")


@dataclass(frozen=True)
class ReadOptions:
    """How pictures are wanted."""

    downscale: int = 1  # pixels of a file along a pixel's side
    background: float = 1.0  # 0 … 1, in the space of the pictures, behind their alpha
    images: str = "png"  # "png": as displayed, or "exr": linear radiance
    truth: bool = True  # with normals, depth and materials where there are any
    decode: bool = True  # pictures at once, while there is room; else when they are asked for


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points on what is seen, as structure from motion finds them."""

    position: np.ndarray  # (P, 3) float64, world
    colour: np.ndarray | None = None  # (P, 3) linear, 0 … 1


@dataclass(frozen=True, eq=False)
class Recording:
    """What a reader finds: the views of one split, and what is known of their scene."""

    views: tuple[View, ...]
    points: PointCloud | None = None
    environment: Path | None = None  # ground truth of the light: lat-long EXR in Mitsuba's orientation
    source: Path | None = None  # the file that lists the views, for messages
    notes: tuple[str, ...] = ()  # what a person may want to mend, such as pictures without a camera


class Reader(Protocol):
    """One layout of data sets."""

    name: str
    looks_for: str
    """What makes it recognise a folder, for messages."""

    def recognises(self, folder: Path) -> bool:
        """Whether this folder has the layout."""

    def size(self, folder: Path, images: str) -> tuple[int, int]:
        """Width and height of the first training picture as it lies in its file."""

    def read(self, folder: Path, split: str, options: ReadOptions) -> Recording:
        """The views of "train" or "test"; raises InputError that names file, field and remedy."""


READERS: list[Reader] = []
"""Every reader, in the order in which they are asked."""


def register(reader: Reader) -> None:
    """Let a reader be asked for folders, before those that are there."""
    READERS.insert(0, reader)


def unregister(reader: Reader) -> None:
    """Ask a registered reader no more."""
    READERS.remove(reader)


def reader_of(folder: Path) -> Reader:
    """The reader of a folder; raises InputError if there is no such folder, or none recognises it."""
    if not folder.is_dir():
        raise InputError(f"{folder}: data set: no such folder; give one that holds pictures and cameras")
    for reader in READERS:
        if reader.recognises(folder):
            return reader
    known = "; ".join(f"{reader.name}: {reader.looks_for}" for reader in READERS)
    raise InputError(f"{folder}: data set: no layout is recognised; complete it ({known})")


def held_out(ordered: Sequence[Item], split: str) -> list[Item]:
    """The items of a split where one list holds both: every eighth, from the first, is a test view."""
    return [item for i, item in enumerate(ordered) if (i % HOLDOUT == 0) == (split == "test")]
