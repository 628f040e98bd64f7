"""The settings of a path-traced data set, and the folder that records them in dataset.json."""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Sequence
from dataclasses import MISSING, asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.data.region import REGION_FILE
from mi_refgs.errors import InputError
from mi_refgs.io.files import make_folder, read_json, write_json
from mi_refgs.io.ownership import OutputFolder
from mi_refgs.synthesis.scene_file import LightFile

RECORD, SURFACE = "dataset.json", "surface.ply"
RELIGHT = "relight"
"""Folder of the test views under further lights."""
OWN_FILES = (
    "transforms_*.json",
    REGION_FILE,
    "environment.exr",
    *(f"{split}/*.{ending}" for split in ("train", "test") for ending in ("png", "exr")),
)
VIEW_FILES = (*OWN_FILES, SURFACE, *(f"{RELIGHT}/*/{pattern}" for pattern in OWN_FILES))
"""What a data set consists of beside its settings, and what overwriting it removes."""


@dataclass(frozen=True)
class Settings:
    """What decides every pixel of a data set."""

    scene: str  # file name, without its folder
    scene_sha256: str  # of the XML and the files that it names
    views: int
    test_views: int
    size: int  # pixels: the width
    spp: int
    seed: int
    max_depth: int
    elevation: tuple[float, float]  # degrees above the horizon, z up
    fov: float  # degrees, of the shorter side
    fill: float  # radius of the bounding sphere / (distance · sin(fov / 2)); at 1 it touches the edge
    environment_height: int  # rows; 0 writes no environment
    light: str = ""  # file name of the map in place of the scene's environment
    light_sha256: str = ""
    height: int = 0  # pixels; 0: as many as `size`
    objects: tuple[str, ...] = ()  # ids of the shapes that an open scene is about; none: all, on transparency
    distance: tuple[float, float] = (0.0, 0.0)  # nearest and farthest camera, scene units; 0: as `fill` says

    @property
    def resolution(self) -> tuple[int, int]:
        """Width and height, pixels."""
        return self.size, self.height or self.size

    @property
    def focal(self) -> float:
        """Focal length, pixels."""
        return 0.5 * min(self.resolution) / math.tan(math.radians(self.fov) / 2)

    def check(self) -> None:
        """Raise InputError for a setting that makes no sense."""

        def need(good: bool, field: str, remedy: str) -> None:
            if not good:
                value = getattr(self, field)
                raise InputError(f"{self.scene}: {field}: {value} is out of range; {remedy}")

        for field in ("views", "test_views", "size", "spp", "max_depth"):
            need(getattr(self, field) >= 1, field, "give a number of at least 1")
        low, high = self.elevation
        need(-90 < low < high < 90, "elevation", "give two angles in degrees, -90 < low < high < 90")
        need(0 < self.fov < 170, "fov", "give degrees between 0 and 170")
        need(0 < self.fill <= 1, "fill", "give a fraction between 0 and 1")
        need(self.seed >= 0, "seed", "give a number of at least 0")
        need(self.height >= 0, "height", "give a number of at least 0")
        near, far = self.distance
        need(0 < near <= far < np.inf or near == far == 0, "distance", "give two lengths, 0 < NEAR <= FAR")


def prepare_folder(
    out: Path, settings: Settings, overwrite: bool, relight: Sequence[LightFile] = ()
) -> OutputFolder:
    """Make the folders and record the settings; stop at a folder that holds anything else, or empty it."""
    record = out / RECORD
    # Settings that an older version lacked have their defaults.
    known = _as_json({f.name: f.default for f in fields(Settings) if f.default is not MISSING})
    wanted = _as_json(asdict(settings))
    found: Any = None
    if record.is_file():
        with contextlib.suppress(InputError):
            content = read_json(record)
            found = known | content if "scene_sha256" in content else None  # a run has a dataset.json, too
    output = OutputFolder(out, "dataset", (RECORD, *VIEW_FILES), RECORD if found else "", overwrite=overwrite)
    lights = _lights(found)
    same = found is not None and {name: found.get(name) for name in wanted} == wanted
    stale = [] if same else [f for pattern in VIEW_FILES for f in sorted(out.glob(pattern))]
    differing = [k for k in wanted if k not in found or found[k] != wanted[k]] if found else []
    changed = [*dict.fromkeys(_option(name) for name in differing)]
    if len({light.name for light in relight}) < len(relight):
        names = ", ".join(str(light.path) for light in relight)
        raise InputError(f"{names}: --relight: two have one name; rename one of the files")
    for light in relight if same else ():
        if lights.get(light.name, light.sha256) != light.sha256:
            stale += [f for pattern in OWN_FILES for f in sorted((out / RELIGHT / light.name).glob(pattern))]
            changed.append(f"--{RELIGHT} {light.name}")
    if stale and not overwrite:
        raise InputError(
            f"{record if found else out}: {', '.join(changed) or 'output'}: the folder holds another "
            "data set; give another folder, the same settings, or --overwrite"
        )
    lights = (lights if same else {}) | {light.name: light.sha256 for light in relight}
    if not same:
        output.require_free()
    output.remove(file.relative_to(out).as_posix() for file in stale)
    for folder in (out / "train", out / "test", *(out / RELIGHT / name / "test" for name in lights)):
        make_folder(folder)
    write_json(output.own(RECORD), wanted | {RELIGHT: lights})
    return output


def _option(field: str) -> str:
    """The argument of `refgs dataset` that a field of the settings comes from."""
    names = {
        "scene": "SCENE",
        "scene_sha256": "SCENE",
        "height": "--size",
        "light_sha256": "--light",
        "objects": "--shapes",
        "spp": "--samples",
    }
    return names.get(field) or f"--{field.replace('_', '-')}"


def _as_json(values: dict[str, Any]) -> dict[str, Any]:
    """What is read where these were written: tuples are lists."""
    content: dict[str, Any] = json.loads(json.dumps(values))
    return content


def _lights(record: Any) -> dict[str, str]:
    """Name and SHA-256 of the further lights that dataset.json records."""
    lights = record.get(RELIGHT) if isinstance(record, dict) else None
    return {k: v for k, v in lights.items() if isinstance(v, str)} if isinstance(lights, dict) else {}


def recorded_lights(record: Path) -> dict[str, str]:
    """Name and SHA-256 of the further lights of a dataset.json; none where there is no such file."""
    try:
        return _lights(read_json(record))
    except InputError:
        return {}
