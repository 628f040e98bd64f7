"""Errors of pictures and gradients against the float64 oracle, on a part of the view."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from benchmarks.splatting.workload import Workload
from benchmarks.stability.case import Case, sky
from benchmarks.stability.measure import measure
from mi_refgs.constants import tile_size
from mi_refgs.splat import list_by_tile, project

MARGIN = 16
"""Pixels around the part whose surfels the oracle looks at too: those that wrongly miss a tile are seen."""
CLASSES = ("position", "rotation", "scale", "opacity", "radiance_sh")


def crop(workload: Workload, size: int, margin: int = 0) -> Workload:
    """The same surfels in a part of the view, a third from its left and upper edge; tiles stay in place."""
    p = workload.pinhole
    size = min(size, p.width, p.height)
    tile = tile_size(abs(p.fx))
    left, top = (
        step * (edge // 3 // step) - margin for step, edge in zip(tile, (p.width, p.height), strict=True)
    )
    size += 2 * margin
    return replace(workload, pinhole=replace(p, width=size, height=size, cx=p.cx - left, cy=p.cy - top))


def compare(workload: Workload, size: int) -> dict[str, float]:
    """Errors of the part, as `stability.measure` defines them; the oracle blends in the product's order.

    order: largest relative depth difference of two surfels in the wrong order where they show; left_out:
    share of the pixels in the oracle's declared band; image: largest error of radiance and alpha;
    gradient_…: of each class of parameters.
    """
    around = crop(workload, size, MARGIN)
    lists = list_by_tile(project(around.surfels(), around.camera()), around.camera())
    near = np.unique(np.array(lists.surfel_from_pair))
    raw = {name: values[near] for name, values in workload.raw.items()}
    raw["radiance_sh"] = workload.features[near, :3] - 0.5
    part = crop(workload, size)
    case = Case("part", raw, part.pinhole, sky(), at="surfel", reflectance="radiance")
    row = measure(case, floors=False, book=False)
    found = {"order": row.order, "left_out": 1 - row.kept, "image": row.image, "maps": row.maps}
    return found | {f"gradient_{name}": row.gradients[name] for name in CLASSES}
