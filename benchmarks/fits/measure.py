"""Data sets, fits and their scores, by `refgs` in fresh processes; what is finished is not repeated."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from benchmarks.common.build import commit, merged, recorded
from benchmarks.common.report import Row
from benchmarks.common.view import ROOT
from benchmarks.fits.plan import GROUPS, MAPS, SOURCES, Fit
from mi_refgs.errors import InputError
from mi_refgs.io.files import is_file, make_folder, read_json, write_json

SCORES = """psnr psnr_region normal_mae_deg normal_mae_deg_concave env_correlation surface_distance
    albedo_psnr roughness_mae metallic_mae train_seconds surfels error_budget""".split()
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
    if fit.samples is not None:
        scores = refgs("eval", run, "--samples", fit.samples, *threads)
        row |= {"psnr_samples": scores["psnr"], "error_budget_samples": scores["error_budget"]}
    scores = refgs("eval", run, *threads)
    row |= {key: scores[key] for key in SCORES}
    if fit.method == "relighting":
        relit = [refgs("relight", run, "--envmap", path, "--samples", 4, *threads) for path in place.maps()]
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
