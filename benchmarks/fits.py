"""Data sets, groups of fits, and their scores: each group is a data file, benchmarks/results/GROUP.json.

`refgs` runs in fresh processes; what is finished is not repeated."""

import json
import re
import subprocess
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from benchmarks.common.build import commit, merged, recorded
from benchmarks.common.report import Row
from benchmarks.common.view import ROOT
from mi_refgs.errors import InputError
from mi_refgs.io.files import is_file, make_folder, read_json, write_json

MAPS = ("potsdamer_platz_1k", "venice_sunset_1k")  # of Poly Haven, in envmaps/ of --data


@dataclass(frozen=True)
class Source:
    """A data set: path-traced from scenes/NAME.xml, or from elsewhere."""

    about: str
    samples: int = 128  # per pixel
    views: tuple[int, int] = (100, 20)  # training and test views
    size: str = "200"
    options: tuple[str, ...] = ()  # of `refgs dataset`
    folder: str | None = None  # below --data
    downscale: int | None = None  # pixels of a file per pixel of a fit, along a side
    minutes: float = 4.5  # of a fit at `quick`, on an idle machine


def _room(about: str, size: str, options: str) -> Source:
    return Source(about, 64, (48, 8), size, (*options.split(),), downscale=1)


SOURCES = {
    "mirror_ring": Source("gold ring around a steel ball, roughness 0.1"),
    "gold_cavities": Source("gold shell, roughness 0.15, around a ball of clay", 64),
    "plastic_hollows": Source("green plastic, roughness 0.22", 64),
    "studded": Source("matte bricks, open below", 64),
    "glossy_demo": Source("glazed ball on a bronze block", 64, (60, 8), "112", minutes=1.7),
    "chair": Source("NeRF-Synthetic, at half its size", folder="chair_400", downscale=2),
    "tabletop": _room(
        "copper jug in a room",
        "135x240",
        "--object jug handle knob --fov 42 --distance 2.7 3.4 --elevation 5 65",
    ),
    "figure": _room(
        "red gloss and silver in a kitchen",
        "180x320",
        "--object red_parts silver_parts --fov 30 --distance 1.9 2.3 --elevation 8 55",
    ),
    "can": _room(
        "printed aluminium on bright tiles",
        "320x180",
        "--object ends wall tab --fov 30 --distance 3.2 3.8 --elevation 10 55",
    ),
    "glass_shelf": _room(
        "glazed mug on glass",
        "180x320",
        "--object mug_outside mug_inside --max-depth 8 --fov 30 --distance 3.4 4.2 --elevation 5 55 "
        "--azimuth -160 -20",
    ),
}


@dataclass(frozen=True)
class Fit:
    """One fit of a source, and its evaluation; of `relighting`, also relit images."""

    source: str
    method: str = "auto"
    preset: str = "quick"
    threads: int = 1
    seed: int = 0

    @property
    def name(self) -> str:
        """Its folder."""
        parts = (self.source, self.method, self.preset, f"seed{self.seed}", self.threads)
        return re.sub(r"[^\w.]+", "_", "-".join(map(str, parts)))

    @property
    def minutes(self) -> float:
        """Expected time with its evaluation, on an idle machine."""
        factors = {"relighting": 1.6, "auto": 1.0, "photographs": 2.4, "photographs_relighting": 2.4}
        return SOURCES[self.source].minutes * factors.get(self.method, 0.8)


SHINY = ("mirror_ring", "gold_cavities", "plastic_hollows")
ROOMS = ("tabletop", "figure", "can")
ABLATIONS = """ref_gaussian gaussians_3d no_interreflection no_material_aware no_pbr no_initial_stage
    no_deferred ref_gaussian_paper base_3dgs_dr base_gaussian_shader base_r3dg base_3dgs base_2dgs""".split()
DECIDED_SCENES = ("mirror_ring", "glossy_demo", "chair", "studded", "plastic_hollows")
DECIDED = [Fit(name) for name in DECIDED_SCENES]
TIMED = DECIDED[0]  # the fit of which frames and the viewer are timed

GROUPS: dict[str, list[Fit]] = {
    "images": [fit for own in DECIDED for fit in (own, Fit(own.source, "base_2dgs"))],
    "relighting": [Fit(name, "relighting") for name in SHINY],
    "methods": [Fit("glossy_demo", method) for method in ABLATIONS],
    "photographs": [
        *(Fit(name, method) for name in ROOMS for method in ("photographs", "base_3dgs")),
        Fit("glass_shelf", "photographs"),
    ],
    "photographs_relighting": [Fit(name, "photographs_relighting") for name in ROOMS],
}

