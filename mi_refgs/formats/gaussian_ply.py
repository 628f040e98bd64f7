"""PLY files of 3D Gaussian Splatting and 2DGS: read as a scene, and written.

Colours of other programs are blended display-encoded (`shade.reflectance.radiance`). Two differences to 2DGS:
its screen filter has a variance of 1/2 pixel², ours 1/12; and it sorts surfels by their centres."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from mi_refgs.errors import InputError
from mi_refgs.formats.format import Shot
from mi_refgs.formats.gaussians import gaussians
from mi_refgs.io.ply import read_header
from mi_refgs.methods.method import DataOptions, Method, Stage, SurfelOptions
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.shade.light.maps import Learnt
from mi_refgs.shade.shading import Shading
from mi_refgs.surfels.attributes import ATTRIBUTES
from mi_refgs.surfels.ply import read_ply, write_ply
from mi_refgs.surfels.table import Surfels

EXPECTED = "the PLY file of 3DGS or 2DGS"  # what messages say to give


def write(
    trained: TrainedScene, target: Path, shots: Sequence[Shot], *, degree: int, object: bool
) -> list[Path]:
    """The PLY file of 3D Gaussian Splatting, which its viewers, editors and converters read.

        x y z  nx ny nz  f_dc_0..2  f_rest_0..  opacity  scale_0..2  rot_0..3      little-endian float32

    Logits, logarithms and display-encoded colours, as in `surfels.ply`. The colours are fitted to renders."""
    write_ply(target, gaussians(trained, shots, degree, object))
    return [target]


def read_splats(path: Path, linear: bool = False) -> TrainedScene:
    """Read a PLY file of 3D Gaussians or surfels; `linear`: its colours are linear radiance, as ours."""
    try:
        with path.open("rb") as file:
            header = read_header(path, file, EXPECTED)
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", path, "file", "check the path") from error
    tables = {element.name: {name for name, _ in element.fields} for element in header.elements}
    names = tables.get("vertex", set())
    if "packed_position" in names:
        remedy = f"write it as a plain one, as `splat-transform {path.name} plain.ply` does"
        raise InputError("a compressed PLY", path, "packed_position", remedy)
    if not {"opacity", "scale_0", "rot_0"} & names:
        what = "a mesh" if tables.get("face") is not None else "points without size or opacity"
        raise InputError(f"{what}, no Gaussians", path, "vertex", f"give {EXPECTED}")
    if not any(name.startswith("f_dc_") for name in names):
        raise InputError("the property is missing", path, "f_dc_0", "export the file again with its colours")
    surfels = read_ply(path)
    if not surfels.count:
        raise InputError("there are none", path, "vertex", "export the file again")
    needed = {*surfels.primitive.widths, "radiance_sh"}
    if others := [ATTRIBUTES[name].properties[0] for name in surfels.raw if name not in needed]:
        what = "materials of a run, which require its light and shading"
        raise InputError(what, path, others[0], "give the run folder to the command that needs it")
    shading = Shading("surfel", "radiance") if linear else Shading("pixel", "displayed")
    return TrainedScene(Surfels(surfels.raw), None, None, shading, iteration=0, seconds=0.0)


def method_of(trained: TrainedScene, name: str) -> Method:
    """Describe a scene that was fitted elsewhere as a method, for config.toml: how it is shaded."""
    surfels, stages = trained.surfels, {"imported": Stage(1, trained.shading)}
    count, attributes = surfels.count, tuple(x for x in surfels.raw if x not in surfels.primitive.widths)
    degree = {x: surfels.sh_degree(x) for x in attributes if ATTRIBUTES[x].harmonics}
    options = SurfelOptions(surfels.primitive.name, attributes, count, count, degree=degree)
    light = None if trained.light is None else Learnt(height=trained.light.height)
    return Method(1, stages, surfels=options, light=light, data=DataOptions(downscale=1), name=name)
