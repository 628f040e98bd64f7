"""The capture pipeline: from photographs to a COLMAP data set with cameras, points and a region of interest.
The folder `.work` contains the results of steps, and the hash of their inputs: an interrupted run goes on,
and other photographs or options begin anew."""

import hashlib
import itertools
import json
import shutil
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.capture import colmap, output
from mi_refgs.capture.colmap import Solved, pycolmap
from mi_refgs.capture.frame import upright_unit
from mi_refgs.capture.output import MASKS, SPARSE
from mi_refgs.capture.photographs import REPORT, WORK, Photograph, find_masks, find_photographs
from mi_refgs.data.colmap_model import MODELS
from mi_refgs.data.images import MASK
from mi_refgs.data.object_region import support_planes
from mi_refgs.data.region import REGION_FILE, Region, read_region, write_region
from mi_refgs.errors import InputError, counted
from mi_refgs.io.files import read_json, replace_file, write_json
from mi_refgs.io.images import image_header
from mi_refgs.io.progress import Tell, command_line, with_bar

PLOT, OLD_REGION = "capture.png", "region.old.json"
OLD_MASKS = "oldmasks"  # a name that no reader takes for masks
VERSION = 3  # of the steps' algorithms; results of other versions are computed again
FIRST_MODEL = "SIMPLE_RADIAL"  # lens with which images are registered: few matches determine its parameter
LEAST_PLACED = 0.5  # fraction of the photographs that must be registered in one group
NAMED = 5  # largest number of photographs that a message names


def capture(
    source: Path,
    folder: Path,
    *,
    masks: Path | None = None,
    camera: str | None = None,
    region: Region | None = None,
    tell: Tell = lambda _: None,
) -> dict[str, Any]:
    """Reconstruct the cameras of the photographs in folder `source` and write the data set `folder`.
    `camera`: COLMAP's lens model, or None for the simplest of three that fits. `region`: in the data set's
    world, by default what a user saved there, else estimated. Returns the content of capture.json. Raises
    InputError for unusable input, and without pycolmap."""
    # Photographs and options.
    version = VERSION, pycolmap.__version__
    if camera not in (None, *MODELS):
        remedy = f"give one of {', '.join(MODELS)}"
        raise InputError(f"{camera}: unknown lens model", "--camera-model", remedy=remedy)
    photographs = find_photographs(source, tell)
    mask_files = {} if masks is None else find_masks(masks, photographs)
    if masks is None and (cut_out := {p.name: p.path for p in photographs if p.cut_out}):
        mask_files = cut_out if len(cut_out) == len(photographs) else {}
        use = "are masks" if mask_files else "are not used; cut out all of them, or give --masks"
        tell(f"transparent pixels of {len(cut_out)} of {len(photographs)} images {use}")
    if masks is None and (ignored := [path for path in source.glob("*/") if MASK.search(path.name)]):
        tell(f"not used: {ignored[0]}; --masks {ignored[0]} would read masks there")
    output.prepare(folder, [source] if masks is None else [source, masks])
    inputs = [*version, camera, [(p.name, p.digest, p.lying) for p in photographs]]
    copies = {photograph.copy: photograph for photograph in photographs}
    # Cameras of the largest group, transformed to an upright world.
    work, given = folder / WORK, _hash(inputs)
    mark, drawn = work / "key", read_region(folder)
    known = mark.is_file() and mark.read_text() == given
    if region is None and drawn is not None and not drawn.estimated:  # a user's, of the last capture's world
        region = drawn if known else None
        if not known:
            _set_aside(folder / REGION_FILE, OLD_REGION, "cameras", tell)
    if not known:
        shutil.rmtree(work)
        work.mkdir()
        mark.write_text(given)
    if not (work / "model").is_dir():
        try:
            _solve(source, work, copies, camera, tell)
        except RuntimeError as error:  # of COLMAP, as on a full disk
            raise InputError(f"COLMAP: {error}", work, remedy="free some space, or remove it") from error
    model = pycolmap.Reconstruction(work / "model")
    straight = output.straighten(model, copies)
    solved = Solved.of(model)
    scale, rotation, shift = upright_unit(solved, np.array([copies[name].up for name in solved.names]))
    model.transform(pycolmap.Sim3d(scale, pycolmap.Rotation3d(rotation), shift))
    world = Solved.of(model)
    found = region or Region((0.0, 0.0, 0.0), 1.0, estimated=True)
    if region is None or region != drawn:
        found = replace(found, planes=support_planes(world.points, world.origin, found))
    # Undistorted images and COLMAP's files, unless the last capture wrote the same.
    mask_digests = [hashlib.sha256(path.read_bytes()).hexdigest() for path in mask_files.values()]
    key, last = _hash([inputs, repr(straight), mask_digests]), folder / REPORT
    if not last.is_file() or read_json(last).get("key") != key:
        if (folder / MASKS).is_dir():  # a user's, or corrected by one
            _set_aside(folder / MASKS, OLD_MASKS, "images", tell)
        for stale in (*folder.glob(f"{SPARSE}/*.bin"), last):  # without them the folder is no data set
            stale.unlink(missing_ok=True)
        output.write_images([copies[name] for name in solved.names], straight, mask_files, folder)
        output.write_model(model, copies, straight, folder / SPARSE)
    write_region(folder, found)
    draw(folder / PLOT, world, found)
    registered = {copies[name].name for name in world.names}
    cameras = model.cameras.values()
    report = {
        "key": key,
        "photographs": len(photographs),
        "placed": len(registered),
        "not_placed": [p.name for p in photographs if p.name not in registered],
        "points": len(world.points),
        "mean_track_length": float(world.length.mean()) if len(world.length) else 0.0,
        "mean_reprojection_error": float(model.compute_mean_reprojection_error()),
        "lens": {
            "model": next(iter(cameras)).model_name,
            "cameras": [{"width": c.width, "height": c.height, "parameters": [*c.params]} for c in cameras],
        },
        "region": found.content,
    }
    write_json(last, report)
    return report


