"""A Mitsuba scene of a case of options, by each way that scenes are made, and its differentiable values."""

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import mitsuba as mi
import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from mi_refgs.io.exr import write_exr
from mi_refgs.occlusion.mesh import Mesh, write_mesh
from mi_refgs.plugins.aovs import suffixes
from mi_refgs.render.load_scene import load_scene
from mi_refgs.render.scene_xml import put
from mi_refgs.render.surroundings import Surroundings
from mi_refgs.runs.export import export
from mi_refgs.runs.trained_scene import SCENE, TrainedScene
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.light.lobe_matrices import resample
from mi_refgs.shade.shading import Shading
from mi_refgs.splat.camera import Camera
from mi_refgs.surfels.attributes import ATTRIBUTES
from mi_refgs.surfels.ply import write_ply
from mi_refgs.surfels.table import Surfels
from tests.laws.covering import Case
from tests.laws.option_cases import ACCURACY, CROPS, FORMATS, FOV, HEIGHT, NEAR, WIDTH
from tests.scenes import integrator as scenes
from tests.scenes.integrator import raw_channels, sky

Values = dict[str, np.ndarray]
AROUND = "surroundings_"
OTHERS = 10  # rows of the surroundings
SCALE = 0.8  # of envmap emitters
CONSTANT, BACKDROP = (0.5, 1.0, 1.6), (0.3, 0.1, 0.6)  # radiance of constant lights, of a background
SOME = ("normal", "depth", "roughness")
TURN = Rotation.from_rotvec([0.7, 0.9, -0.4])
TAGS = {
    "refgs": "integrator", "perspective": "sensor", "hdrfilm": "film", "independent": "sampler",
    "envmap": "emitter", "constant": "emitter",
}  # fmt: skip


@dataclass(frozen=True)
class Built:
    """A scene, the sensor to render it with, and its values (float64) that have derivatives, by parameter."""

    scene: Any
    sensor: Any
    parameters: dict[str, str]  # by name of a value: the key of `mi.traverse`


def aov_types(case: Case) -> tuple[str, ...]:
    known = tuple(kind for kind in suffixes() if kind not in ATTRIBUTES or kind in raw_channels())
    return {"none": (), "some": SOME, "all": known}[case["aovs"]]


def rotation(case: Case) -> np.ndarray:
    return TURN.as_matrix() if case["rotated"] else np.eye(3)


@cache
def mesh() -> Mesh:
    """The sphere on which the surfels lie, and a wall beside it."""
    ball = trimesh.creation.icosphere(subdivisions=1)
    wall = trimesh.creation.box((0.2, 4, 4))
    wall.apply_translation((1.3, -2.2, 0))
    return scenes.joined(0.02, ball, wall)


def radiance(case: Case) -> np.ndarray:
    """The light's map (h, w, 3) before `scale` and rotation."""
    if case["map"] == "constant":
        return np.tile(np.array(CONSTANT, np.float32), (8, 16, 1))
    if case["map"] == "9 x 14":
        return np.ascontiguousarray(sky(56)[::6][:9, ::8])
    return sky(int(case["map"].split()[0]))


