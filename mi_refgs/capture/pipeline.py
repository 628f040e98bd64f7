"""A whole capture: photographs in, a COLMAP data set with cameras, points and a region of interest out.

What a step makes has a name with the hash of all that went into it, and appears whole or not at all: a run
that was interrupted, or repeated with other pictures or options, does again only what has changed.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.capture import colmap, failure, output
from mi_refgs.capture.folder import WORK, holds, prepare, replace_output
from mi_refgs.capture.frame import moved, upright_unit
from mi_refgs.capture.masks import find_masks
from mi_refgs.capture.pairs import pairs_to_match
from mi_refgs.capture.photographs import Photograph, cameras_of, find_photographs, write_copies
from mi_refgs.capture.report import Report, draw
from mi_refgs.capture.solved import Solved, adjust, best_lens
from mi_refgs.data.colmap_model import MODELS
from mi_refgs.data.region import Region, write_region
from mi_refgs.errors import InputError
from mi_refgs.io.files import read_json, write_json

REPORT, PLOT = "capture.json", "capture.png"
VERSION = 2
"""Number of the algorithm of the steps. Results of another number are made anew."""

FIRST_MODEL = "SIMPLE_RADIAL"
"""Lens model with which pictures are placed where none is asked for. It has one parameter, which few matches
determine."""


@dataclass(frozen=True)
class Job:
    """What is captured, and where to."""

    photographs: list[Photograph]
    masks: dict[str, Path]
    source: Path
    folder: Path
    camera: str | None

    @property
    def work(self) -> Path:
        return self.folder / WORK

    @property
    def copies(self) -> dict[str, Photograph]:
        """The photographs by the names of their working copies."""
        return {photograph.copy: photograph for photograph in self.photographs}

    def key(self, *more: Any) -> str:
        """A hash of the photographs, how they lie, and what else a step depends on."""
        parts = [VERSION, [(p.name, p.digest, p.lying) for p in self.photographs], *more]
        return hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:12]


def capture(
    source: Path,
    folder: Path,
    *,
    masks: Path | None = None,
    camera: str | None = None,
    region: Region | None = None,
    tell: Callable[[str], None] = lambda _: None,
) -> Report:
    """Place the photographs of folder `source` and write the data set `folder`.

    `masks`: a folder as in `find_masks`. `camera`: COLMAP's name of the lens model, or None for the
    simplest of three that fits. `region`: of interest, in the data set's world, in place of the one that is
    found. `tell` is called with what is done.

    Raises InputError for unusable input, with the remedy, and where pycolmap is missing.
    """
    colmap.load()
    if camera not in (None, *MODELS):
        raise InputError(f"--camera: {camera}: unknown lens model; give one of {', '.join(MODELS)}")
    photographs = find_photographs(source)
    job = Job(photographs, find_masks(masks, photographs), source, folder, camera)
    prepare(folder, [source] if masks is None else [source, masks])
    began = time.perf_counter()
    result = _solve(job, tell)
    model, groups = colmap.load().Reconstruction(result), read_json(result / "groups.json")["groups"]
    failure.check_placed(source, len(photographs), groups, _beside_gap(job, groups[0]))
    straight = output.straighten(model, job.copies)
    solved = Solved.of(model)
    similarity = upright_unit(solved, np.array([job.copies[name].up for name in solved.names]))
    world = moved(solved, similarity)
    found = region or Region((0.0, 0.0, 0.0), 1.0)
    lenses = [(name, repr(straight[name])) for name in solved.names]
    key = job.key(lenses, _digests(sorted(result.glob("*.bin"))), _digests(job.masks.values()))
    if not holds(folder, key):
        made = job.work / f"output-{key}"
        for stale in {*job.work.glob("output-*")} - {made}:
            shutil.rmtree(stale)
        placed = [job.copies[name] for name in solved.names]
        write = colmap.progress("undistorted")
        output.write_pictures(placed, lambda p: straight[p.copy], job.masks, made, write)
        output.write_model(model, job.copies, straight, similarity, made / "sparse" / "0")
        replace_output(folder, made, key)
        shutil.rmtree(made)
    write_region(folder, found)
    report = Report.of(job, model, world, groups, straight, found, key, time.perf_counter() - began)
    draw(folder / PLOT, world, found)
    write_json(folder / REPORT, report.content)
    return report


def _digests(files: Iterable[Path]) -> list[str]:
    """SHA-256 of files."""
    return [hashlib.sha256(path.read_bytes()).hexdigest() for path in files]


def _solve(job: Job, tell: Callable[[str], None]) -> Path:
    """The folder of the largest group's reconstruction, its lens decided, and groups.json: names in each."""
    pycolmap = colmap.load()
    size, names = colmap.WORKING_SIZE, sorted(job.copies)
    pictures = job.work / f"pictures-{job.key(size)}"
    features = job.key(size, colmap.MOST_FEATURES, pycolmap.__version__, _first_model(job))
    database, result = (
        job.work / f"features-{features}.db",
        job.work / f"model-{job.key(features, job.camera)}",
    )
    if not result.is_dir():
        for path in job.work.iterdir():  # of other pictures or options
            if path != pictures and not path.name.startswith(database.stem):
                shutil.rmtree(path) if path.is_dir() else path.unlink()
        write_copies(job.photographs, pictures, size, colmap.progress("pictures"))
        if not database.is_file():
            colmap.begin(database, pictures, _groups(job, pictures))
        colmap.extract(database, pictures, names)
        found = colmap.features(database)
        failure.check_features(job.source, [len(found[name]) for name in names], _contrast(pictures, names))
        pairs = pairs_to_match(found)
        tell(
            f"{len(names)} photographs, {sum(map(len, found.values()))} features, {len(pairs)} pairs to match"
        )
        colmap.match(database, pairs)
        raw = job.work / "unfinished"
        shutil.rmtree(raw, ignore_errors=True)
        models = colmap.reconstruct(database, pictures, raw, len(names))
        if not models:
            raise failure.no_model(job.source, len(names), colmap.verified(database))
        groups = [Solved.of(model).names for model in models]
        best = models[0]
        if job.camera is None:
            best = best_lens(best)
        else:
            adjust(best)
        shutil.rmtree(raw)
        raw.mkdir()
        best.write_binary(raw)
        write_json(raw / "groups.json", {"groups": groups})
        raw.rename(result)
    return result


