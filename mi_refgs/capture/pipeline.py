"""The capture pipeline: from photographs to a COLMAP data set with cameras, points and a region of interest.

The result of a step is named by the hash of its inputs and written atomically: a run that was interrupted, or
is repeated with other photographs or options, computes only what has changed.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.capture import colmap, output
from mi_refgs.capture.colmap import Solved
from mi_refgs.capture.frame import moved, upright_unit
from mi_refgs.capture.photographs import Photograph, cameras_of, find_masks, find_photographs, write_copies
from mi_refgs.data.colmap_model import MODELS
from mi_refgs.data.object_region import support_planes
from mi_refgs.data.region import Region, write_region
from mi_refgs.errors import InputError
from mi_refgs.io.files import read_json, replace_file, write_json
from mi_refgs.io.images import image_size, read_png

REPORT, PLOT = "capture.json", "capture.png"
VERSION = 2
"""Version of the steps' algorithms. Results of other versions are computed again."""

FIRST_MODEL = "SIMPLE_RADIAL"
"""Lens model with which images are registered by default; few matches determine its one parameter."""

SHOWN_RADII = 6.0
"""Half the width of the plot in radii of the region, unless the cameras need more; far points are cut off."""
LEAST_TILT = 0.3  # sine of the angle to a plot from which a plane is drawn in it
GOOD_ERROR = 1.0
"""Mean reprojection error, pixels, above which something is wrong: lens, rolling shutter, moving objects."""
FEW_FEATURES = 60
"""Smallest number of features in the median image: a pair needs 15 consistent matches, and a quarter of the
features is a good fraction."""
FLAT_CONTRAST = 0.04  # standard deviation of brightness, 0 … 1, below which an image is uniform
LEAST_PLACED = 0.5  # fraction of the photographs that must be registered in one group
TURN_SHARE = 0.8
"""Fraction of the matched pairs explained by a rotation or a plane from which the camera probably only
rotated."""
NAMED = 5  # largest number of photographs that a message names


@dataclass(frozen=True)
class CaptureJob:
    """Photographs and masks of a capture, its folders and options."""

    photographs: list[Photograph]
    masks: dict[str, Path]
    source: Path
    folder: Path
    camera: str | None

    @property
    def work(self) -> Path:
        return self.folder / output.WORK

    @property
    def copies(self) -> dict[str, Photograph]:
        """The photographs by the names of their working copies."""
        return {photograph.copy: photograph for photograph in self.photographs}

    def key(self, *more: Any) -> str:
        """A hash of the photographs, their orientation, and the other inputs of a step."""
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
) -> dict[str, Any]:
    """Reconstruct the cameras of the photographs in folder `source` and write the data set `folder`.

    `masks`: a folder as in `find_masks`. `camera`: COLMAP's name of the lens model, or None for the
    simplest of three that fits. `region`: of interest, in the data set's world, instead of the estimated one.
    `tell` is called with messages. Returns the content of capture.json.

    Raises InputError for unusable input, with the remedy, and without pycolmap.
    """
    # Photographs and options.
    colmap.load()
    if camera not in (None, *MODELS):
        raise InputError(f"--camera-model: {camera}: unknown lens model; give one of {', '.join(MODELS)}")
    photographs = find_photographs(source)
    job = CaptureJob(photographs, find_masks(masks, photographs), source, folder, camera)
    output.prepare(folder, [source] if masks is None else [source, masks])

    # Cameras of the largest group, transformed to an upright world.
    began = time.perf_counter()
    result = _solve(job, tell)
    model, groups = colmap.load().Reconstruction(result), read_json(result / "groups.json")["groups"]
    require_placed(source, len(photographs), groups, _beside_gap(job, groups[0]))
    straight = output.straighten(model, job.copies)
    solved = Solved.of(model)
    similarity = upright_unit(solved, np.array([job.copies[name].up for name in solved.names]))
    world = moved(solved, similarity)
    found = region or Region((0.0, 0.0, 0.0), 1.0, estimated=True)
    found = replace(found, planes=support_planes(world.points, world.origin, found))

    # Undistorted images and COLMAP's files, unless the last capture wrote the same.
    lenses = [(name, repr(straight[name])) for name in solved.names]
    key = job.key(lenses, _digests(sorted(result.glob("*.bin"))), _digests(job.masks.values()))
    if not output.is_complete(folder, key):
        made = job.work / f"output-{key}"
        for stale in {*job.work.glob("output-*")} - {made}:
            shutil.rmtree(stale)
        placed = [job.copies[name] for name in solved.names]
        output.write_images(placed, lambda p: straight[p.copy], job.masks, made)
        output.write_model(model, job.copies, straight, similarity, made / "sparse" / "0")
        output.replace_output(folder, made, key)
        shutil.rmtree(made)
    write_region(folder, found)
    draw(folder / PLOT, world, found)

    # The report.
    registered = {job.copies[name].name for name in world.names}
    cameras, pinholes = model.cameras.values(), {(s.size, s.focal): s for s in straight.values()}
    report = {
        "key": key,
        "photographs": len(photographs),
        "placed": len(registered),
        "not_placed": [p.name for p in photographs if p.name not in registered],
        "other_groups": [[job.copies[name].name for name in group] for group in groups[1:]],
        "points": len(world.points),
        "observations": int(world.length.sum()),
        "mean_track_length": float(world.length.mean()) if len(world.length) else 0.0,
        "mean_reprojection_error": float(model.compute_mean_reprojection_error()),
        "lens": {
            "model": next(iter(cameras)).model_name,
            "cameras": [{"width": c.width, "height": c.height, "parameters": [*c.params]} for c in cameras],
        },
        "pinholes": [{"size": s.size, "focal": s.focal, "centre": s.centre} for s in pinholes.values()],
        "region": found.content,
        "masks": bool(job.masks),
        "seconds": round(time.perf_counter() - began, 1),
    }
    write_json(folder / REPORT, report)
    return report


