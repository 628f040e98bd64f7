"""One view with all its layers in one EXR file."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from mi_refgs.errors import require_between
from mi_refgs.formats.format import Shot
from mi_refgs.io.exr import write_exr_layers
from mi_refgs.plugins.aovs import aov_values, suffixes
from mi_refgs.render.display import image_array
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.surfels.attributes import ATTRIBUTES

LETTERS = {"normal": "XYZ", "depth": "Z"}  # letters of layers that are no colours


def write(
    trained: TrainedScene, target: Path, shots: Sequence[Shot], *, view: int, samples: int, object: bool
) -> list[Path]:
    """One view with all its layers in one EXR file, as Blender, Nuke and Natron name them. R, G, B, A is the
    image: linear radiance, premultiplied. Every other layer is NAME.R, NAME.G, NAME.B, for vectors NAME.X …,
    and for one number NAME.V; depth is depth.Z, scene units along the viewing axis. The background map is the
    layer background, which R, G, B do not contain: add (1 - A) times it."""
    require_between(view, "--view", 0, len(shots) - 1)
    camera = shots[view].camera
    frame = (replace(trained, surroundings=None) if object else trained).renderer(samples=samples)(camera)
    layers = dict(zip("RGBA", [*frame.radiance, frame.alpha], strict=True))
    for name, letters in suffixes().items():
        if name == "alpha" or (name in ATTRIBUTES and name not in frame.maps):
            continue
        values = [frame.depth] if name == "depth" else aov_values(name, frame, camera)
        letters = LETTERS.get(name, "V" if len(letters) == 1 else letters)
        layers |= {f"{name}.{letter}": plane for letter, plane in zip(letters, values, strict=True)}
    if frame.background is not None:
        layers |= {f"background.{c}": plane for c, plane in zip("RGB", frame.background, strict=True)}
    size = camera.height, camera.width
    write_exr_layers(target, {name: image_array(plane, *size) for name, plane in layers.items()})
    return [target]
