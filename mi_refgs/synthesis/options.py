"""Options of a path-traced data set; `refgs dataset` reads its own from here."""

import hashlib
import json
import math
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Suppress, UseAppendAction, arg

from mi_refgs.errors import InputError, abbreviated
from mi_refgs.io.files import require_file

optional = partial(arg, help_behavior_hint="")
Count = Annotated[int, arg(metavar="N")]
Range = tuple[float, float]
OPTIONS = {"spp": "--samples", "test_views": "--test-views", "resolution": "--size", "height": "--size"}
OPTIONS |= {"objects": "--object", "scene": "the scene file", "scene_sha256": "the scene file"}
"""Options of `refgs dataset` that set a field, or the scene file."""
WHOLE = (lambda n: n >= 1 and n % 1 == 0, "give a whole number of at least 1")
RANGES: dict[str, tuple[Callable[[Any], bool], str]] = {
    **dict.fromkeys(("views", "spp", "max_depth", "test_views"), WHOLE),
    "define": (lambda given: all("=" in text for text in given), "give NAME=VALUE"),
    "seed": (lambda n: n >= 0 and n % 1 == 0, "give a whole number of at least 0"),
    "environment_height": (lambda n: n >= 0 and n % 1 == 0, "give a whole number of at least 0"),
    "resolution": (lambda size: len(size) == 2 and all(map(WHOLE[0], size)), "give pixels, or WIDTH, HEIGHT"),
    "elevation": (lambda e: -90 < e[0] < e[1] < 90, "give two angles in degrees, -90 < low < high < 90"),
    "azimuth": (
        lambda a: -360 <= a[0] < a[1] <= a[0] + 360,
        "give two angles in degrees, -360 <= low < high <= low + 360",
    ),
    "fov": (lambda angle: 0 < angle < 170, "give degrees between 0 and 170"),
    "distance": (lambda d: 0 < d[0] <= d[1] < math.inf, "give two lengths, 0 < NEAR <= FAR"),
}
"""What each option must be, and the remedy; None of those that may be None is fine."""


@dataclass(frozen=True, kw_only=True)
class DatasetOptions:
    """What determines the pixels of a data set, beside its scene."""

    views: Count = 80  # training views
    test_views: Annotated[int | None, optional(metavar="N")] = None
    """test views (default: a quarter of --views)"""
    size: Annotated[int | tuple[int, int], Suppress] = 160  # pixels per side, or width and height
    spp: Annotated[int, arg(metavar="N", name="samples")] = 128
    """samples per pixel; path tracing is noisy, so that the default is larger than that of other commands"""
    objects: Annotated[tuple[str, ...], optional(metavar="ID …", name="object")] = ()
    """shapes of the object, among others: opaque images, ground truth of these shapes only (default: all but
    lamps; all but floors, walls and domes much larger than the rest, if there are any)"""
    define: Annotated[UseAppendAction[tuple[str, ...]], optional(metavar="NAME=VALUE", aliases=("-D",))] = ()
    """value of the scene's parameter $NAME, as in `mitsuba -D`; may be repeated"""
    distance: Annotated[Range | None, optional(metavar="NEAR FAR")] = None
    """distance of cameras from the object's centre, scene units (default: the object fills the image)"""
    elevation: Annotated[Range, arg(metavar="LOW HIGH")] = (-30.0, 80.0)  # elevation of cameras, degrees
    azimuth: Annotated[Range, arg(metavar="LOW HIGH")] = (0.0, 360.0)
    """azimuth of cameras, degrees from +x, counter-clockwise seen from above; less than 360° before a wall"""
    fov: Annotated[float, arg(metavar="DEG")] = 40.0  # field of view of the shorter side
    seed: Count = 0  # seed of cameras and paths
    max_depth: Count = 6  # largest path depth
    environment_height: Annotated[int, Suppress] = 256  # rows of environment.exr; 0 writes none

    @property
    def resolution(self) -> tuple[int, int]:
        return (self.size, self.size) if isinstance(self.size, int) else self.size

    @property
    def focal(self) -> float:
        """Focal length, pixels."""
        return 0.5 * min(self.resolution) / math.tan(math.radians(self.fov) / 2)

    def count(self, split: str) -> int:
        if split == "train":
            return self.views
        return max(1, self.views // 4) if self.test_views is None else self.test_views

    def check(self, scene: Path) -> None:
        for field, (good, remedy) in RANGES.items():
            value = getattr(self, field)
            try:
                fine = good(value) if value is not None else field in ("test_views", "distance")
            except (TypeError, IndexError):  # another type
                fine = False
            if not fine:
                option = f"{field} ({OPTIONS[field]})" if field in OPTIONS else field
                raise InputError(f"{abbreviated(value)} is out of range", scene, option, remedy)

    def record(self, scene: Path) -> dict[str, Any]:
        """The content of dataset.json."""
        width, height = self.resolution
        values = vars(self) | {
            "scene": scene.name,
            "scene_sha256": scene_hash(scene, self.define),  # of the XML and the files in it
            "test_views": self.count("test"),
            "size": width,
            "height": 0 if height == width else height,
            "distance": self.distance or (0, 0),
        }
        del values["define"]
        content: dict[str, Any] = json.loads(json.dumps(values))  # tuples become lists
        return content


@dataclass(frozen=True)
class LightFile:
    """A lat-long map that replaces the environment of a scene."""

    path: Path
    name: str  # of the folder of its relit views
    sha256: str

    @staticmethod
    def of(path: Path) -> "LightFile":
        require_file(path)
        name = re.sub(r"[^0-9A-Za-z_-]+", "_", path.stem).strip("_") or "light"
        return LightFile(path, name, hashlib.sha256(path.read_bytes()).hexdigest())


def scene_hash(scene: Path, define: Sequence[str] = ()) -> str:
    """SHA-256 of a scene's XML, the files in it and in scenes that it includes, and parameters; raises
    InputError if one is no XML file."""
    if not scene.is_file():
        raise InputError("missing", scene, "scene", "give the path of a Mitsuba XML file")
    digest, folders, files = hashlib.sha256(), [scene.parent], [scene]
    for file in files:  # which grow
        content = file.read_bytes()
        digest.update(content + "".join(define if file == scene else ()).encode())
        if file != scene and file.suffix.lower() != ".xml":
            continue
        try:
            root = ElementTree.fromstring(content)
        except ElementTree.ParseError as error:
            raise InputError(f"not XML ({error})", file, "scene", "give a Mitsuba scene") from error
        folders += [scene.parent / e.get("value", "") for e in root.iter("path")]
        names = [e.get("value", "") for e in root.iter("string") if e.get("name") == "filename"]
        names += [e.get("filename", "") for e in root.iter("include")]
        found = (folder / name for name in names for folder in (*folders, file.parent))
        files += [path for path in dict.fromkeys(found) if path.is_file() and path not in files]
    return digest.hexdigest()
