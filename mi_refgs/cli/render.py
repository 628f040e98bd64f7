"""`refgs render`: what Mitsuba's own command line cannot render, since it has no Python."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from mi_refgs.cli.command import Result, add_command, add_output
from mi_refgs.errors import InputError

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
    if args.output.suffix.lower() not in SUFFIXES:
        raise InputError(
            f"{args.output}: suffix: '{args.output.suffix}' is no picture format here; use .exr or .png"
        )
    if not args.output.parent.is_dir():
        raise InputError(
            f"{args.output}: output: its folder does not exist; create it or choose a writable folder"
        )
    if args.spp < 0:
        raise InputError(f"--spp: {args.spp} is out of range; give a number from 1")
    scene = load_scene(scene_file(args.scene), args.aov, args.object)
    sensors = scene.sensors()
    if not 0 <= args.sensor < len(sensors):
        raise InputError(
            f"{args.scene}: --sensor: {args.sensor}: the scene has {len(sensors)} sensors; "
            f"give 0 to {len(sensors) - 1}"
        )
    names = write(scene, sensors[args.sensor], args.spp, args.output)
    width, height = (int(x) for x in sensors[args.sensor].film().crop_size())
    data = {"output": str(args.output), "width": width, "height": height, "channels": names}
    return Result(data, f"{args.output}: {width} × {height}, {', '.join(names)}")


def scene_file(path: Path) -> Path:
    """The XML of a scene or of a run folder, whose artefacts are written first where they are missing."""
    if not path.is_dir():
        if not path.is_file():
            raise InputError(f"{path}: scene: no such file; give a Mitsuba XML or a run folder")
        return path
    scene = path / "scene.xml"
    if not scene.is_file():
        raise InputError(f"{scene}: scene: missing; write it with `refgs export {path}`")
    return scene


def load_scene(path: Path, aovs: list[str], alone: bool = False) -> Any:
    """Load a scene, its `refgs` integrator with these AOVs besides its own.

    `alone`: without the surroundings and the background of that. Raises InputError for what Mitsuba cannot
    load, and for AOVs or `alone` without a `refgs` integrator.
    """
    import mitsuba as mi

    from mi_refgs.exr import mitsuba_exr

    before = mi.file_resolver()
    beside = mi.FileResolver(before)
    beside.prepend(str(path.parent.resolve()))
    mi.set_file_resolver(beside)
    try:
        config = mi.parser.ParserConfig(mi.variant())
        state = mi.parser.parse_file(config, str(path))
        mi.parser.transform_all(config, state)
        if aovs or alone:
            integrators = [node.props for node in state.nodes if node.props.plugin_name() == "refgs"]
            if not integrators:
                option = "--aov" if aovs else "--object"
                raise InputError(f"{path}: {option}: the scene has no `refgs` integrator; drop {option}")
            if aovs:
                integrators[0]["aovs"] = ",".join(aov if ":" in aov else f"{aov}:{aov}" for aov in aovs)
            for name in ("surroundings", "background") if alone else ():
                if name in integrators[0]:
                    del integrators[0][name]
        with mitsuba_exr():
            loaded = mi.parser.instantiate(config, state)
    except (RuntimeError, UnicodeError) as error:  # Mitsuba quotes bytes of the file
        raise InputError(f"{path}: scene: {_reason(error)}") from error
    finally:
        mi.set_file_resolver(before)
    return loaded[0] if isinstance(loaded, list) else loaded


def write(scene: Any, sensor: Any, spp: int, path: Path) -> list[str]:
    """Render into a file, whole or not at all; returns the names of its channels."""
    import mitsuba as mi
    import numpy as np

    from mi_refgs.exr import mitsuba_exr
    from mi_refgs.files import replace_file
    from mi_refgs.images import srgb_from_linear, straight_srgb, write_png

    try:
        image = mi.render(scene, sensor=sensor, spp=spp)
    except RuntimeError as error:
        raise InputError(f"{path}: render: {_reason(error)}") from error
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


def _reason(error: BaseException) -> str:
    """The sentence at the root of an error that Mitsuba wrapped: ours if there is one, else its last line."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, InputError):
            return str(cause)
        cause = cause.__cause__
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    for line in reversed(lines):
        _, found, message = line.partition("InputError: ")
        if found:
            return message
    return f"{lines[-1] if lines else error}; correct the scene"