def _digests(files: Iterable[Path]) -> list[str]:
    """SHA-256 of files."""
    return [hashlib.sha256(path.read_bytes()).hexdigest() for path in files]


def _solve(job: CaptureJob, tell: Callable[[str], None]) -> Path:
    """The folder with the largest group's reconstruction and groups.json, the names in each group."""
    pycolmap = colmap.load()
    size, names = colmap.WORKING_SIZE, sorted(job.copies)
    images = job.work / f"pictures-{job.key(size)}"
    features = job.key(size, colmap.MOST_FEATURES, pycolmap.__version__, job.camera or FIRST_MODEL)
    database = job.work / f"features-{features}.db"
    result = job.work / f"model-{job.key(features, job.camera)}"
    if not result.is_dir():
        for path in job.work.iterdir():  # of other images or options
            if path != images and not path.name.startswith(database.stem):
                shutil.rmtree(path) if path.is_dir() else path.unlink()
        # Features.
        write_copies(job.photographs, images, size)
        if not database.is_file():
            colmap.begin(database, images, _groups(job, images))
        colmap.extract(database, images, names)
        found = colmap.features(database)
        require_features(job.source, [len(found[name]) for name in names], _contrast(images, names))
        # Matches.
        pairs = colmap.pairs_to_match(found)
        features_found = sum(map(len, found.values()))
        tell(f"{len(names)} photographs, {features_found} features, {len(pairs)} pairs to match")
        colmap.match(database, pairs)
        # Cameras and lens.
        raw = job.work / "unfinished"
        shutil.rmtree(raw, ignore_errors=True)
        models = colmap.reconstruct(database, images, raw, len(names))
        if not models:
            raise no_model(job.source, len(names), colmap.verified(database))
        best = models[0] if job.camera else colmap.best_lens(models[0])
        if job.camera:
            colmap.adjust(best)
        shutil.rmtree(raw)
        raw.mkdir()
        best.write_binary(raw)
        write_json(raw / "groups.json", {"groups": [Solved.of(model).names for model in models]})
        raw.rename(result)
    return result


def _groups(job: CaptureJob, images: Path) -> list[tuple[list[str], str, list[float]]]:
    """Images, lens model and initial parameters of each camera; none without a focal length in EXIF."""
    groups = []
    for photographs in cameras_of(job.photographs):
        copies = [photograph.copy for photograph in photographs]
        size = image_size(images / copies[0])
        focal, model = photographs[0].focal_pixels(size), job.camera or FIRST_MODEL
        parameters: list[float] = []
        if focal is not None:
            known = {"f": focal, "fx": focal, "fy": focal, "cx": size[0] / 2, "cy": size[1] / 2}
            parameters = [known.get(name, 0.0) for name in MODELS[model][1].split()]
        groups.append((copies, model, parameters))
    return groups


