"""Options of a path-traced data set, the folder that records them, and its scene files."""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from tyro.conf import Suppress, arg

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
LATER = {"light": "", "light_sha256": "", "height": 0, "objects": [], "distance": [0, 0]}
"""Values of settings that records of older versions lack."""


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


Count = Annotated[int, arg(metavar="N")]
Range = tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class DatasetOptions:
    """What determines the pixels of a data set, beside its scene."""

    views: Count = 80
    """training views"""
    test_views: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """test views (default: a quarter of --views)"""
    size: Annotated[int | tuple[int, int], Suppress] = 160
    """pixels per side, or width and height"""
    spp: Annotated[int, arg(metavar="N", name="samples")] = 128
    """samples per pixel; path tracing is noisy, so that the default is larger than that of other commands"""
    objects: Annotated[tuple[str, ...], arg(metavar="NAME …", name="shapes", help_behavior_hint="")] = ()
    """shapes of interest of an open scene: opaque images, ground truth of these shapes only"""
    distance: Annotated[Range | None, arg(metavar="NEAR FAR", help_behavior_hint="")] = None
    """distance of cameras from the object's centre, scene units (default: the object fills the image)"""
    elevation: Annotated[Range, arg(metavar="LOW HIGH")] = (-30.0, 80.0)
    """elevation of cameras, degrees"""
    fov: Annotated[float, arg(metavar="DEG")] = 40.0
    """field of view of the shorter side"""
    fill: Annotated[float, Suppress] = 0.95
    """fraction of the shorter side that the object's bounding sphere fills, where `distance` is not given"""
    seed: Count = 0
    """seed of cameras and paths"""
    max_depth: Count = 6
    """largest path depth"""
    environment_height: Annotated[int, Suppress] = 256
    """rows of environment.exr; 0 writes none"""
    light: Annotated[str | Path | None, arg(metavar="ENV", help_behavior_hint="")] = None
    """lat-long map (EXR, HDR) instead of the scene's environment map, rotated as that is"""

    @property
    def resolution(self) -> tuple[int, int]:
        """Width and height, pixels."""
        return (self.size, self.size) if isinstance(self.size, int) else self.size

    @property
    def focal(self) -> float:
        """Focal length, pixels."""
        return 0.5 * min(self.resolution) / math.tan(math.radians(self.fov) / 2)

    def count(self, split: str) -> int:
        """Number of views of a split."""
        if split == "train":
            return self.views
        return max(1, self.views // 4) if self.test_views is None else self.test_views

    def record(self, scene: Path) -> dict[str, Any]:
        """The content of dataset.json. Raises InputError for a scene or light that cannot be read, and for an
        option that is out of range.
        """
        light = None if self.light is None else LightFile.of(Path(self.light))
        width, height = self.resolution
        values = vars(self) | {
            "scene": scene.name,
            "scene_sha256": scene_hash(scene),  # of the XML and the files in it
            "test_views": self.count("test"),
            "size": width,
            "height": 0 if height == width else height,
            "light": "" if light is None else light.path.name,
            "light_sha256": "" if light is None else light.sha256,
            "distance": self.distance or (0, 0),
        }

        def need(good: Any, field: str, remedy: str) -> None:
            if not good:
                raise InputError(f"{scene}: {field}: {values[field]} is out of range; {remedy}")

        for field in ("views", "test_views", "size", "spp", "max_depth"):
            need(values[field] >= 1, field, "give a number of at least 1")
        low, high = self.elevation
        need(-90 < low < high < 90, "elevation", "give two angles in degrees, -90 < low < high < 90")
        need(0 < self.fov < 170, "fov", "give degrees between 0 and 170")
        need(0 < self.fill <= 1, "fill", "give a fraction between 0 and 1")
        need(self.seed >= 0, "seed", "give a number of at least 0")
        need(height >= 1, "height", "give a number of at least 1")
        near, far = self.distance or (1, 1)
        need(0 < near <= far < np.inf, "distance", "give two lengths, 0 < NEAR <= FAR")
        content: dict[str, Any] = json.loads(json.dumps(values, default=lambda array: array.tolist()))
        return content


def prepare_folder(
    out: Path, wanted: dict[str, Any], overwrite: bool, relight: Sequence[LightFile] = ()
) -> OutputFolder:
    """Make the folders and record the settings `wanted`.

    Raises InputError for a folder with a data set of other settings or with foreign files; `overwrite`
    removes the former.
    """
    # Recorded settings.
    record = out / RECORD
    found: dict[str, Any] | None = None
    with contextlib.suppress(InputError):
        content = read_json(record)
        found = LATER | content if "scene_sha256" in content else None  # runs also have a dataset.json
    output = OutputFolder(out, "dataset", (RECORD, *VIEW_FILES), RECORD if found else "", overwrite=overwrite)

    # Files that do not match the settings or a light, and the options that say so.
    differing = [name for name, value in wanted.items() if found and found.get(name) != value]
    changed = [*dict.fromkeys(_option(name) for name in differing)]
    same = found is not None and not changed
    stale = [] if same else [f for pattern in VIEW_FILES for f in sorted(out.glob(pattern))]
    lights = recorded_lights(record) if same else {}
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
    lights |= {light.name: light.sha256 for light in relight}
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


def recorded_lights(record: Path) -> dict[str, str]:
    """Name and SHA-256 of the other environment maps in a dataset.json; empty without that file."""
    try:
        lights = read_json(record).get(RELIGHT)
    except InputError:
        return {}
    return {k: v for k, v in lights.items() if isinstance(v, str)} if isinstance(lights, dict) else {}
