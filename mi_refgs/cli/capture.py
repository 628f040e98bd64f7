"""`refgs capture`: a data set with cameras from a folder of photographs."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from mi_refgs.cli.command import Common, Output, Result, optional
from mi_refgs.io.progress import say


@dataclass(frozen=True, kw_only=True)
class Capture:
    """Requires COLMAP: pip install "mi_refgs[capture]".

    example:
      refgs capture holiday/vase -o data/vase"""

    photographs: Annotated[Positional[Path], arg(metavar="PHOTOS")]
    """folder with JPEG or PNG files of one scene"""
    output: Output  # folder of the data set; an interrupted run is continued
    masks: Annotated[Path | None, optional("FOLDER")] = None
    """masks NAME.png, one per photograph, white where the object is"""
    camera_model: Annotated[str | None, optional("MODEL")] = None
    """COLMAP camera model, such as OPENCV or OPENCV_FISHEYE (default: the simplest that fits)"""
    region: Annotated[tuple[float, float, float, float] | None, optional("X Y Z R")] = None
    """centre and radius of the region of interest, see capture.png (default: what the cameras look at)"""
    common: Common = Common()

    def run(self) -> Result:
        from mi_refgs.capture.pipeline import capture, report_text
        from mi_refgs.data.region import Region

        region = None
        if self.region is not None:
            region = Region.of({"centre": [*self.region[:3]], "radius": self.region[3]}, "--region")
        given: dict[str, Any] = {"masks": self.masks, "camera": self.camera_model, "region": region}
        report = capture(self.photographs, self.output, tell=say, **given)
        return Result({"dataset": str(self.output), **report}, report_text(report, self.output))
