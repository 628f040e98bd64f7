"""Settings of a path-traced data set, the folder that records them, and its scene files."""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from dataclasses import MISSING, asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.data.region import REGION_FILE
from mi_refgs.errors import InputError
from mi_refgs.io.exr import mitsuba_exr
from mi_refgs.io.files import make_folder, read_json, require_file, write_json
from mi_refgs.io.ownership import OutputFolder
from mi_refgs.shade.light.light_file import read_radiance

RECORD, SURFACE = "dataset.json", "surface.ply"
RELIGHT = "relight"  # folder of the test views under other environment maps
OWN_FILES = (
    "transforms_*.json",
    REGION_FILE,
    "environment.exr",
    *(f"{split}/*.{ending}" for split in ("train", "test") for ending in ("png", "exr")),
)
VIEW_FILES = (*OWN_FILES, SURFACE, *(f"{RELIGHT}/*/{pattern}" for pattern in OWN_FILES))
"""Files of a data set except its settings; overwriting removes them."""
Z_UP = (1, 0, 0), 90.0
"""Axis and angle in degrees that rotate y of a lat-long map to z, in scenes without an `envmap`."""


@dataclass(frozen=True)
class LightFile:
    """A lat-long map that replaces the environment of a scene."""

    path: Path
    name: str  # of the folder of its relit views
    sha256: str

    @staticmethod
    def of(path: Path) -> LightFile:
        """Hash a file; raises InputError if it is missing."""
        require_file(path)
        name = re.sub(r"[^0-9A-Za-z_-]+", "_", path.stem).strip("_") or "light"
        return LightFile(path, name, hashlib.sha256(path.read_bytes()).hexdigest())


def scene_hash(scene: Path) -> str:
    """SHA-256 of a scene's XML and the files in it; raises InputError if it is missing or no XML."""
    if not scene.is_file():
        raise InputError(f"{scene}: scene: missing; give the path of a Mitsuba XML file")
    try:
        root = ElementTree.fromstring(scene.read_bytes())
    except ElementTree.ParseError as error:
        raise InputError(f"{scene}: scene: not XML ({error}); give a Mitsuba scene") from error
    digest = hashlib.sha256(scene.read_bytes())
    names = [e.get("value") for e in root.iter("string") if e.get("name") == "filename"]
    for name in [*names, *(e.get("filename") for e in root.iter("include"))]:
        file = scene.parent / (name or "")
        if file.is_file():
            digest.update(file.read_bytes())
    return digest.hexdigest()


def load_scene(scene: Path, whole: bool = False) -> Any:
    """Load a Mitsuba scene; raises InputError if that fails, or the scene has no shape or no emitter.

    `whole`: keep shapes and their ids; otherwise Mitsuba merges meshes of one material.
    """
    import mitsuba as mi

    try:
        with mitsuba_exr():
            loaded = mi.load_file(str(scene), optimize=not whole)
    except (RuntimeError, UnicodeError) as error:  # Mitsuba quotes bytes of the file
        raise InputError(f"{scene}: scene: Mitsuba cannot load it: {error}; correct the scene") from error
    if not loaded.shapes():
        raise InputError(f"{scene}: shapes: the scene has none; add an object to look at")
    if not loaded.emitters():
        raise InputError(f"{scene}: emitters: the scene has none; add an environment emitter")
    return loaded


def under_light(scene: Any, light: Path) -> Any:
    """The scene with a lat-long map (EXR, HDR) in place of its environment; its other emitters are kept.

    The map is rotated as the scene's own `envmap` is; without one, its y becomes z, which is up. Raises
    InputError for a file that contains no such map.
    """
    import mitsuba as mi

    turned: Any = mi.ScalarTransform4f().rotate(*Z_UP)
    environment = scene.environment()
    if environment is not None:
        params = mi.traverse(environment)
        if "data" in params and "to_world" in params:
            turned = mi.ScalarTransform4f(np.array(params["to_world"].matrix, np.float64).reshape(4, 4))
    radiance = read_radiance(light)
    lamps = [emitter for emitter in scene.emitters() if not emitter.is_environment()]
    lamps = [lamp for lamp in lamps if not mi.has_flag(lamp.flags(), mi.EmitterFlags.Surface)]
    parts = {f"part_{i}": part for i, part in enumerate([*scene.shapes(), *lamps])}
    environment = {"type": "envmap", "bitmap": mi.Bitmap(radiance), "to_world": turned}
    return mi.load_dict({"type": "scene", **parts, "environment": environment})


@dataclass(frozen=True)
class Settings:
    """All settings that determine the pixels of a data set."""

    scene: str  # file name without folder
    scene_sha256: str  # of the XML and the files in it
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
    objects: tuple[str, ...] = ()  # ids of the object's shapes in an open scene; empty: all, with alpha
    distance: tuple[float, float] = (0.0, 0.0)  # nearest and farthest camera, scene units; 0: from `fill`

    @property
    def resolution(self) -> tuple[int, int]:
        """Width and height, pixels."""
        return self.size, self.height or self.size

    @property
    def focal(self) -> float:
        """Focal length, pixels."""
        return 0.5 * min(self.resolution) / math.tan(math.radians(self.fov) / 2)

    def require_valid(self) -> None:
        """Raise InputError for a setting that is out of range."""

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
    """Make the folders and record the settings.

    Raises InputError for a folder with a data set of other settings or with foreign files; `overwrite`
    removes the former.
    """
    # Recorded settings; those that an older version lacked have their defaults.
    record = out / RECORD
    known = _as_json({f.name: f.default for f in fields(Settings) if f.default is not MISSING})
    wanted = _as_json(asdict(settings))
    found: Any = None
    if record.is_file():
        with contextlib.suppress(InputError):
            content = read_json(record)
            found = known | content if "scene_sha256" in content else None  # runs also have a dataset.json
    output = OutputFolder(out, "dataset", (RECORD, *VIEW_FILES), RECORD if found else "", overwrite=overwrite)

    # Files that do not match the settings or a light, and the options that say so.
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
            f"{record if found else out}: {', '.join(changed) or 'output'}: the folder contains another "
            "data set; give another folder, the same settings, or --overwrite"
        )

    # Remove them, make the folders, and record the settings.
    lights = (lights if same else {}) | {light.name: light.sha256 for light in relight}
    if not same:
        output.require_free()
    output.remove(file.relative_to(out).as_posix() for file in stale)
    for folder in (out / "train", out / "test", *(out / RELIGHT / name / "test" for name in lights)):
        make_folder(folder)
    write_json(output.own(RECORD), wanted | {RELIGHT: lights})
    return output


def _option(field: str) -> str:
    """The option of `refgs dataset` that sets a field."""
    names = {"scene": "SCENE", "scene_sha256": "SCENE", "height": "--size"}
    names |= {"light_sha256": "--light", "objects": "--shapes", "spp": "--samples"}
    return names.get(field) or f"--{field.replace('_', '-')}"


def _as_json(values: dict[str, Any]) -> dict[str, Any]:
    """The values as JSON returns them: tuples become lists."""
    content: dict[str, Any] = json.loads(json.dumps(values))
    return content


def _lights(record: Any) -> dict[str, str]:
    """Name and SHA-256 of the other environment maps in a dataset.json."""
    lights = record.get(RELIGHT) if isinstance(record, dict) else None
    return {k: v for k, v in lights.items() if isinstance(v, str)} if isinstance(lights, dict) else {}


def recorded_lights(record: Path) -> dict[str, str]:
    """Name and SHA-256 of the other environment maps in a dataset.json; empty without that file."""
    try:
        return _lights(read_json(record))
    except InputError:
        return {}
