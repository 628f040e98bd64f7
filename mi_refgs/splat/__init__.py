"""The splatter: project surfels, list them by tile, composite features front to back."""

from collections.abc import Sequence
from functools import reduce

from mi_refgs.kernels.timing import phase
from mi_refgs.splat.camera import Camera as Camera
from mi_refgs.splat.composite import Composited as Composited, composite as composite
from mi_refgs.splat.tiles import TileLists as TileLists, list_by_tile as list_by_tile
from mi_refgs.surfels.primitives.primitive import Footprints
from mi_refgs.surfels.table import Surfels
from mi_refgs.types import Float


@phase("project")
def project(surfels: Sequence[Surfels], camera: Camera) -> Footprints:
    """Footprints of tables, one after the other; raises InputError if they are not splatted together."""
    tables = [table for table in surfels if table.count] or surfels[:1]
    return reduce(Footprints.followed_by, (table.primitive.project(table, camera) for table in tables))


def splat(
    surfels: Sequence[Surfels],
    features: list[Float],
    camera: Camera,
    turns: Sequence[Float] = (),
    few: int | None = None,
) -> Composited:
    """Splat features of tables, such as an object and its surroundings, in one sort to maps of H·W pixels in
    raster order; derivatives as in `composite`. The first T features gain `turns` (2 T of them) per standard
    deviation of a surfel, along u, then along v. All but the first `few` are zero in the tables after the
    first, and are not blended where only these are."""
    if not any(table.count for table in surfels):
        return Composited.nothing(len(features), camera)
    footprints = project(surfels, camera)
    begin = None if few is None else (surfels[0].count, few)
    lists = list_by_tile(footprints, camera, features, turns, begin)
    return composite(footprints, features, lists, [*turns])