SCORES = """psnr_aligned psnr_aligned_region psnr psnr_region normal_mae_deg normal_mae_deg_concave
    env_correlation surface_distance albedo_psnr roughness_mae metallic_mae train_seconds surfels
    error_budget""".split()
"""Keys of metrics.json that a row has."""
REHEARSAL = "100:1000"  # iterations and surfels of the fit that compiles kernels before a fit is timed
SMALL_FITS, SMALL_PRESET = 1, "16:300"  # of a small instance: fits, and their iterations and surfels


@dataclass(frozen=True)
class Workplace:
    """Folders of the fits: `work`, and `data` with what is not path-traced."""

    work: Path
    data: Path | None = None
    small: bool = False

    def maps(self) -> list[Path]:
        """Return the maps under which relit images are scored."""
        others = [self.data / f"envmaps/{name}.hdr" for name in MAPS] if self.data else []
        return [ROOT / "scenes/lights/sky.exr", *others]

    def source(self, name: str) -> Path:
        """Return the folder of a source, made if it is missing; raises InputError if it has to be given."""
        source, target = SOURCES[name], self.work / "data" / name
        if source.folder is not None:
            if self.data is None or not (self.data / source.folder).is_dir():
                raise InputError(f"--data: {source.folder}: missing; give the folder that contains it")
            return self.data / source.folder
        is_relit = any(fit.source == name for fit in GROUPS["relighting"])
        extra = ["--relight", *self.maps()] if is_relit else []
        views, test_views = (8, 2) if self.small else source.views
        numbers = ["--views", views, "--test-views", test_views, "--size", 32 if self.small else source.size]
        numbers += ["--samples", 2 if self.small else source.samples]
        refgs("dataset", ROOT / f"scenes/{name}.xml", "-o", target, *numbers, *source.options, *extra)
        return target


def refgs(*command: object) -> dict[str, Any]:
    """Run `refgs` and return its JSON; raises InputError if it fails."""
    arguments = [sys.executable, "-m", "mi_refgs", *map(str, command), "--json"]
    done = subprocess.run(arguments, stdout=subprocess.PIPE, text=True, cwd=ROOT)
    if done.returncode:
        raise InputError(f"refgs {' '.join(map(str, command))}: exit code {done.returncode}; see above")
    return dict(json.loads(done.stdout))


def measured(fit: Fit, place: Workplace) -> Row:
    """Return the row of a fit with its build; a finished one of the same commit is read from its folder."""
    folder = place.work / commit() / fit.name
    if is_file(folder / "row.json"):
        return read_json(folder / "row.json")
    data = place.source(fit.source)
    make_folder(folder)
    row = asdict(fit) | recorded(lambda: _fitted(fit, data, folder / "run", place))
    write_json(folder / "row.json", row)
    return row


def _fitted(fit: Fit, data: Path, run: Path, place: Workplace) -> Row:
    threads = ("--threads", fit.threads)
    options = ["--method", fit.method, *threads, "--set", f"seed={fit.seed}"]
    if (downscale := SOURCES[fit.source].downscale) is not None:
        options.append(f"data.downscale={downscale}")
    if not run.exists() and not place.small:  # compiles the kernels
        refgs("train", data, "-o", run.with_name("rehearsal"), "--preset", REHEARSAL, *options)
    preset = SMALL_PRESET if place.small else fit.preset
    options += ["--resume"] if run.exists() else []
    trained = refgs("train", data, "-o", run, "--preset", preset, *options)
    row: Row = {"decisions": trained.get("decisions", [])}
    scores = refgs("eval", run, *threads)
    row |= {key: scores[key] for key in SCORES}
    if fit.method == "relighting":
        relit = [refgs("relight", run, "--envmap", path, *threads) for path in place.maps()]
        row["relit"] = {x.stem: found["psnr_scaled"] for x, found in zip(place.maps(), relit, strict=True)}
    return row


def group(name: str, place: Workplace) -> dict[str, Any]:
    """Return the data file of a group, a row for each fit; raises InputError if one fails."""
    fits = GROUPS[name][: SMALL_FITS if place.small else None]
    for fit in fits:
        if SOURCES[fit.source].folder is not None:
            place.source(fit.source)  # refuses missing data before hours of fits
    rows = [measured(fit, place) for fit in fits]
    build, seconds = merged([row["build"] for row in rows]), sum(row.pop("seconds") for row in rows)
    rows = [row | {"build": row["build"]["commit"]} for row in rows]
    return {"build": build, "seconds": seconds, "rows": rows}
