"""The folder of a path-traced data set, which records its settings, and its scene under each light."""

import contextlib
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from mi_refgs.data.region import REGION_FILE
from mi_refgs.errors import InputError
from mi_refgs.io.files import read_json, write_json
from mi_refgs.render import load_scene as scenes
from mi_refgs.shade.light.latlong import Z_UP
from mi_refgs.shade.light.light_file import read_radiance
from mi_refgs.synthesis.options import OPTIONS, LightFile
from mi_refgs.synthesis.pathtrace import all_but
from mi_refgs.types import Scene

RECORD, SURFACE = "dataset.json", "surface.ply"
RELIGHT = "relight"  # folder of the test views under other environment maps
FILES = (
    "transforms_*.json",
    REGION_FILE,
    "environment.exr",
    *(f"{split}/*.{ending}" for split in ("train", "test") for ending in ("png", "exr")),
)
"""Files of a data set, and of its views under another map, which overwriting removes."""


def load_scene(scene: Path, define: Sequence[str] = ()) -> Any:
    """Load a Mitsuba scene with all shapes and their ids: Mitsuba would merge meshes of one material.
    `define`: values of its parameters, name=value; those of the integrator, which is replaced, need none."""
    values = dict(text.partition("=")[::2] for text in define)
    with contextlib.suppress(OSError, ElementTree.ParseError):  # which Mitsuba reports
        root = ElementTree.parse(scene).getroot()
        inside = [element for parent in root.iter("integrator") for element in parent.iter()]
        used = {value for e in root.iter() if e not in inside for value in e.attrib.values()}
        for tag, key, value in ((e.tag, *pair) for e in inside for pair in e.attrib.items()):
            if value.startswith("$") and value not in used:
                some = {"type": "path", "boolean": "false"}.get(key if key == "type" else tag, "1")
                values.setdefault(value[1:], some)
    return scenes.load_scene(scene, define=values)


def under_light(scene: Scene, light: Path, objects: Sequence[Any] = ()) -> Any:
    """The scene with a lat-long map (EXR, HDR) in place of its emitters. `objects`: shapes that are lit
    alone, without the others; they may glow. The map is rotated as the scene's own `envmap` is; without one,
    its y becomes z, which is up."""
    turned: Any = mi.ScalarTransform4f().rotate(*Z_UP)
    environment = scene.environment()
    if environment is not None:
        params = mi.traverse(environment)
        if "data" in params and "to_world" in params:
            turned = mi.ScalarTransform4f(np.array(params["to_world"].matrix, np.float64).reshape(4, 4))
    environment = {"type": "envmap", "bitmap": mi.Bitmap(read_radiance(light)), "to_world": turned}
    lit = objects or [shape for shape in scene.shapes() if not shape.is_emitter()]
    return scene_of([*lit, mi.load_dict(environment)])


def without(scene: Scene, objects: Sequence[Any]) -> Any:
    """The scene without some shapes, with all emitters that are none, the environment last."""
    emitters = sorted(scene.emitters(), key=lambda one: one.is_environment())
    own = [one for one in emitters if not mi.has_flag(one.flags(), mi.EmitterFlags.Surface)]
    return scene_of([*all_but(scene.shapes(), objects), *own])


def scene_of(parts: Sequence[Any]) -> Any:
    """A scene of loaded objects, which keep their ids; `load_dict` alone renames the parameters of theirs."""
    ids = [part.id() for part in parts]
    scene = mi.load_dict({"type": "scene"} | {f"part_{i}": part for i, part in enumerate(parts)})
    for part, name in zip(parts, ids, strict=True):
        part.set_id(name)
    return scene


def prepare_folder(out: Path, wanted: dict[str, Any], overwrite: bool, relight: Sequence[LightFile]) -> None:
    """Make the folders and record the settings; InputError if others are there, unless `overwrite`."""
    names = [light.name for light in relight]
    if len({*names}) < len(names):
        files = ", ".join(str(light.path) for light in relight)
        raise InputError("two have one name", files, f"--{RELIGHT}", "rename one of the files")
    record, found = out / RECORD, dict[str, Any]()
    with contextlib.suppress(InputError):
        content = read_json(record)
        found = content if "scene_sha256" in content else {}  # runs also have a dataset.json
    if not found and out.is_dir() and any(out.iterdir()):
        raise InputError("not empty, and no data set of this command", out, "output", "choose another folder")
    # Files that do not match the settings or a light, and the options that say so.
    other = [name for name in wanted if found and found.get(name) != wanted[name]]
    changed = [*dict.fromkeys(OPTIONS.get(name) or f"--{name.replace('_', '-')}" for name in other)]
    stale = [*FILES, SURFACE, *(f"{RELIGHT}/*/{pattern}" for pattern in FILES)] if changed else []
    lights = {} if changed else recorded_lights(record)
    for light in relight:
        if lights.get(light.name, light.sha256) != light.sha256:
            stale += [f"{RELIGHT}/{light.name}/{pattern}" for pattern in FILES]
            changed.append(f"--{RELIGHT} {light.name}")
    if changed and not overwrite:
        remedy = "give another folder, the same settings, or --overwrite"
        raise InputError("the folder contains another data set", record, ", ".join(changed), remedy)
    lights |= {light.name: light.sha256 for light in relight}
    for file in (path for pattern in stale for path in out.glob(pattern)):
        file.unlink()
    write_json(record, wanted | {RELIGHT: lights})


def recorded_lights(record: Path) -> dict[str, str]:
    """Name and SHA-256 of the other environment maps in a dataset.json; empty without that file."""
    lights: Any = {}
    with contextlib.suppress(InputError):
        lights = read_json(record).get(RELIGHT)
    return {k: v for k, v in lights.items() if isinstance(v, str)} if isinstance(lights, dict) else {}
