"""The files of a comparison: compare.json (settings); table.json, table.md and page, made from the runs."""

from __future__ import annotations

import dataclasses
import json
import shlex
from collections.abc import Sequence
from pathlib import Path

from mi_refgs import __version__
from mi_refgs.compare import jobs
from mi_refgs.compare.jobs import SETTINGS, Job
from mi_refgs.compare.page import PAGE, PICTURES, write_page
from mi_refgs.compare.table import Table, markdown, table_of
from mi_refgs.errors import InputError
from mi_refgs.io.files import read_json, write_bytes, write_json
from mi_refgs.io.ownership import OutputFolder

TABLE, TABLE_TEXT = "table.json", "table.md"


def output(folder: Path) -> OutputFolder:
    """Return the folder of a comparison with its files beside the runs."""
    files = (SETTINGS, TABLE, TABLE_TEXT, PAGE, f"{PICTURES}/*_psnr.png", f"{PICTURES}/*_crops.png")
    return OutputFolder(folder, "compare", files, marker=SETTINGS)


def begin(folder: Path, planned: Sequence[Job], workers: int, arguments: Sequence[str]) -> None:
    """Write the settings of the comparison and the jobs, which are rows of the table from now on.

    Raises InputError where that is impossible.
    """
    output(folder).require_free()
    for job in planned:
        job.write()
    before = read_json(folder / SETTINGS) if (folder / SETTINGS).is_file() else {}
    data, variants = [job.data for job in planned], [Path(job.variant).stem for job in planned]
    about = {
        "data": list(dict.fromkeys([*before.get("data", []), *data])),
        "variants": list(dict.fromkeys([*before.get("variants", []), *variants])),
        "preset": planned[0].preset,
        "set": list(planned[0].settings),
        "workers": workers,
        "command": shlex.join(["refgs", *arguments]),
        "version": __version__,
    }
    write_json(output(folder).own(SETTINGS), about, indent=2)


def table(folder: Path) -> Table:
    """Return the table of all jobs in the folder."""
    about = read_json(folder / SETTINGS) if (folder / SETTINGS).is_file() else {}
    data, variants = about.get("data", []), about.get("variants", [])

    def order(job: Job) -> tuple[int, int, int]:
        variant = Path(job.variant).stem
        place = data.index(job.data) if job.data in data else len(data)
        return place, variants.index(variant) if variant in variants else len(variants), job.seed

    return table_of(folder, sorted(jobs.jobs_in(folder), key=order), about)


def write(folder: Path) -> Table:
    """Write the table of all jobs in the folder as table.json, table.md and a page.

    Raises InputError if there are none, or a file cannot be written.
    """
    found, files = table(folder), output(folder)
    if not found.scenes:
        raise InputError("DATA: none given, and the folder has no comparison; name data sets to fit")
    files.require_free()
    content = json.dumps(dataclasses.asdict(found), indent=1, ensure_ascii=False)
    write_bytes(files.own(TABLE), f"{content}\n".encode())
    write_bytes(files.own(TABLE_TEXT), markdown(found).encode())
    write_page(files, found)
    return found


def text(folder: Path, found: Table) -> str:
    """Return the table and the paths of its files."""
    return f"{markdown(found)}\n{folder / PAGE}, {folder / TABLE_TEXT}, {folder / TABLE}"
