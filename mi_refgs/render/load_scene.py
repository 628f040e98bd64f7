"""Load a Mitsuba scene file, with further AOVs of its `refgs` integrator or the object only."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mitsuba as mi

from mi_refgs.errors import InputError
from mi_refgs.shade.light.light_file import read_image, read_radiance

IMAGES = {"envmap": read_radiance, "bitmap": lambda file: read_image(file)[0]}  # by plugin


def load_scene(
    path: Path, aovs: Sequence[str] = (), object_only: bool = False, define: dict[str, str] | None = None
) -> Any:
    """Load a scene, its `refgs` integrator with these AOVs (types, or `name:type`) after its own,
    `object_only` without what surrounds the object. With `define`, values of its $names, all shapes keep
    their ids. Raises InputError for what cannot be loaded, for a name of two types, and for AOVs or
    `object_only` without that integrator."""
    before = mi.file_resolver()
    beside = mi.FileResolver(before)
    beside.prepend(str(path.parent.resolve()))
    mi.set_file_resolver(beside)
    try:
        config = mi.parser.ParserConfig(mi.variant())
        config.merge_equivalent = config.merge_meshes = define is None
        state = mi.parser.parse_file(config, str(path), **(define or {}))
        mi.parser.transform_all(config, state)
        if aovs or object_only:
            integrators = [node.props for node in state.nodes if node.props.plugin_name() == "refgs"]
            if not integrators:
                option = "--aov" if aovs else "--object"
                raise InputError("the scene has no `refgs` integrator", path, option, f"drop {option}")
            if aovs:
                every = [*filter(str.strip, str(integrators[0].get("aovs", "")).split(",")), *aovs]
                parts = [[part.strip() for part in aov.split(":")] for aov in every]
                named = (":".join(part * 2 if len(part) == 1 else part) for part in parts)
                integrators[0]["aovs"] = ",".join(dict.fromkeys(named))  # each once
            for name in ("surroundings", "background") if object_only else ():
                if name in integrators[0]:
                    del integrators[0][name]
        for props in (node.props for node in state.nodes):
            if props.plugin_name() in IMAGES and "filename" in props:
                file = Path(str(beside.resolve(props["filename"])))
                file = file if file.is_file() else path.parent / file
                if file.suffix.lower() in (".exr", ".hdr"):  # broken, they end the process in Mitsuba
                    props["bitmap"] = mi.Bitmap(IMAGES[props.plugin_name()](file))
                    del props["filename"]
        loaded = mi.parser.instantiate(config, state)
    except (RuntimeError, UnicodeError) as error:  # Mitsuba quotes bytes of the file
        raise InputError(reason(error), path, "scene") from error
    finally:
        mi.set_file_resolver(before)
    return loaded[0] if isinstance(loaded, list) else loaded


def reason(error: BaseException) -> str:
    """The sentence at the root of an error that Mitsuba wrapped: ours if there is one, else its last line."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, InputError):
            return str(cause)
        cause = cause.__cause__
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    for line in reversed(lines):
        if found := re.search(r"\b(?:Input|UnknownName)Error: (.*)", line):
            return found[1]
    undefined = "undefined parameter" in str(error)
    remedy = "add its <default>, or `refgs dataset -D NAME=VALUE`" if undefined else "correct the scene"
    return f"{lines[-1] if lines else error}; {remedy}"
