"""Read every file and data set below folders, each in a process of limited time and memory, and print what
was read, refused with its sentence, or crashed; with -o, the same is written into corpus.json there.

python -m benchmarks.corpus FOLDER …
"""

from __future__ import annotations

import resource
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import mitsuba as mi

from benchmarks.common.build import recorded, write_result
from benchmarks.common.report import Row, plain_parser, table
from mi_refgs.errors import InputError

SECONDS, BYTES = 120, 8 * 2**30  # of one process; eight gigabytes of addresses, as LLVM reserves many
DATA_SETS = ("transforms*.json", "sparse", "*/*/sparse", "images", "poses_bounds.npy", "0-camera.pkl")


def _views(found: dict[str, Any]) -> str:
    for note in found["notes"]:
        if "--force" in note:
            raise InputError(note)
    return f"{found['training views']} + {found['test views']} views, {found['with alpha']} with alpha"


READERS: dict[str, tuple[str, Callable[[Any], str]]] = {
    "": (".data.survey:survey", _views),
    ".ply .spz .sog .splat .ksplat .glb": (":import_splats", lambda x: f"{x.trained.surfels.count} splats"),
    ".exr .hdr": (".shade.light.light_file:read_radiance", lambda x: f"{x.shape[1]} × {x.shape[0]} texels"),
    ".json": (".formats.cameras:read_cameras", lambda cameras: f"{len(cameras)} cameras"),
    ".xml": (".synthesis.settings:load_scene", lambda scene: f"{len(scene.shapes())} shapes"),
}
"""Endings, "" for data sets → reader, and what is said of its result."""


def items(folder: Path) -> Iterator[Path]:
    """The data sets, which contain one of DATA_SETS, and the other files of known endings below a folder."""
    for path in sorted(folder.iterdir()):
        if path.is_dir():
            yield from (path,) if any(any(path.glob(pattern)) for pattern in DATA_SETS) else items(path)
        elif path.suffix and path.suffix.lower() in " ".join(READERS).split():
            yield path


def read(path: Path) -> int:
    """Read a path in this process, and say what; returns the exit code, 2 if it is refused."""
    resource.setrlimit(resource.RLIMIT_AS, (BYTES, BYTES))
    mi.set_variant("llvm_ad_rgb")
    ending = "" if path.is_dir() else path.suffix.lower()
    place, say = next(value for endings, value in READERS.items() if ending in (endings.split() or [""]))
    module, name = f"mi_refgs{place}".split(":")
    try:
        print(say(getattr(import_module(module), name)(path)))
    except InputError as error:
        print(" ".join(str(error).split()), file=sys.stderr)
        return 2
    return 0


def outcome(path: Path) -> Row:
    """What became of a path in its own process: read, refused, crashed or too long; and what it said."""
    command, begin = [sys.executable, "-m", "benchmarks.corpus", "--one", str(path)], time.perf_counter()
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=SECONDS, check=False)
        result = {0: "read", 2: "refused"}.get(done.returncode, f"crashed ({done.returncode})")
        errors = done.stderr.replace(f"{path}: ", "").replace(f"{path}", path.name).splitlines()
        notes = [line.split("warning: ", 1)[1] for line in errors if "warning: " in line]
        said = "; ".join([done.stdout.strip(), *notes] if result == "read" else errors[-1:])
    except subprocess.TimeoutExpired:
        result, said = "too long", f"more than {SECONDS} s"
    return {"file": path.name, "result": result, "s": round(time.perf_counter() - begin, 1), "said": said}


if __name__ == "__main__":
    parser = plain_parser("corpus", __doc__)
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("-o", "--output", type=Path)
    parser.add_argument("--one", action="store_true", help="read one file in this process")
    options = parser.parse_args()
    if options.one:
        sys.exit(read(options.folders[0]))
    mi.set_variant("llvm_ad_rgb")
    found = recorded(lambda: {"rows": [outcome(path) for root in options.folders for path in items(root)]})
    print(table(["file", "result", "s", "what is said"], [[*row.values()] for row in found["rows"]]))
    if options.output:
        write_result(options.output / "corpus.json", found)