def _set_aside(path: Path, old: str, of: str, tell: Tell) -> None:
    """Rename what a user made for cameras or images that are replaced: `old`, or a numbered name like it."""
    wanted = path.with_name(old)
    places = (wanted.with_stem(f"{wanted.stem}{i or ''}") for i in itertools.count())
    place = path.rename(next(other for other in places if not other.exists()))
    tell(f"{path}: moved to {place.name}, as its {of} are replaced")


def _hash(inputs: list[Any]) -> str:
    return hashlib.sha256(json.dumps(inputs).encode()).hexdigest()[:12]


def _solve(source: Path, work: Path, copies: dict[str, Photograph], camera: str | None, tell: Tell) -> None:
    """Write work/model: the reconstruction of the largest group."""
    images, database, names = work / "pictures", work / "features.db", sorted(copies)
    # Features of working copies.
    images.mkdir(exist_ok=True)
    for name, photograph in with_bar([*copies.items()], "images"):
        if not (images / name).is_file():
            image = photograph.load(colmap.WORKING_SIZE)
            replace_file(images / name, partial(image.save, format="PNG", compress_level=1))
    if not database.is_file():
        colmap.begin(database, images, _groups([*copies.values()], images, camera or FIRST_MODEL))
    colmap.extract(database, images, names)
    found = colmap.features(database)
    counts = [len(found[name]) for name in names]
    if (median := int(np.median(counts))) < 60:  # a pair needs 15 consistent matches, a good quarter
        what = f"half of them have no more than {median} features: they are blurred, or without texture"
        remedy = "hold still, use more light, put a patterned ground below the object"
        raise InputError(what, source, "photographs", remedy)
    # Matches.
    pairs = colmap.pairs_to_match(found)
    tell(f"{len(names)} photographs, {sum(counts)} features, {len(pairs)} pairs to match")
    colmap.match(database, pairs)
    # Cameras and lens.
    raw = work / "unfinished"
    shutil.rmtree(raw, ignore_errors=True)
    models = colmap.reconstruct(database, images, raw, len(names))
    require_placed(source, len(names), [model.num_reg_images() for model in models])
    best = (colmap.adjust if camera else colmap.best_lens)(models[0])
    shutil.rmtree(raw)
    raw.mkdir()
    colmap.write(best, raw)
    raw.rename(work / "model")


