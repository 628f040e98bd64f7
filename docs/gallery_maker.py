"""Make docs/gallery: data, fit, scores and images of scenes of the package. A tool of maintainers.

`python docs/gallery_maker.py --out docs/gallery` continues where an interrupted call stopped; files that
exist are not made again, except images of an exhibit that has been fitted anew.
"""

from __future__ import annotations

import io
import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mi_refgs  # isort: skip  # noqa: F401  (chooses the LLVM before Mitsuba is imported)
import mitsuba as mi
import numpy as np
import tyro
from PIL import Image

from mi_refgs import __version__, methods
from mi_refgs.editing.options import EditOptions
from mi_refgs.errors import InputError
from mi_refgs.evaluation import evaluate as evaluation
from mi_refgs.evaluation.decomposition import material_maps
from mi_refgs.evaluation.images import (
    RenderedView,
    contact_sheet,
    displayed_over,
    light_panels,
    normal_colours,
    panels,
)
from mi_refgs.io.files import is_file, read_json, resource_dir, write_bytes, write_json
from mi_refgs.io.images import read_png, to_8_bits
from mi_refgs.io.ownership import own_folder
from mi_refgs.io.progress import say
from mi_refgs.reconstruction import relight as relighting
from mi_refgs.reconstruction.fit import fit
from mi_refgs.reconstruction.new_light import NewLight
from mi_refgs.reconstruction.reconstruction import Reconstruction, load
from mi_refgs.runs.run import RELIT as RELIT_RECORD, Run
from mi_refgs.shade.light.light_file import read_radiance
from mi_refgs.synthesis.make_dataset import make_dataset
from mi_refgs.synthesis.options import DatasetOptions
from mi_refgs.synthesis.pathtrace import Cameras, Tracer, bounding_sphere
from mi_refgs.synthesis.settings import load_scene

