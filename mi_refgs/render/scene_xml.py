"""The `scene.xml` of a run: what `mi.load_file` renders after `import mi_refgs`."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import mitsuba as mi

from mi_refgs.constants import RAW_LIMIT
from mi_refgs.errors import InputError
from mi_refgs.io.files import write_bytes
from mi_refgs.shade.shading import Shading
from mi_refgs.splat.camera import Camera

# Mitsuba requires a near plane above 0 and a far plane behind it, here beyond every scene.
NEAR_CLIP_MIN = 1e-12
FAR_CLIP = RAW_LIMIT
SQUARE = 1e-5  # relative difference of focal lengths, by rounding, up to which pixels are square


def write_scene_xml(
    path: str | Path,
    shading: Shading,
    cameras: Sequence[Camera],
    ply: str,
    envmap: str | None = None,
    mesh: str | None = None,
    surroundings: str | None = None,
    background: Sequence[float] | str | None = None,  # a lat-long map, linear radiance, or transparent
    near_field: str | None = None,  # distances of what the envmap shows
) -> None:
    """Write a Mitsuba scene with one `refgs` integrator and a sensor per camera, atomically; `spp` is 1 as in
    training. Names of files are relative to its folder. Pixels are square: where fx ≠ fy, the film has more
    along one axis. Raises InputError for a mirrored camera, occlusion without mesh, or an unusable path."""
    if shading.occlusion and mesh is None:
        raise InputError("there is none to trace", path, "mesh", "give one, or shade without occlusion")
    scene = ElementTree.Element("scene", version="3.0.0")
    scene.append(ElementTree.Comment(" needs `import mi_refgs` before mi.load_file "))
    ElementTree.SubElement(scene, "default", name="spp", value="1")
    integrator = ElementTree.SubElement(scene, "integrator", type="refgs", id="refgs")
    put(integrator, filename=ply, shade_at=shading.at, reflectance=shading.reflectance)
    put(integrator, diffuse=shading.diffuse, occlusion=shading.occlusion)
    put(integrator, **{name: getattr(shading, name) for name in shading.chosen()}, mesh=mesh)
    if surroundings is not None:
        integrator.append(ElementTree.Comment(" without these two: the object alone, on transparency "))
    put(integrator, surroundings=surroundings, background=background)
    if envmap is not None:
        put(ElementTree.SubElement(integrator, "emitter", type="envmap", name="light"), filename=envmap)
    put(integrator, near_field=near_field)
    for index, camera in enumerate(cameras):
        add_sensor(scene, camera, f"sensor_{index}" if index else "sensor")
    write_xml(path, scene)


def sensors_of(cameras: Sequence[Camera]) -> list[Any]:
    """Mitsuba sensors of cameras, as a scene.xml has them; raises InputError as `write_scene_xml` does."""
    scene = ElementTree.Element("scene", version="3.0.0")
    ElementTree.SubElement(scene, "default", name="spp", value="1")
    for index, camera in enumerate(cameras):
        add_sensor(scene, camera, f"sensor_{index}")
    return list(mi.load_string(ElementTree.tostring(scene, encoding="unicode")).sensors())


def has_square_pixels(camera: Camera) -> bool:
    """Whether the film of the camera's sensor has its pixels."""
    fx, fy = sorted(abs(float(focal[0])) for focal in (camera.fx, camera.fy))
    return fy < fx * (1 + SQUARE)


def write_xml(path: str | Path, scene: ElementTree.Element) -> None:
    """Write a scene, indented, whole or not at all; raises InputError if the path cannot be written."""
    ElementTree.indent(scene, "    ")
    write_bytes(path, f"{ElementTree.tostring(scene, encoding='unicode')}\n".encode())


def put(parent: ElementTree.Element, **properties: bool | float | str | Sequence[float] | None) -> None:
    """Add properties of an element by the types of their values: numbers are a colour, None is left out."""
    kinds: dict[type, str] = {bool: "boolean", int: "integer", float: "float", str: "string"}
    for name, value in properties.items():
        if value is not None:
            kind = kinds.get(type(value), "rgb")
            text = str(value).lower() if kind == "boolean" else str(value)
            if kind == "rgb":
                text = ", ".join(repr(float(x)) for x in value)  # type: ignore[union-attr]
            ElementTree.SubElement(parent, kind, name=name, value=text)


def add_sensor(scene: ElementTree.Element, camera: Camera, name: str) -> None:
    fx, fy, cx, cy, near = (float(x[0]) for x in (camera.fx, camera.fy, camera.cx, camera.cy, camera.near))
    if not fx * fy > 0:
        what = f"fx, fy: {fx:g} and {fy:g} pixels mirror the image, as no Mitsuba sensor does"
        raise InputError(what, "camera", remedy="choose another view")
    to_world = camera.pose()
    if fx > 0:  # both axes point the other way: the camera is upside down
        to_world[:3, :2] *= -1
    focal = max(abs(fx), abs(fy))
    per_pixel = focal / abs(fx), focal / abs(fy)
    width = max(1, round(camera.width * per_pixel[0]))
    height = max(1, round(camera.height * per_pixel[1]))
    if not (square := has_square_pixels(camera)):
        size = f"{camera.width} x {camera.height} pixels of focal lengths {abs(fx):g} and {abs(fy):g}"
        scene.append(ElementTree.Comment(f" the view of {size}, with square pixels "))

    # The field of view and the principal point are those of the whole film, of which a crop is rendered.
    (left, top), whole = (0, 0), (width, height)
    if camera.film is not None and square:
        (left, top), whole = camera.offset, camera.film
    x, y = cx * per_pixel[0] + left, cy * per_pixel[1] + top
    sensor = ElementTree.SubElement(scene, "sensor", type="perspective", id=name)
    put(sensor, fov_axis="x", fov=math.degrees(2 * math.atan(whole[0] / (2 * focal))))
    put(sensor, near_clip=max(near, NEAR_CLIP_MIN), far_clip=FAR_CLIP)
    put(sensor, principal_point_offset_x=0.5 - x / whole[0])
    put(sensor, principal_point_offset_y=0.5 - y / whole[1])
    transform = ElementTree.SubElement(sensor, "transform", name="to_world")
    ElementTree.SubElement(transform, "matrix", value=" ".join(map(repr, to_world.ravel().tolist())))
    sampler = ElementTree.SubElement(sensor, "sampler", type="independent")
    ElementTree.SubElement(sampler, "integer", name="sample_count", value="$spp")
    film = ElementTree.SubElement(sensor, "film", type="hdrfilm")
    put(film, width=whole[0], height=whole[1], pixel_format="rgba", component_format="float32")
    if whole != (width, height):
        put(film, crop_width=width, crop_height=height, crop_offset_x=left, crop_offset_y=top)
    ElementTree.SubElement(film, "rfilter", type="box")