def _groups(
    photographs: Sequence[Photograph], images: Path, model: str
) -> list[tuple[list[str], str, list[float]]]:
    """Images, lens model and, with EXIF data, parameters per camera: of one size, device, focal length."""
    cameras: dict[Any, list[Photograph]] = {}
    for photograph in photographs:
        cameras.setdefault((photograph.kept_size, photograph.device, photograph.focal), []).append(photograph)
    groups = []
    for group in cameras.values():
        size = image_header(images / group[0].copy)[:2]
        focal, parameters = group[0].focal, list[float]()
        if focal is not None:
            pixels = focal * float(np.hypot(*size))
            known = {"f": pixels, "fx": pixels, "fy": pixels, "cx": size[0] / 2, "cy": size[1] / 2}
            parameters = [known.get(name, 0.0) for name in MODELS[model][1].split()]
        groups.append(([photograph.copy for photograph in group], model, parameters))
    return groups


def report_text(c: dict[str, Any], folder: Path) -> str:
    """The content of capture.json as text."""
    lines = [
        f"{folder}: {c['placed']} of {c['photographs']} photographs placed, {c['points']} points, "
        f"each seen by {c['mean_track_length']:.1f} images on average; mean reprojection error "
        f"{c['mean_reprojection_error']:.2f} pixels; lens {c['lens']['model']}"
    ]
    if missing := c["not_placed"]:
        more = f" and {len(missing) - NAMED} more" if len(missing) > NAMED else ""
        lines.append(f"not placed: {', '.join(missing[:NAMED])}{more}; take more between them and the others")
    if c["mean_reprojection_error"] > 1:  # pixel: lens, rolling shutter or scene are wrong
        lines.append("the error is high: something moved, or the lens needs another --camera-model")
    train = command_line("train", folder, "-o", f"runs/{folder.name}")
    return "\n".join([*lines, f"look at {folder / PLOT}; next: {train}"])


def draw(path: Path, world: Solved, region: Region) -> None:
    """Plot cameras, points and region from above and from the side."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Circle

    centre = np.array(region.centre)
    reach = float(np.abs(world.origin - centre).max())
    half = 1.1 * max(reach, min(6 * region.radius, 2 * reach))
    near = world.points[(np.abs(world.points - centre) < half).all(axis=1)]
    directions = np.stack([world.origin, world.origin + half / 12 * world.axis])
    figure = Figure(figsize=(12, 6), layout="constrained")
    for axes, up, title in zip(figure.subplots(1, 2), (1, 2), ("from above", "from the side"), strict=True):
        axes.scatter(near[:, 0], near[:, up], s=0.5, c="0.5", linewidths=0)
        axes.plot(directions[..., 0], directions[..., up], color="C0", lw=0.8)
        axes.scatter(world.origin[:, 0], world.origin[:, up], s=8, color="C0")
        axes.add_patch(Circle((centre[0], centre[up]), region.radius, fill=False, color="C3", lw=1.5))
        for *normal, offset in region.supports:  # where they cut the plane of the plot through the centre
            across = np.array([normal[0], normal[up]])
            if (length := np.linalg.norm(across)) > 0.3:  # sine of its angle to the plot
                foot = centre[[0, up]] + (offset - centre @ normal) / length**2 * across
                axes.axline(foot, foot + np.array([-across[1], across[0]]), color="C3", lw=1.5)
        axes.set(title=title, xlabel="x", ylabel="xyz"[up], aspect="equal")
        axes.set(xlim=centre[0] + half * np.array([-1, 1]), ylim=centre[up] + half * np.array([-1, 1]))
    count = len(world.names)
    figure.suptitle(f"{count} cameras (blue), {len(world.points)} points, region of interest (red)")
    replace_file(path, lambda temporary: figure.savefig(temporary, dpi=100))


def require_placed(folder: Path, count: int, groups: Sequence[int]) -> None:
    """Raise InputError unless the largest group, the first, has half of the images."""
    if not groups:
        what = f"no two of the {count} show the same points from different sides"
        remedy = "walk around the object; each image must show two thirds of the one before"
        raise InputError(what, folder, "photographs", remedy)
    if groups[0] < LEAST_PLACED * count:
        sizes = ", ".join(map(str, groups))
        what = f"of {count}, only {sizes} could be placed together, in {counted(len(groups), 'group')}"
        raise InputError(what, folder, "photographs", "take images that lead from one group to the next")