def _first_model(job: Job) -> str:
    return job.camera or FIRST_MODEL


def _groups(job: Job, pictures: Path) -> list[tuple[list[str], str, list[float]]]:
    """Pictures, lens model and first parameters of each camera; no parameters where EXIF tells no focal
    length."""
    from mi_refgs.io.images import image_size

    groups = []
    for photographs in cameras_of(job.photographs):
        copies = [photograph.copy for photograph in photographs]
        size = image_size(pictures / copies[0])
        focal, model = photographs[0].focal_pixels(size), _first_model(job)
        parameters: list[float] = []
        if focal is not None:
            known = {"f": focal, "fx": focal, "fy": focal, "cx": size[0] / 2, "cy": size[1] / 2}
            parameters = [known.get(name, 0.0) for name in MODELS[model][1].split()]
        groups.append((copies, model, parameters))
    return groups


def _contrast(pictures: Path, names: Sequence[str]) -> float:
    """Standard deviation of brightness, 0 … 1, of the median picture."""
    from mi_refgs.io.images import read_png

    few = names[:: max(1, len(names) // 10)]
    return float(np.median([read_png(pictures / name).mean(axis=2).std() for name in few]))


def _beside_gap(job: Job, placed: Sequence[str]) -> str:
    """The first photograph that was not placed next to one that was."""
    known = {job.copies[name].name for name in placed}
    names = [photograph.name for photograph in job.photographs]
    edges = [b for a, b in pairwise(names) if (a in known) != (b in known)]
    return edges[0] if edges else names[-1]