RECORD, PAGE = "gallery.json", "README.md"
PURPOSE = "relighting"
"""Purpose of the method by which the scenes are fitted."""
LIGHT = "sky.exr"
"""A map of scenes/lights under which no scene of the gallery is fitted."""
METHODS = ("base_2dgs", "base_3dgs_dr")
"""Methods next to which it is displayed."""
TEST_VIEWS = 20
SAMPLES = 4
"""Samples per pixel, 2 × 2."""
TURN, TURN_SECONDS = 30, 3.0
"""Frames of a turntable, and seconds per turn."""
EDIT_VIEWS = (0, TEST_VIEWS // 2)
"""Test views of the edited scenes."""
FINE, SHOWN = 4, 2
"""Pixels of a displayed image per pixel of a training image, along a side: of the first image of an exhibit,
and of turntables and edits."""
FIRST, TURNTABLE, DECOMPOSITION = "first.webp", "turntable.webp", "decomposition.webp"
RELIT, EDITS = "relit.webp", "edits.webp"
LIT, COMPARED = "lights.webp", "methods.webp"
"""Image files of an exhibit, in its folder."""
PER_ROW = 3
"""Maps in a row of the decomposition, each next to its ground truth."""
HEAD = """\
| scene | PSNR | normals | albedo | roughness error | metallic error | relit |
|---|---|---|---|---|---|---|"""
QUALITY = 75
"""WebP quality, 0 to 100: fine texture stays, and a sheet is a tenth of its PNG."""
EFFORT = 6
"""Effort of the WebP encoder, 0 to 6."""


@dataclass(frozen=True)
class Exhibit:
    """A scene of the package, and the edits displayed of it."""

    caption: str
    edits: Mapping[str, EditOptions]  # by title: keywords of `Reconstruction.edit`, on materials alone
    samples: int = 64  # per pixel of the path-traced images
    view: int = 0  # test view of the first image


EXHIBITS: dict[str, Exhibit] = {
    "mirror_ring": Exhibit(
        "A gold ring around a steel ball, both of roughness 0.1: a near-mirror that reflects itself.",
        {
            "brushed": {"set": ["roughness=0.45"]},
            "copper": {"set": ["albedo=0.93,0.48,0.34"]},
            "red glaze": {"set": ["metallic=0", "albedo=0.5,0.03,0.03", "roughness=0.1"]},
        },
        samples=128,
        view=12,
    ),
    "plastic_hollows": Exhibit(
        "A block of green plastic, roughness 0.22, with bowls and a hole: a dielectric with cavities.",
        {
            "red": {"set": ["albedo=0.6,0.05,0.04"]},
            "matte": {"set": ["roughness=0.9"]},
            "gold": {"set": ["metallic=1", "albedo=1.0,0.77,0.34", "roughness=0.2"]},
        },
    ),
    "gold_cavities": Exhibit(
        "A gold shell with six windows, roughness 0.15, around a ball of clay: concave metal.",
        {
            "silver": {"where": "metallic > 0.5", "set": ["albedo=0.95,0.93,0.88"]},
            "copper": {"where": "metallic > 0.5", "set": ["albedo=0.93,0.48,0.34"]},
            "brushed": {"where": "metallic > 0.5", "set": ["roughness=0.45"]},
        },
    ),
    "studded": Exhibit(
        "Three matte building bricks, open below.",
        {
            "red": {"set": ["albedo=0.6,0.05,0.04"]},
            "gold": {"set": ["metallic=1", "albedo=1.0,0.77,0.34", "roughness=0.15"]},
        },
    ),
}
"""The exhibits by scene, in the order of the page."""

ROOMS = {
    "tabletop": "A copper jug with a glazed handle and knob on a laid table.",
    "figure": "A figure of red gloss and silver in a kitchen.",
    "can": "A can of printed aluminium on bright tiles.",
}
"""Objects in rooms by scene, path-traced as if photographed: without alpha."""
LIGHTS = {"sky": LIGHT, "studio": "studio.exr"}
"""Maps of scenes/lights under which these are relit, by title."""
ROOM_VIEWS = (1, 4)
"""Test views of them."""
TILE = 400
"""Rows of each of their images, pixels."""
AROUND = 0.15
"""Width of the border around an object in these images, relative to its own height or width, the smaller."""


def make_gallery(
    out: Path = Path("docs/gallery"),
    work: Path = Path("runs/gallery"),
    scenes: tuple[str, ...] = (*EXHIBITS,),
    views: int = 100,
    size: int = 200,
    preset: str = "standard",
    set: tuple[str, ...] = (),
    lights: tuple[Path, ...] = (),
    rooms: dict[str, Path] | None = None,
) -> None:
    """Make the gallery of some exhibits in the folder `out`; exhibits made before stay on the page.

    Args:
        out: Folder of the page and its images.
        work: Folder of the data sets and runs.
        scenes: Names of exhibits.
        views: Training views per scene.
        size: Pixels per side.
        preset: Preset of the fits.
        set: Changes of the method, as in `loss.ssim=0.1`.
        lights: Environment maps beside `sky.exr` under which exhibits are displayed.
        rooms: Evaluated runs of objects in rooms, by scene.

    Raises:
        InputError: for an unknown exhibit, a gallery of other settings, and a folder that cannot be written.
    """
    mi.set_variant("llvm_ad_rgb")
    for name in scenes:
        if name not in EXHIBITS:
            raise InputError(f"--scenes: {name}: not in the gallery; use some of {', '.join(EXHIBITS)}")
    for name in rooms or {}:
        if name not in ROOMS:
            raise InputError(f"--rooms: {name}: not in the gallery; use some of {', '.join(ROOMS)}")
    settings = {"views": views, "size": size, "preset": preset, "set": [*set]}
    settings["lights"] = [light.name for light in lights]
    empty: dict[str, Any] = {"settings": settings, "scenes": {}, "rooms": {}}
    record = read_json(out / RECORD) if is_file(out / RECORD) else empty
    if record["settings"] != settings:
        raise InputError(
            f"{out / RECORD}: the gallery was made with {record['settings']}, not {settings}; repeat "
            "that, or choose another --out"
        )
    if not is_file(out / RECORD):
        own_folder(out, "gallery")
    found, in_rooms = dict(record["scenes"]), dict(record["rooms"])

    def write_page() -> None:
        made = {name: found[name] for name in EXHIBITS if name in found}
        photographed = {name: in_rooms[name] for name in ROOMS if name in in_rooms}
        write_json(out / RECORD, {"settings": settings, "scenes": made, "rooms": photographed})
        write_bytes(out / PAGE, page(settings, made, photographed).encode())

    for number, name in enumerate(scenes):
        say(f"{number + 1} of {len(scenes)}: {name}")
        run, others, scores = _fitted(name, work / name, settings)
        if scores != found.get(name):  # images of another fit
            shutil.rmtree(out / name, ignore_errors=True)
        found[name] = scores
        _write_images(name, run, others, scores, out / name, settings, lights)
        write_page()
    for name, folder in (rooms or {}).items():
        in_rooms[name] = evaluation.read_metrics(Run(folder)) or evaluation.evaluate(Run(folder))
        in_rooms[name] = {key: in_rooms[name][key] for key in ("psnr", "psnr_region", "normal_mae_deg")}
        shutil.rmtree(out / name, ignore_errors=True)
        write_room(load(folder), out / name)
        write_page()


def _fitted(
    name: str, work: Path, settings: dict[str, Any]
) -> tuple[Reconstruction, dict[str, Reconstruction], dict[str, Any]]:
    """Fit, evaluate and relight an exhibit where that is missing.

    Returns the run, those of METHODS by name, and the scores of all.
    """
    scenes = resource_dir("scenes")
    light = scenes / "lights" / LIGHT
    traced = _traced(name, settings)
    data = make_dataset(scenes / f"{name}.xml", work / "data", relight=[light], progress=True, **traced)
    run, metrics = _evaluated(data, methods.for_purpose(PURPOSE), work / "run", settings)
    folder = Run(work / "run")
    record = folder.path / "relight" / Path(LIGHT).stem / RELIT_RECORD
    if not is_file(record):
        relighting.relight(folder, NewLight(light), samples=SAMPLES, progress=True)
    keys = (
        "psnr",
        "normal_mae_deg",
        "albedo_psnr",
        "albedo_scale",
        "roughness_mae",
        "metallic_mae",
        "surfels",
        "train_seconds",
    )
    scores = {key: metrics[key] for key in keys} | {"relit_psnr": read_json(record)["psnr_scaled"]}
    others, scores["methods"] = {}, {}
    for method in METHODS:
        others[method], metrics = _evaluated(data, method, work / method, settings)
        scores["methods"][method] = {key: metrics[key] for key in ("psnr", "normal_mae_deg")}
    return run, others, scores


def _evaluated(
    data: Path, method: str, folder: Path, settings: Mapping[str, Any]
) -> tuple[Reconstruction, dict[str, Any]]:
    """Fit a method and evaluate the run where that is missing; returns the run and its metrics."""
    how = {"preset": settings["preset"], "settings": settings["set"], "resume": Run(folder).exists()}
    run = fit(data, method, output=folder, progress=True, **how)
    metrics = evaluation.read_metrics(Run(folder))
    if metrics is None or metrics.get("iterations") != run.trained.iteration:
        metrics = evaluation.evaluate(Run(folder), progress=True)
    return run, metrics


def _traced(name: str, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Options of the path tracer for an exhibit (`DatasetOptions`)."""
    sizes = {"views": settings["views"], "test_views": TEST_VIEWS, "size": settings["size"]}
    return sizes | {"spp": EXHIBITS[name].samples}


def _write_images(
    name: str,
    run: Reconstruction,
    others: Mapping[str, Reconstruction],
    scores: Mapping[str, Any],
    out: Path,
    settings: Mapping[str, Any],
    lights: Sequence[Path],
) -> None:
    """Write the images of an exhibit that are missing."""
    assert run.folder is not None
    exhibit, size = EXHIBITS[name], SHOWN * settings["size"]
    sky = resource_dir("scenes") / "lights" / LIGHT
    other = run.relight(sky)
    if not is_file(out / FIRST):
        write_still(out / FIRST, first_image(name, run, other, settings))
    if not is_file(out / DECOMPOSITION):
        scale = np.array(scores["albedo_scale"])
        write_still(out / DECOMPOSITION, decomposition_image(run, exhibit.view, scale))
    if not is_file(out / RELIT):
        write_still(out / RELIT, read_png(run.folder / "relight" / sky.stem / relighting.SHEET))
    if not is_file(out / TURNTABLE):
        frames = [
            np.concatenate([_shown(scene, camera, size) for scene in (run, other)], axis=1)
            for camera in run.turntable(TURN)
        ]
        write_turntable(out / TURNTABLE, frames, TURN_SECONDS)
    if not is_file(out / EDITS):
        made = {"as fitted": run}
        for title, how in exhibit.edits.items():
            options: EditOptions = {**how, "materials": True}
            made[title] = run.edit(**options)
        rows = [{title: _shown(scene, view, size) for title, scene in made.items()} for view in EDIT_VIEWS]
        write_still(out / EDITS, contact_sheet(rows))
    if not is_file(out / LIT):
        lit = {light.stem: _shown(run.relight(light), exhibit.view, size) for light in (sky, *lights)}
        write_still(out / LIT, contact_sheet([_cropped(lit)]))
    if not is_file(out / COMPARED):
        write_still(out / COMPARED, methods_image({**others, "ours": run}, exhibit.view))


def _shown(run: Reconstruction, camera: Any, size: int) -> np.ndarray:
    """Render a camera (size, size, 3) on a white background, display-encoded."""
    return displayed_over(run.render(camera, size=size, samples=SAMPLES), np.ones(3))


def first_image(
    name: str, run: Reconstruction, relit: Reconstruction, settings: Mapping[str, Any]
) -> np.ndarray:
    """Ground truth, fit, normals and relit fit (H, W, 3) of an exhibit, next to each other."""
    size, view = FINE * settings["size"], EXHIBITS[name].view
    maps = run.aovs(view, ["normal"], size=size, samples=SAMPLES)
    ours = run.render(view, size=size, samples=SAMPLES)
    images = {
        "ground truth": _path_traced(name, DatasetOptions(**_traced(name, settings) | {"size": size}), view),
        "ours": displayed_over(ours, np.ones(3)),
        "our normals": normal_colours(maps["normal"], ours[..., 3]),
        "relit": _shown(relit, view, size),
    }
    return contact_sheet([_cropped(images)])


def decomposition_image(run: Reconstruction, number: int, scale: np.ndarray) -> np.ndarray:
    """A test view's image, normals and materials, and the light, each next to its ground truth.

    scale: of the albedo, per channel.
    """
    views = run.views()
    view = views.views[number].load()
    camera, light = view.camera(), run.trained.light
    assert light is not None and views.environment is not None
    rendered = RenderedView.of(run.trained.renderer()(camera), views, view)
    found = panels(replace(rendered, maps=material_maps(run.trained)(camera, rendered)), view, scale)
    titles = [*found]
    rows = [
        {title: found[title] for title in titles[i : i + PER_ROW]} for i in range(0, len(titles), PER_ROW)
    ]
    radiance = light.radiance().numpy()
    return contact_sheet(rows, light_panels(radiance, read_radiance(views.environment, len(radiance))))


def methods_image(runs: Mapping[str, Reconstruction], number: int) -> np.ndarray:
    """Images of a test view, and normals below, next to the ground truth."""
    view = next(iter(runs.values())).views().views[number].load()
    assert view.normal is not None
    images = {"ground truth": view.displayed}
    normals = {"ground truth": normal_colours(view.normal, view.covered())}
    for title, run in runs.items():
        image = run.render(number, samples=SAMPLES)
        images[title] = displayed_over(image, np.ones(3))
        normals[title] = normal_colours(
            run.aovs(number, ["normal"], samples=SAMPLES)["normal"], image[..., 3]
        )
    return contact_sheet([images, normals])


def _path_traced(name: str, options: DatasetOptions, view: int) -> np.ndarray:
    """Path-trace a test view of an exhibit (size, size, 3) on a white background, display-encoded."""
    scene = load_scene(resource_dir("scenes") / f"{name}.xml")
    centre, radius = bounding_sphere(scene.shapes())
    cameras = Cameras(options, centre, radius, radius)
    return displayed_over(Tracer(scene, cameras).image(*cameras.of("test")[view]), np.ones(3))


def _cropped(images: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The rows and columns (H, W, 3) in which one of the images is not white."""
    shown = np.any([image.min(axis=-1) < 1 for image in images.values()], axis=0)
    rows, columns = (np.flatnonzero(shown.any(axis=axis)) for axis in (1, 0))
    part = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    return {title: image[part] for title, image in images.items()}


def write_room(run: Reconstruction, out: Path) -> None:
    """Write the images of an object in a room: test views, alone and relit, and a turntable."""
    lights = {title: resource_dir("scenes") / "lights" / name for title, name in LIGHTS.items()}
    relit = {f"under {title}": run.relight(light) for title, light in lights.items()}
    rows = []
    for view in ROOM_VIEWS:
        camera = run.camera(view)
        size = FINE * camera.width, FINE * camera.height
        photograph = Image.fromarray(to_8_bits(run.views().views[view].load().displayed))
        alone = run.render(view, size=size, samples=SAMPLES, object_only=True)
        normal = run.aovs(view, ["normal"], size=size, samples=SAMPLES, object_only=True)["normal"]
        images = {
            "photograph": np.asarray(photograph.resize(size, Image.Resampling.BICUBIC)) / 255,
            "ours": displayed_over(run.render(view, size=size, samples=SAMPLES), np.ones(3)),
            "our normals": normal_colours(normal, alone[..., 3]),
            "object only": displayed_over(alone, np.ones(3)),
        }
        for title, scene in relit.items():
            images[title] = displayed_over(scene.render(view, size=size, samples=SAMPLES), np.ones(3))
        part = _around(alone[..., 3])
        rows.append({title: _resized(image[part]) for title, image in images.items()})
    write_still(out / FIRST, contact_sheet(rows))

    shots = [[_turned(scene, camera) for scene in relit.values()] for camera in run.turntable(TURN)]
    part = _around(np.max([image[..., 3] for shot in shots for image in shot], axis=0))
    frames = [
        np.concatenate([_resized(displayed_over(image, np.ones(3))[part]) for image in shot], axis=1)
        for shot in shots
    ]
    write_turntable(out / TURNTABLE, frames, TURN_SECONDS)


def _turned(run: Reconstruction, camera: Any) -> np.ndarray:
    """Render the object from a camera of a turntable (H, W, 4)."""
    return run.render(camera, size=(FINE * camera.width, FINE * camera.height), samples=SAMPLES)


def _around(alpha: np.ndarray) -> tuple[slice, slice]:
    """The rows and columns of an object of this alpha (H, W), with its border where the image has it."""
    rows, columns = (np.flatnonzero((alpha > 0.5).any(axis=axis)) for axis in (1, 0))
    border = round(AROUND * min(np.ptp(rows), np.ptp(columns)))
    first, second = (slice(max(part[0] - border, 0), part[-1] + border + 1) for part in (rows, columns))
    return first, second


def _resized(image: np.ndarray) -> np.ndarray:
    """An image of TILE rows."""
    size = round(TILE * image.shape[1] / image.shape[0]), TILE
    return np.asarray(Image.fromarray(to_8_bits(image)).resize(size, Image.Resampling.LANCZOS)) / 255


# ---------- Image files ----------


def write_still(path: Path, image: np.ndarray) -> None:
    """Write an image (H, W, 3) in [0, 1], display-encoded; raises InputError where that is impossible."""
    _write(path, [image])


def write_turntable(path: Path, frames: Sequence[np.ndarray], seconds: float) -> None:
    """Write images of one size as an endless animation that takes `seconds` per turn."""
    _write(path, frames, duration=round(1000 * seconds / len(frames)), loop=0)


def _write(path: Path, frames: Sequence[np.ndarray], **options: Any) -> None:
    first, *others = (Image.fromarray(to_8_bits(frame)) for frame in frames)
    buffer = io.BytesIO()
    first.save(
        buffer, "WEBP", save_all=bool(others), append_images=others, quality=QUALITY, method=EFFORT, **options
    )
    write_bytes(path, buffer.getvalue())


# ---------- README.md ----------


def page(settings: Mapping[str, Any], found: Mapping[str, Any], rooms: Mapping[str, Any]) -> str:
    """Return the Markdown of the page from the settings of the gallery and the scores of each exhibit, and of
    objects in rooms."""
    options = {"scenes": [*found], **settings}
    command = " ".join(
        f"--{name} {' '.join(value) if isinstance(value, list) else value}"
        for name, value in options.items()
        if value
    )
    text = [
        "# Gallery",
        f"Scenes of the package, path-traced from {settings['views']} sides at {settings['size']}², fitted "
        f"with the method for relighting at the preset `{settings['preset']}`, and rendered by the fit, "
        f"version {__version__}. All views displayed are test views. Click an image to enlarge it.",
        "\n".join([HEAD, *(_row(name, found[name]) for name in found)]),
        "Normal errors are means over the foreground. Albedo and relit images are compared after per-channel "
        "scaling.",
    ]
    lit = _list(Path(light).stem for light in (LIGHT, *settings["lights"]))
    for name, scores in found.items():
        compared = [
            f"`{method}` ({other['psnr']:.1f} dB, {other['normal_mae_deg']:.1f}°)"
            for method, other in scores["methods"].items()
        ]
        edits = "; ".join(f"*{title}*: `{_words(edit)}`" for title, edit in EXHIBITS[name].edits.items())
        text += [
            f"## {name}",
            f"{EXHIBITS[name].caption} [The scene](../../scenes/README.md).",
            f"![{name}: ground truth, fit, normals, and under another environment map]({name}/{FIRST})",
            f"![{name} turning, under the estimated environment map and under another]({name}/{TURNTABLE})",
            "Left: the estimated environment map. Right: one that the fit has not seen.",
            f"![{name} under {lit}]({name}/{LIT})",
            f"![{name} under another environment map, compared with the path tracer]({name}/{RELIT})",
            f"![Image, normals and materials of {name}, and its environment map, next to the ground truth]"
            f"({name}/{DECOMPOSITION})",
            f"![A test view of {name} and its normals, fitted by several methods]({name}/{COMPARED})",
            f"Methods: {_list([*compared, 'ours, the method for relighting'])}.",
            f"![{name} edited]({name}/{EDITS})",
            f"Edits: {edits}.",
        ]
    if rooms:
        text += [
            "## In rooms",
            "Objects photographed with the room around them: path-traced images without alpha, fitted with "
            "`--for relighting`. The images are crops of test views, at four times the pixels of the "
            "photographs. [How they were made and fitted](../photographs_in_detail.md#measured).",
        ]
    for name, scores in rooms.items():
        text += [
            f"### {name}",
            f"{ROOMS[name]} PSNR {scores['psnr']:.1f} dB, {scores['psnr_region']:.1f} dB in the region of "
            f"interest{_number(scores['normal_mae_deg'], '; normals {:.1f}°')}.",
            f"![{name}: photograph, fit, normals, and the object alone under three environment maps]"
            f"({name}/{FIRST})",
            f"![{name} turning under two environment maps]({name}/{TURNTABLE})",
        ]
    if rooms:
        command += " --rooms " + " ".join(f"{name} runs/{name}" for name in rooms)
    shown = command.replace(" --views", " \\\n    --views").replace(" --rooms", " \\\n    --rooms")
    text += ["## How was it made?", f"```sh\npython docs/gallery_maker.py {shown}\n```"]
    return "\n\n".join(text) + "\n"


def _row(name: str, scores: Mapping[str, Any]) -> str:
    cells = [
        f"[{name}](#{name})",
        _number(scores["psnr"], "{:.1f} dB"),
        _number(scores["normal_mae_deg"], "{:.1f}°"),
        _number(scores["albedo_psnr"], "{:.1f} dB"),
        _number(scores["roughness_mae"], "{:.2f}"),
        _number(scores["metallic_mae"], "{:.2f}"),
        _number(scores["relit_psnr"], "{:.1f} dB"),
    ]
    return f"| {' | '.join(cells)} |"


def _list(words: Iterable[str]) -> str:
    """Words as `a`, `a and b` or `a, b and c`."""
    *first, last = words
    return f"{', '.join(first)} and {last}" if first else last


def _number(value: float | None, form: str) -> str:
    return "" if value is None else form.format(value)


def _words(edit: Mapping[str, Any]) -> str:
    """An edit as options of `refgs edit`."""
    words = ["--set " + " ".join(edit["set"])] if "set" in edit else []
    words += [f'--where "{edit["where"]}"'] if "where" in edit else []
    for name, value in edit.items():
        if name not in ("set", "where"):
            words.append(f"--{name}" + ("" if value is True else f" {' '.join(map(str, value))}"))
    return " ".join(words)


if __name__ == "__main__":
    tyro.cli(make_gallery)
