"""`refgs render`: what Mitsuba's own command line cannot render, since it has no Python."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from mi_refgs.cli.command import Result, add_command, add_output
from mi_refgs.errors import InputError, counted

SUFFIXES = (".exr", ".png")


def add(commands: Any) -> None:
    """Add the command to the parser."""
    summary = "render a Mitsuba scene, or a run's scene.xml, to an EXR (linear) or PNG (sRGB) picture"
    parser = add_command(
        commands, "render", summary, "refgs render runs/glossy -o glossy.exr --aov albedo normal", run
    )
    parser.add_argument("scene", type=Path, metavar="SCENE.xml|RUN", help="a Mitsuba scene, or a run folder")
    add_output(parser, "picture: .exr (linear, premultiplied alpha) or .png (sRGB, straight alpha)", "OUT")
    parser.add_argument(
        "--sensor", type=int, default=0, metavar="I", help="which sensor of the scene (default %(default)s)"
    )
    parser.add_argument(
        "--camera",
        type=Path,
        metavar="FILE.json",
        help="cameras of a transforms.json, such as the page of `refgs view` saves; --sensor counts these",
    )
    parser.add_argument(
        "--object", action="store_true", help="the object alone, on transparency, without its surroundings"
    )
    parser.add_argument(
        "--spp", type=int, default=0, metavar="N", help="samples per pixel (default: the scene's)"
    )
    parser.add_argument(
        "--aov",
        nargs="+",
        default=[],
        metavar="NAME",
        help="more channels of the EXR: albedo, metallic, roughness, normal, depth, alpha, visibility, "
        "diffuse, specular, indirect",
    )


def run(args: argparse.Namespace) -> Result:
    """Render."""
    from mi_refgs.formats.cameras import read_cameras
    from mi_refgs.io.ownership import require_no_run
    from mi_refgs.render.load_scene import load_scene
    from mi_refgs.render.scene_xml import sensors_of

    if args.output.suffix.lower() not in SUFFIXES:
        raise InputError(
            f"{args.output}: suffix: '{args.output.suffix}' is no picture format here; use .exr or .png"
        )
    if not args.output.parent.is_dir():
        raise InputError(
            f"{args.output}: output: its folder does not exist; create it or choose a writable folder"
        )
    require_no_run(args.output)
    if args.spp < 0:
        raise InputError(f"--spp: {args.spp} is out of range; give a number from 1")
    cameras = None if args.camera is None else read_cameras(args.camera)
    scene = load_scene(scene_file(args.scene), args.aov, args.object)
    own = sensors = scene.sensors()
    whose = f"{args.scene}: --sensor: {args.sensor}: the scene has {counted(len(own), 'sensor')}"
    if cameras is not None:
        sensors = sensors_of(cameras)
        whose = f"{args.camera}: --sensor: {args.sensor}: the file has {counted(len(sensors), 'frame')}"
    if not sensors:
        raise InputError(f"{args.scene}: sensor: the scene has none; add one, or give a file with --camera")
    if not 0 <= args.sensor < len(sensors):
        raise InputError(f"{whose}; give 0 to {len(sensors) - 1}")
    spp = args.spp or (own[0].sampler().sample_count() if cameras is not None and own else 0)
    names = write(scene, sensors[args.sensor], spp, args.output)
    width, height = (int(x) for x in sensors[args.sensor].film().crop_size())
    data = {"output": str(args.output), "width": width, "height": height, "channels": names}
    return Result(data, f"{args.output}: {width} × {height}, {', '.join(names)}")


def scene_file(path: Path) -> Path:
    """The XML of a scene, or of a run folder, whose artefacts are written first if a checkpoint is newer."""
    if not path.is_dir():
        if not path.is_file():
            raise InputError(f"{path}: scene: no such file; give a Mitsuba XML or a run folder")
        return path
    from mi_refgs.reconstruction.reconstruction import load
    from mi_refgs.runs.run import Run

    if Run(path).checkpoints():
        load(path)
    scene = path / "scene.xml"
    if not scene.is_file():
        raise InputError(f"{scene}: scene: missing; write it with `refgs export {path}`")
    return scene


def write(scene: Any, sensor: Any, spp: int, path: Path) -> list[str]:
    """Render into a file, whole or not at all; returns the names of its channels."""
    import mitsuba as mi
    import numpy as np

    from mi_refgs.io.exr import mitsuba_exr
    from mi_refgs.io.files import replace_file
    from mi_refgs.io.images import srgb_from_linear, straight_srgb, write_png
    from mi_refgs.render.load_scene import reason

    try:
        image = mi.render(scene, sensor=sensor, spp=spp)
    except RuntimeError as error:
        raise InputError(f"{path}: render: {reason(error)}") from error
    bitmap = sensor.film().bitmap()
    names = [channel.name for channel in bitmap.struct_()]
    if path.suffix.lower() == ".exr":
        with mitsuba_exr():
            replace_file(path, lambda temporary: bitmap.write(str(temporary)))
        return names
    pixels = np.array(image, dtype=np.float32)
    if "A" in names:
        write_png(path, straight_srgb(pixels[..., :4]))
        return names[:4]
    write_png(path, srgb_from_linear(pixels[..., :3]))
    return names[:3]