def values(case: Case, seed: int = 1) -> Values:
    rng = np.random.default_rng(seed)
    raw = raw_channels(seed=seed)
    raw["tint"] = rng.normal(size=(len(raw["position"]), 3))
    raw["normal_offset"] = 0.2 * rng.normal(size=(len(raw["position"]), 3))
    if case["primitive"] == "surfel":
        raw["curvature"] = rng.normal(size=(len(raw["position"]), 3))
    found = dict(raw)
    direction = rng.normal(size=(OTHERS, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    if case["surroundings"]:
        found |= {
            AROUND + "position": direction * rng.uniform(0.6, 2.0, (OTHERS, 1)),
            AROUND + "rotation": rng.normal(size=(OTHERS, 4)),
            AROUND + "scale": np.log(rng.uniform(0.2, 0.5, (OTHERS, 2))),
            AROUND + "opacity": rng.uniform(-1, 1, (OTHERS, 1)),
            AROUND + "radiance_sh": 0.2 * rng.normal(size=(OTHERS, 12)),
        }
    for name, primitive in (("scale", case["primitive"]), (AROUND + "scale", case["surroundings"])):
        if primitive == "gaussian":  # flat ones, whose shortest axis is known
            thin = np.log(rng.uniform(0.06, 0.12, (len(found[name]), 1)))
            found[name] = np.concatenate([found[name], thin], axis=1)
    if case["background"] == "map":
        found["background"] = rng.normal(size=(8, 16, 3))
    if case["emitter"] == "tensor":
        found["light"] = EnvironmentLight.from_radiance(radiance(case)).raw.numpy()
    elif case["emitter"] == "nested":  # the integrator's own copy: raw values of a map that it can train
        own = np.array(CONSTANT) if case["map"] == "constant" else SCALE * radiance(case)
        found["light"] = np.log(np.expm1(resample(own, 8) if case["map"] == "9 x 14" else own))
    elif case["map"] == "constant":
        found["radiance"] = np.array(CONSTANT)
    else:
        found |= {"data": radiance(case), "brightness": np.array([SCALE])}
    return {name: np.asarray(x, np.float32) for name, x in found.items()}


def accuracy(case: Case) -> dict[str, Any]:
    return {} if case["accuracy"] == "none" else {case["accuracy"]: ACCURACY[case["accuracy"]]}


def shading(case: Case) -> Shading:
    name, at, diffuse = case["shading"].split("/")
    return Shading(at, name, diffuse, case["occlusion"], **accuracy(case))


def sensor(case: Case) -> dict[str, Any]:
    x, y, width, height = CROPS[case["crop"]]
    film: dict[str, Any] = {"width": WIDTH, "height": HEIGHT, "rfilter": {"type": case["rfilter"]}}
    film["pixel_format"] = FORMATS[case["colour"]] if case["alpha"] else case["colour"]
    film["component_format"] = case["component_format"]
    if case["crop"] != "none":
        film |= {"crop_offset_x": x, "crop_offset_y": y, "crop_width": width, "crop_height": height}
    sampler = {"type": "independent", "sample_count": case["samples"]}
    return scenes.sensor(fov=FOV, near_clip=NEAR, film=film, sampler=sampler)


def surfels_of(found: Values, prefix: str = "") -> Surfels:
    return Surfels.from_numpy({name: found[prefix + name] for name in ATTRIBUTES if prefix + name in found})


def build(case: Case, found: Values, folder: Path) -> Built:
    if case["input"] == "run":
        return _run(case, found, folder)
    name, at, diffuse = case["shading"].split("/")
    integrator: dict[str, Any] = {"type": "refgs", "reflectance": name, "shade_at": at, "diffuse": diffuse}
    integrator |= accuracy(case)
    if case["occlusion"]:
        write_mesh(folder / "mesh.ply", mesh())
        integrator |= {"mesh": str(folder / "mesh.ply"), "occlusion": True}
    if case["aovs"] != "none":
        integrator["aovs"] = ",".join(f"{kind}_:{kind}" for kind in aov_types(case))
    files = case["input"] != "tensors"
    for prefix, file in (("", "filename"), (AROUND, "surroundings")):
        if prefix + "position" not in found:
            continue
        table = surfels_of(found, prefix)
        if files:
            path = folder / f"{file}.ply"
            write_ply(path, table)
            integrator[file] = str(path)
        else:
            integrator |= {prefix + channel: tensor for channel, tensor in table.raw.items()}
    if case["background"] == "constant":
        integrator["background"] = {"type": "rgb", "value": list(BACKDROP)}
    elif case["background"] == "map":
        raw = mi.TensorXf(found["background"])
        if files:
            EnvironmentLight(raw).write(folder / "background.exr")
        integrator["background"] = str(folder / "background.exr") if files else raw
    scene: dict[str, Any] = {"type": "scene", "integrator": integrator, "sensor": sensor(case)}
    if case["emitter"] == "tensor":
        integrator["light"] = mi.TensorXf(found["light"])
    else:
        (integrator if case["emitter"] == "nested" else scene)["sky"] = _emitter(case, folder)
    if case["input"] == "xml":
        path = folder / "scene.xml"
        path.write_bytes(ElementTree.tostring(xml(scene, "")))
        loaded: Any = mi.load_file(str(path))
    else:
        loaded = mi.load_dict(scene)
    return _built(loaded, loaded.sensors()[0], found)


def _run(case: Case, found: Values, folder: Path) -> Built:
    """The scene.xml of a run, with AOVs, for another sensor."""
    around = None
    if case["surroundings"]:
        behind = EnvironmentLight(mi.TensorXf(found["background"])) if "background" in found else None
        around = Surroundings(surfels_of(found, AROUND), behind)
    light = EnvironmentLight(mi.TensorXf(found["light"]))
    occluder = mesh() if case["occlusion"] else None
    trained = TrainedScene(surfels_of(found), light, occluder, shading(case), 1, 1.0, surroundings=around)
    view = mi.load_dict(sensor(case))
    export(trained, folder, Camera.look_at((2, 2, 2), size=8))
    return _built(load_scene(folder / SCENE, aov_types(case)), view, found)


def _built(scene: Any, view: Any, found: Values) -> Built:
    integrator = scene.integrator().id()
    keys = {name: f"{integrator}.{name}" for name in found}
    keys |= {"data": "sky.data", "brightness": "sky.scale", "radiance": "sky.radiance.value"}
    return Built(scene, view, {name: keys[name] for name in found})


def _emitter(case: Case, folder: Path) -> dict[str, Any]:
    if case["map"] == "constant":
        return {"type": "constant", "radiance": {"type": "rgb", "value": list(CONSTANT)}}
    to_world = np.eye(4)
    to_world[:3, :3] = rotation(case)
    made = {"type": "envmap", "scale": SCALE, "to_world": mi.ScalarTransform4f(to_world)}
    if case["input"] != "xml":
        return made | {"bitmap": mi.Bitmap(radiance(case))}
    write_exr(folder / "sky.exr", radiance(case))
    return made | {"filename": str(folder / "sky.exr")}


def xml(value: dict[str, Any], name: str) -> ElementTree.Element:
    """What `mi.load_file` reads as the dictionary that `mi.load_dict` reads."""
    kind = value["type"]
    if kind == "scene":
        element = ElementTree.Element("scene", version="3.0.0")
    else:
        element = ElementTree.Element(TAGS.get(kind, "rfilter"), type=kind, id=name)
    for key, inner in value.items():
        if key == "type":
            continue
        if isinstance(inner, dict) and inner["type"] == "rgb":
            put(element, **{key: inner["value"]})
        elif isinstance(inner, dict):
            element.append(xml(inner, key))
        elif isinstance(inner, mi.ScalarTransform4f):
            transform = ElementTree.SubElement(element, "transform", name=key)
            numbers = " ".join(repr(float(x)) for x in np.array(inner.matrix).ravel())
            ElementTree.SubElement(transform, "matrix", value=numbers)
        else:
            put(element, **{key: inner})
    return element
