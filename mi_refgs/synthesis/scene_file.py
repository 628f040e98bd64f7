"""The scene that a data set is made of: its file, what that names, and other lights for it."""

from __future__ import annotations

import hashlib
import re
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.errors import InputError
from mi_refgs.io.exr import mitsuba_exr
from mi_refgs.io.files import require_file
from mi_refgs.shade.light.light_file import read_radiance

Z_UP = (1, 0, 0), 90.0
"""Axis and angle in degrees that turn the y of a lat-long map to z: for scenes without an `envmap`."""


@dataclass(frozen=True)
class LightFile:
    """A lat-long map that takes the place of a scene's environment."""

    path: Path
    name: str  # of the folder of views under it
    sha256: str

    @staticmethod
    def of(path: Path) -> LightFile:
        """Raises InputError if there is no such file."""
        require_file(path)
        name = re.sub(r"[^0-9A-Za-z_-]+", "_", path.stem).strip("_") or "light"
        return LightFile(path, name, hashlib.sha256(path.read_bytes()).hexdigest())


def scene_hash(scene: Path) -> str:
    """SHA-256 of a scene's XML and of the files that it names; InputError if it is missing or no XML."""
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
    """The Mitsuba scene; raises InputError if it cannot be loaded, or has no shape or no emitter.

    `whole`: each shape stays on its own, with its id; Mitsuba joins meshes of one material otherwise.
    """
    import mitsuba as mi

    try:
        with mitsuba_exr():
            loaded = mi.load_file(str(scene), optimize=not whole)
    except (RuntimeError, UnicodeError) as error:  # Mitsuba quotes bytes of the file
        raise InputError(f"{scene}: scene: Mitsuba cannot load it: {error}; mend the scene") from error
    if not loaded.shapes():
        raise InputError(f"{scene}: shapes: the scene has none; add an object to look at")
    if not loaded.emitters():
        raise InputError(f"{scene}: emitters: the scene has none; add an environment emitter")
    return loaded


def under_light(scene: Any, light: Path) -> Any:
    """The scene with a lat-long map (EXR, HDR) in place of its environment; its other lamps stay.

    The map is turned as the scene's own `envmap` is; where there is none, its y becomes z, which is up.
    Raises InputError for a file that holds no such map.
    """
    import mitsuba as mi

    turned: Any = mi.ScalarTransform4f().rotate(*Z_UP)
    environment = scene.environment()
    if environment is not None:
        params = mi.traverse(environment)
        if "data" in params and "to_world" in params:
            turned = mi.ScalarTransform4f(np.array(params["to_world"].matrix, np.float64).reshape(4, 4))
    radiance = read_radiance(light)
    lamps = [
        emitter
        for emitter in scene.emitters()
        if not emitter.is_environment() and not mi.has_flag(emitter.flags(), mi.EmitterFlags.Surface)
    ]
    parts = {f"part_{i}": part for i, part in enumerate([*scene.shapes(), *lamps])}
    environment = {"type": "envmap", "bitmap": mi.Bitmap(radiance), "to_world": turned}
    return mi.load_dict({"type": "scene", **parts, "environment": environment})
