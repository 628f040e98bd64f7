"""The splatter: project surfels, list them by tile, composite features front to back."""

from collections.abc import Sequence
from functools import reduce

from mi_refgs.kernels.timing import phase
from mi_refgs.splat.camera import Camera as Camera
from mi_refgs.splat.composite import Composited as Composited, composite, composite_compact
from mi_refgs.splat.tiles import TileLists as TileLists, list_by_tile
from mi_refgs.surfels.primitives.primitive import Footprints
from mi_refgs.surfels.table import Surfels
from mi_refgs.types import Float

Tables = Surfels | Sequence[Surfels]  # one table, or several in one sort: an object and its surroundings


def tables_of(surfels: Tables) -> list[Surfels]:
    """Return the tables as a list."""
    return [surfels] if isinstance(surfels, Surfels) else list(surfels)


def surfel_count(surfels: Tables) -> int:
    """Number of surfels in all tables."""
    return sum(table.count for table in tables_of(surfels))


@phase("project")
def project(surfels: Tables, camera: Camera) -> Footprints:
    """Footprints of tables, one after the other; raises InputError if they are not splatted together."""
    tables = tables_of(surfels)
    tables = [table for table in tables if table.count] or tables[:1]
    return reduce(Footprints.followed_by, (table.primitive.project(table, camera) for table in tables))


def splat(
    surfels: Tables,
    features: list[Float],
    camera: Camera,
    turns: Sequence[Float] = (),
    few: int | None = None,
) -> Composited:
    """Splat features of surfels to maps of H·W pixels in raster order; derivatives as in `composite`. The
    first T features gain `turns` (2 T of them) per standard deviation of a surfel, along u, then along v. All
    but the first `few` are zero in the tables after the first, and are not blended where only these are."""
    if surfel_count(surfels) == 0:
        return Composited.nothing(len(features), camera)
    footprints = project(surfels, camera)
    begin = None if few is None else (tables_of(surfels)[0].count, few)
    lists = list_by_tile(footprints, camera, features, turns, begin)
    return composite(footprints, features, lists, [*turns])


def splat_compact(
    surfels: Tables, features: list[Float], camera: Camera, depth: bool, turns: Sequence[Float] = ()
) -> Composited:
    """Splat as `composite_compact` does: only pixels near surfels, no derivatives."""
    if surfel_count(surfels) == 0:
        return Composited.nothing(len(features), camera, depth)
    return composite_compact(list_by_tile(project(surfels, camera), camera, features, turns), depth)
