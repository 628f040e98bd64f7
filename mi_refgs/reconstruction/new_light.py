"""New lights for relighting, and the test views of a data set under them. The first row of a panorama is its
zenith, Mitsuba's y axis; in the world of a scene z is up. Maps that this package writes (environment.exr,
envmap.exr) are in world directions already."""

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np

from mi_refgs.data.region import REGION_FILE
from mi_refgs.errors import InputError
from mi_refgs.io.files import require_file
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.light.light_file import read_radiance
from mi_refgs.shade.light.maps import READ_ROWS, require_range, world_light
from mi_refgs.synthesis.settings import RELIGHT, recorded_lights


@dataclass(frozen=True)
class NewLight:
    """A lat-long map file as the light of a scene."""

    path: Path  # or str
    world: bool = False  # whether the map is in world directions; otherwise its first row is +z
    rotate: float = 0.0  # degrees about +z, counter-clockwise seen from above
    exposure: float = 0.0  # stops: radiance times 2^exposure

    def __post_init__(self) -> None:
        object.__setattr__(self, "path", Path(self.path))
        require_file(self.path)
        require_range(self.rotate, self.exposure)

    @property
    def identity(self) -> str:
        """Return all that the radiance depends on: a hash of the file, its orientation and its exposure."""
        digest = hashlib.sha256(self.path.read_bytes()).hexdigest()
        return f"{digest} world={self.world} rotate={self.rotate % 360!r} exposure={self.exposure!r}"

    def read(self) -> EnvironmentLight:
        """Read the light, of at most FIXED_HEIGHT rows."""
        return world_light(read_radiance(self.path, READ_ROWS), self.world, self.rotate, self.exposure)


AnyLight: TypeAlias = NewLight | EnvironmentLight | str | Path | np.ndarray  # linear radiance (h, w, 3)


def any_light(light: AnyLight, world: bool, rotate: float, exposure: float) -> EnvironmentLight:
    """Convert a light, its file or its radiance (h, w, 3) to a light; options as in `NewLight`. An
    `EnvironmentLight` is in world directions already. Raises InputError for options of a `NewLight`."""
    if isinstance(light, NewLight):
        if world or rotate or exposure:
            remedy = "give them to NewLight"
            raise InputError("it has its own world, rotate and exposure", "light", "NewLight", remedy)
        return light.read()
    if isinstance(light, str | Path):
        return NewLight(Path(light), world, rotate, exposure).read()
    if isinstance(light, EnvironmentLight):
        return world_light(light.radiance().numpy(), True, rotate, exposure)
    return world_light(light, world, rotate, exposure)


def truth_under(light: NewLight, data: Path) -> tuple[Path, NewLight] | None:
    """Find the data set with test views under this light; return it and the light of its renders, or None. It
    must be the map of `refgs dataset --relight` by content, or in `world` environment.exr of a data set
    without a room; a rotated light has no ground truth."""
    content = light.path.read_bytes()
    digest = hashlib.sha256(content).hexdigest()
    lights = recorded_lights(data / "dataset.json")
    own_views = [] if (data / REGION_FILE).is_file() else [data]
    for folder in (*own_views, *sorted((data / RELIGHT).glob("*"))):
        map_ = folder / "environment.exr"
        if not (map_.is_file() and (folder / "transforms_test.json").is_file()):
            continue
        recorded = lights.get(folder.name) if folder != data else None  # `data` may have a light's name
        own = map_.read_bytes() == content
        if own and not light.world:
            raise InputError("this map is in world directions", light.path, "--envmap", "add --world")
        if (own if light.world else recorded == digest) and not light.rotate % 360:
            return folder, NewLight(map_, True, 0.0, light.exposure)
    return None
