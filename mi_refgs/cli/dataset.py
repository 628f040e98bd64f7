"""`refgs dataset`: a multi-view data set of a Mitsuba scene."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from mi_refgs.cli.command import Flag, Output, Rendering, Result, optional, separated
from mi_refgs.errors import InputError
from mi_refgs.io.progress import command_line
from mi_refgs.synthesis.options import DatasetOptions


@dataclass(frozen=True, kw_only=True)
class Dataset:
    """Writes images, materials, normals, depth, environment map and cameras, all path-traced by Mitsuba.

    example:
      refgs dataset scenes/glossy_demo.xml -o data/glossy --views 80 --size 160 --samples 128"""

    scene: Annotated[Positional[Path], arg(metavar="SCENE.xml")]
    """Mitsuba scene with an environment emitter, or lamps"""
    output: Output  # folder of the data set; an interrupted run is continued
    size: Annotated[str, arg(metavar="S|WxH")] = "160"  # pixels per side, or width and height
    relight: Annotated[tuple[Path, ...], optional("ENV …")] = ()
    """trace the test views under these maps, too, into relight/NAME; may be added later"""
    overwrite: Flag = False  # replace a data set that was made with other settings
    image: DatasetOptions = DatasetOptions()
    common: Rendering = Rendering()

    def run(self) -> Result:
        from mi_refgs.synthesis.make_dataset import make_dataset

        size = [int(part) if part.isdecimal() else 0 for part in self.size.lower().split("x")]
        if len(size) > 2 or not all(size):
            what = f"{self.size!r}: give pixels per side, or WIDTHxHEIGHT"
            raise InputError(what, "--size", remedy="such as 160")
        resolution = (size[0], size[1]) if len(size) == 2 else size[0]
        image = vars(self.image) | {"size": resolution, "objects": separated(self.image.objects)}
        image |= {"relight": self.relight, "overwrite": self.overwrite}
        folder = make_dataset(self.scene, self.output, **image)
        train, test = (len(list((folder / split).glob("r_*.png"))) for split in ("train", "test"))
        lights = sorted(path.parent.name for path in folder.glob("relight/*/transforms_test.json"))
        data = {"dataset": str(folder), "train_views": train, "test_views": test, "size": resolution}
        text = (
            f"{folder}: {train} training and {test} test views"
            f"{', the latter also under ' if lights else ''}{', '.join(lights)}; "
            f"next: {command_line('train', folder, '-o', f'runs/{folder.name}')}"
        )
        return Result({**data, "relight": lights}, text)
