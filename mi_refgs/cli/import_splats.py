"""`refgs import`: a run folder from a PLY of another program, as it is or fitted with materials."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, arg

from mi_refgs.cli.command import Cameras, Flag, Output, Preset, Rendering, Result, optional
from mi_refgs.editing.options import Six
from mi_refgs.errors import InputError, counted
from mi_refgs.io.progress import command_line

if TYPE_CHECKING:
    from mi_refgs.splat.camera import Camera


@dataclass(frozen=True, kw_only=True)
class Import:
    """`refgs render`, `view`, `edit` and `export` read the run folder; with --relightable `relight`, too.

    example:
      refgs import point_cloud.ply -o runs/theirs
      refgs import point_cloud.ply -o runs/vase --relightable --preset quick"""

    file: Annotated[Positional[Path], arg(metavar="FILE.ply")]  # 3D Gaussians or surfels
    output: Output  # new run folder
    camera: Cameras = None
    """cameras of scene.xml, with --relightable of the views, in the form of transforms.json (default: around
    the object, z up)"""
    linear: Flag = False  # colours are linear radiance, as fitted by this program (default: display-encoded)
    box: Annotated[Sequence[float] | None, optional("X0 Y0 Z0 X1 Y1 Z1", constructor=Six)] = None
    """import only what has its centre in this axis-aligned box"""
    envmap: Annotated[Path | None, optional("FILE")] = None
    """light of a file with materials, as Ref-Gaussian writes it: a lat-long map, first row towards +z"""
    relightable: Flag = False
    """render views from all around and fit materials, an environment map and a mesh to them"""
    purpose: Annotated[str | None, optional("{photographs,relighting}", name="for")] = None
    """choose the method by a purpose (default with --relightable: relighting)"""
    preset: Preset = None
    common: Rendering = Rendering()

    def run(self) -> Result:
        given = {"--for": self.purpose, "--preset": self.preset}
        for option in (name for name, value in given.items() if value and not self.relightable):
            raise InputError("only a relightable import is fitted", option, remedy="add --relightable")
        if self.envmap is not None and self.relightable:
            raise InputError("the fit finds the light", "--envmap", remedy="leave it out")
        from mi_refgs.formats.cameras import read_cameras

        cameras = None if self.camera is None else read_cameras(self.camera)
        return self._fitted(cameras) if self.relightable else self._as_it_is(cameras)

    def _as_it_is(self, cameras: "Sequence[Camera] | None") -> Result:
        from mi_refgs.reconstruction.reconstruction import import_splats
        from mi_refgs.runs.export import save
        from mi_refgs.runs.run import Run

        Run(self.output).require_none()
        made = import_splats(self.file, linear=self.linear, box=self.box, light=self.envmap)
        cameras = made.cameras() if cameras is None else cameras
        files = save(made.trained, self.output, made.method, cameras[0], more=cameras[1:])
        surfels = made.trained.surfels
        kind, degree = surfels.primitive.name, surfels.sh_degree()
        data = {"files": [str(path) for path in files], "surfels": surfels.count, "primitive": kind}
        data |= {"degree": degree, "cameras": len(cameras)}
        what = f"{counted(surfels.count, kind)} of SH degree {degree}"
        return Result(data, f"{self.output}: {what}, {counted(len(cameras), 'camera')} in scene.xml")

    def _fitted(self, cameras: "Sequence[Camera] | None") -> Result:
        from mi_refgs import methods
        from mi_refgs.reconstruction.relightable_import import import_relightable

        given: dict[str, Any] = {"linear": self.linear, "box": self.box, "preset": self.preset}
        given["method"] = None if self.purpose is None else methods.for_purpose(self.purpose)
        found = import_relightable(self.file, self.output, cameras=cameras, **given)
        trained, dataset = found.trained, str(found.provenance.data)
        data: dict[str, Any] = {"run": str(self.output), "dataset": dataset, "method": found.method.name}
        data |= {"preset": found.method.preset, "iterations": trained.iteration}
        data |= {"seconds": round(trained.seconds, 3), "surfels": trained.surfels.count}
        text = (
            f"{self.output}: {trained.iteration} iterations in {trained.seconds:.0f} s, "
            f"{trained.surfels.count} surfels, fitted to views in {dataset}; "
            f"next: {command_line('relight', self.output, '--envmap', 'MAP.exr')}"
        )
        return Result(data, text)
