"""`refgs import`: a run folder from a PLY of another program."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from mi_refgs.cli.command import Cameras, Flag, Output, Rendering, Result
from mi_refgs.errors import counted


@dataclass(frozen=True, kw_only=True)
class Import:
    """`refgs render`, `view`, `edit` and `export` read the run folder.

    example:
      refgs import point_cloud.ply -o runs/theirs
    """

    file: Annotated[Positional[Path], arg(metavar="FILE.ply")]
    """3D Gaussians or surfels of any SH degree"""
    output: Output
    """new run folder"""
    camera: Cameras = None
    """cameras of scene.xml, in the form of transforms.json (default: around the object, z up)"""
    linear: Flag = False
    """colours are linear radiance, as fitted by this program (default: display-encoded)"""
    common: Rendering = Rendering()

    def run(self) -> Result:
        """Import the file."""
        from mi_refgs.formats.cameras import read_cameras
        from mi_refgs.reconstruction.reconstruction import import_splats
        from mi_refgs.runs.export import save
        from mi_refgs.runs.run import Run

        Run(self.output).require_none()
        made = import_splats(self.file, linear=self.linear)
        cameras = made.cameras() if self.camera is None else read_cameras(self.camera)
        files = save(made.trained, self.output, made.method, cameras[0], more=cameras[1:])
        surfels = made.trained.surfels
        data = {
            "files": [str(path) for path in files],
            "surfels": surfels.count,
            "primitive": surfels.primitive.name,
            "degree": surfels.sh_degree(),
            "cameras": len(cameras),
        }
        what = f"{counted(surfels.count, surfels.primitive.name)} of SH degree {surfels.sh_degree()}"
        return Result(data, f"{self.output}: {what}, {counted(len(cameras), 'camera')} in scene.xml")
