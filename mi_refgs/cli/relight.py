"""`refgs relight`: a run under another environment map."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import arg

from mi_refgs.cli.command import Flag, OptionalOutput, OtherData, Rendering, Result, RunFolder, Samples
from mi_refgs.evaluation.scores import caption_lines
from mi_refgs.io.progress import warn


@dataclass(frozen=True, kw_only=True)
class Relight:
    """Writes images, a contact sheet, scene.xml, and the score where ground truth is known.

    example:
      refgs relight runs/glossy --envmap studio.hdr --azimuth 90 -o relit/studio"""

    run_folder: RunFolder
    envmap: Annotated[Path, arg(metavar="FILE")]  # lat-long map (EXR, HDR), first row towards +z
    output: OptionalOutput = None  # folder of the result (default: RUN/relight/NAME)
    world: Flag = False  # the map has world directions already, such as an environment.exr or envmap.exr
    azimuth: Annotated[float, arg(metavar="DEG")] = 0.0
    """rotation of the map about +z, counter-clockwise seen from above"""
    exposure: Annotated[float, arg(metavar="EV")] = 0.0
    """exposure compensation in stops, of the map and of the ground truth"""
    turntable: Annotated[int, arg(metavar="N")] = 0
    """render N views around the object instead of the test views"""
    data: OtherData = None
    samples: Samples = 1
    common: Rendering = Rendering()

    def run(self) -> Result:
        from mi_refgs.reconstruction.new_light import NewLight
        from mi_refgs.reconstruction.relight import relight
        from mi_refgs.runs.run import Run

        light = NewLight(self.envmap, self.world, self.azimuth, self.exposure)
        given: dict[str, Any] = {"turntable": self.turntable, "data": self.data, "samples": self.samples}
        result = relight(Run(self.run_folder), light, self.output, progress=True, **given)
        if result["warning"]:
            warn(f"{self.run_folder}: {result['warning']}")
        lines = [f"{len(result['images'])} images, scene.xml and {result['sheet']} in {result['output']}"]
        if result["psnr"] is None:
            lines.append(f"score: none: {result['score_reason']}")
        else:
            factors = ", ".join(f"{x:.3f}" for x in result["scale"])
            lines += caption_lines(result["caption"])
            lines.append(f"PSNR                            {result['psnr']:.2f} dB")
            scaled = f"{result['psnr_scaled']:.2f} dB  (relit image × {factors})"
            lines.append(f"PSNR after per-channel scaling  {scaled}")
        return Result(result, "\n".join(lines))