def _contrast(images: Path, names: Sequence[str]) -> float:
    """Median over images of the standard deviation of brightness, 0 … 1."""
    few = names[:: max(1, len(names) // 10)]
    return float(np.median([read_png(images / name).mean(axis=2).std() for name in few]))


def _beside_gap(job: CaptureJob, placed: Sequence[str]) -> str:
    """The first name at a boundary between registered photographs and others."""
    known = {job.copies[name].name for name in placed}
    names = [photograph.name for photograph in job.photographs]
    edges = [b for a, b in pairwise(names) if (a in known) != (b in known)]
    return edges[0] if edges else names[-1]


def report_text(c: dict[str, Any], folder: Path) -> str:
    """The content of capture.json as text."""
    lines = [
        f"{folder}: {c['placed']} of {c['photographs']} photographs placed, {c['points']} points, "
        f"each seen by {c['mean_track_length']:.1f} images on average; mean reprojection error "
        f"{c['mean_reprojection_error']:.2f} pixels; lens {c['lens']['model']}"
    ]
    if missing := c["not_placed"]:
        more = f" and {len(missing) - NAMED} more" if len(missing) > NAMED else ""
        names = ", ".join(missing[:NAMED]) + more
        lines.append(f"not placed: {names}; take more between them and the others")
    if c["mean_reprojection_error"] > GOOD_ERROR:
        lines.append("the error is high: something moved, or the lens needs another --camera-model")
    lines.append(f"look at {folder / PLOT}; next: refgs train {folder} -o runs/{folder.name}")
    return "\n".join(lines)


def draw(path: Path, world: Solved, region: Region) -> None:
    """Plot cameras, points and region from above and from the side."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Circle

    centre = np.array(region.centre)
    reach = float(np.abs(world.origin - centre).max())
    half = 1.1 * max(reach, min(SHOWN_RADII * region.radius, 2 * reach))
    near = world.points[(np.abs(world.points - centre) < half).all(axis=1)]
    directions = np.stack([world.origin, world.origin + half / 12 * world.axis])
    figure = Figure(figsize=(12, 6), layout="constrained")
    for axes, up, title in zip(figure.subplots(1, 2), (1, 2), ("from above", "from the side"), strict=True):
        axes.scatter(near[:, 0], near[:, up], s=0.5, c="0.5", linewidths=0)
        axes.plot(directions[..., 0], directions[..., up], color="C0", lw=0.8)
        axes.scatter(world.origin[:, 0], world.origin[:, up], s=8, color="C0")
        axes.add_patch(Circle((centre[0], centre[up]), region.radius, fill=False, color="C3", lw=1.5))
        for *normal, offset in region.planes:  # where they cut the plane of the plot through the centre
            across = np.array([normal[0], normal[up]])
            if (length := np.linalg.norm(across)) > LEAST_TILT:
                foot = centre[[0, up]] + (offset - centre @ normal) / length**2 * across
                axes.axline(foot, foot + np.array([-across[1], across[0]]), color="C3", lw=1.5)
        axes.set(title=title, xlabel="x", ylabel="xyz"[up], aspect="equal")
        axes.set(xlim=centre[0] + half * np.array([-1, 1]), ylim=centre[up] + half * np.array([-1, 1]))
    count = len(world.names)
    figure.suptitle(f"{count} cameras (blue), {len(world.points)} points, region of interest (red)")
    replace_file(path, lambda temporary: figure.savefig(temporary, dpi=100))


def require_features(folder: Path, counts: Sequence[int], contrast: float) -> None:
    """Raise InputError if the median image has hardly any features; `contrast`: its standard deviation."""
    median = int(np.median(counts))
    if median >= FEW_FEATURES:
        return
    if contrast < FLAT_CONTRAST:
        reason = "they are uniform"
        remedy = "put the object on a patterned ground, such as a newspaper,"
    else:
        reason = "they are blurred, or show hardly any texture"
        remedy = "hold still, use more light, put a patterned ground below the object,"
    raise InputError(
        f"{folder}: photographs: half of them have no more than {median} features: {reason}; "
        f"{remedy} and photograph it anew"
    )


def no_model(folder: Path, count: int, pairs: Sequence[tuple[str, str, int, bool]]) -> InputError:
    """The InputError if no pair of images can be the initial one; `pairs`: from `colmap.verified`."""
    if not pairs:
        reason = f"no two of the {count} show the same points"
        remedy = "take more, so close that each shows two thirds of the one before"
    elif np.mean([flat for *_, flat in pairs]) >= TURN_SHARE:
        reason = "they seem to be taken from one place, so nothing shows depth"
        remedy = "walk around the object instead of turning the camera"
    else:
        reason = f"of the {count}, no two with enough in common look from different enough sides"
        remedy = "take more on a circle around the object, 5° to 10° apart"
    return InputError(f"{folder}: photographs: {reason}; {remedy}")


def require_placed(folder: Path, count: int, groups: Sequence[Sequence[str]], longest_gap: str) -> None:
    """Raise InputError unless the largest group has half of the images; `longest_gap`: a boundary name."""
    if len(groups[0]) >= LEAST_PLACED * count:
        return
    apart = ", ".join(str(len(group)) for group in groups) + " images"
    if len(groups) > 1:
        apart = f"{len(groups)} groups that share nothing ({apart})"
    raise InputError(
        f"{folder}: photographs: of {count}, only {apart} could be placed; take images that lead from one "
        f"group to the next in small steps, as around {longest_gap}"
    )
