"""Prune a finished fit: remove surfels, attributes, SH degrees, light and mesh that its images do not need.

Each candidate is removed on trial and stays removed if the images of all training views stay within a limit.
Nothing is fitted again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.constants import PRUNE_LIMIT
from mi_refgs.data.dataset import Dataset
from mi_refgs.errors import InputError
from mi_refgs.evaluation.metrics import frame_milliseconds, psnr
from mi_refgs.io.images import PSNR_MAX
from mi_refgs.kernels.device import upload
from mi_refgs.render.display import displayed
from mi_refgs.runs.trained_scene import Pruned, TrainedScene
from mi_refgs.shade.options import TRACED, ShadingOptions
from mi_refgs.splat.weights import blended_weights
from mi_refgs.surfels.attributes import attribute, sh_columns
from mi_refgs.surfels.ply import encode_ply
from mi_refgs.surfels.table import Surfels

COUNT_STEP = 1 / 1000  # fraction of the surfels to which the number of those that are removed is bisected


def prune(
    whole: TrainedScene,
    train: Dataset,
    test: Dataset | None = None,
    limit: float = PRUNE_LIMIT,
    tell: Callable[[str], None] = lambda _: None,
) -> tuple[TrainedScene, dict[str, Any]]:
    """Remove what the images of a scene do not need; return the pruned scene and a report for JSON.

    First what the shading never reads is removed. Then, on trial and in this order: the traced mesh, optional
    attributes, SH degrees, and as many surfels of the least blended weight as the training views allow. In
    the worst training view, the displayed image and alpha keep a PSNR of `limit` dB or more (above 0, at most
    100: the same to rounding). `tell` is called with every trial.

    The report has surfels, attributes and bytes of the PLY file `before` and `after`, the PSNR against the
    whole scene over the training and the test views, the median time per frame, and the trials. Raises
    InputError for a limit out of range.
    """
    if not 0 < limit <= PSNR_MAX:
        allowed = f"give a number above 0, at most {PSNR_MAX:g}"
        raise InputError(f"--limit: {limit:g} dB is out of range; {allowed}")

    # What shading never reads, then trials.
    images = _WholeImages(whole, train)
    light = None if whole.shading.model.light == "none" else whole.light
    unread = replace(whole, light=light, mesh=whole.mesh if whole.shading.occlusion else None)
    search = _Search(unread, images, limit, tell)
    if unread.surfels.count:
        search.drop_optional()
        weights = [blended_weights(whole.surfels, camera)[0] for camera in images.cameras]
        search.drop_surfels(np.sum(weights, axis=0))
    pruned = search.scene

    # The report.
    report: dict[str, Any] = {"limit": limit, "before": _size(whole), "after": _size(pruned)}
    compared = {"train": images.all(pruned)}
    if test is not None:
        compared["test"] = _WholeImages(whole, test).all(pruned)
    for split, values in compared.items():
        report[split] = {"views": len(values), "worst": min(values), "mean": float(np.mean(values))}
    renderers = [scene.renderer(aovs=False) for scene in (whole, pruned)]
    times = frame_milliseconds(renderers, images.cameras, train)
    report["before"]["ms_per_frame"], report["after"]["ms_per_frame"] = times
    report["trials"] = search.trials
    note = Pruned(whole.surfels.count, limit, report["train"]["worst"])
    return replace(pruned, pruned=note), report


def _size(scene: TrainedScene) -> dict[str, Any]:
    surfels = scene.surfels
    return {
        "surfels": surfels.count,
        "channels": {name: int(values.shape[1]) for name, values in surfels.raw.items()},
        "light": scene.light is not None,
        "mesh": scene.mesh is not None,
        "ply_bytes": len(encode_ply(surfels)),
    }


@dataclass
class _Search:
    """The pruned scene so far, and the trials."""

    scene: TrainedScene
    images: _WholeImages
    limit: float  # dB
    tell: Callable[[str], None]
    trials: list[dict[str, Any]] = field(default_factory=list)
    """`what` was removed on trial, `psnr` in dB of the worst view or the first below the limit, `dropped`."""

    def attempt(self, what: str, **changes: Any) -> bool:
        """Change fields of the scene if no image falls below the limit; return whether that is so."""
        candidate = replace(self.scene, **changes)
        worst = self.images.worst(candidate, self.limit)
        dropped = worst >= self.limit
        self.trials.append({"what": what, "psnr": worst, "dropped": dropped})
        self.tell(f"without {what}: {worst:.1f} dB, {'dropped' if dropped else 'stays'}")
        if dropped:
            self.scene = candidate
        return dropped

    def drop_optional(self) -> None:
        """Try the scene without tracing, without each optional attribute, with lower SH degrees."""
        shading = self.scene.shading
        if shading.occlusion:
            defaults = {name: getattr(ShadingOptions, name) for name in TRACED}
            self.attempt("mesh", mesh=None, shading=replace(shading, occlusion=False, **defaults))
        needed = {*self.scene.surfels.primitive.widths, *shading.required_attributes}
        for name in [name for name in self.scene.surfels.raw if name not in needed]:
            raw = {other: values for other, values in self.scene.surfels.raw.items() if other != name}
            self.attempt(name, surfels=Surfels(raw))
        for name in [name for name in self.scene.surfels.raw if attribute(name).harmonics]:
            for degree in reversed(range(self.scene.surfels.sh_degree(name))):
                arrays = self.scene.surfels.to_numpy()
                arrays[name] = np.ascontiguousarray(arrays[name][:, : sh_columns(degree)])
                if not self.attempt(f"{name} above degree {degree}", surfels=Surfels.from_numpy(arrays)):
                    break

    def drop_surfels(self, weight: np.ndarray) -> None:
        """Drop as many surfels of the least weight (N,) as the limit allows, by bisection; one stays."""
        table, order = self.scene.surfels, np.argsort(weight, kind="stable")

        def without(count: int) -> bool:
            kept = upload(np.sort(order[count:]), mi.UInt32)
            return self.attempt(f"{count} surfels", surfels=table.gather(kept))

        unseen = min(int(np.count_nonzero(weight == 0)), table.count - 1)
        if unseen and not without(unseen):
            return
        most, too_many = unseen, table.count
        while too_many - most > max(1, round(COUNT_STEP * table.count)):
            middle = (most + too_many) // 2
            most, too_many = (middle, too_many) if without(middle) else (most, middle)


class _WholeImages:
    """Images of the whole scene in the views of a split: four float32 planes per view are kept."""

    def __init__(self, whole: TrainedScene, data: Dataset) -> None:
        self.data = data
        self.cameras = [view.camera() for view in data.views]
        self.order = list(range(len(self.cameras)))
        self.whole = [planes for _, planes in self._render(whole)]

    def worst(self, scene: TrainedScene, limit: float) -> float:
        """Return the lowest PSNR in dB, or that of the first view below the limit.

        That view is the first to be rendered the next time.
        """
        lowest = PSNR_MAX
        for index, planes in self._render(scene):
            lowest = min(lowest, self._psnr(index, planes))
            if lowest < limit:
                self.order.remove(index)
                self.order.insert(0, index)
                break
        return lowest

    def all(self, scene: TrainedScene) -> list[float]:
        """Return the PSNR of every view in dB."""
        return [self._psnr(index, planes) for index, planes in self._render(scene)]

    def _render(self, scene: TrainedScene) -> Iterator[tuple[int, np.ndarray]]:
        """Yield the index of a view and its planes (4, H*W): displayed colour, and alpha."""
        render = scene.renderer(aovs=False)
        for index in list(self.order):
            camera = self.cameras[index]
            frame = render(camera)
            planes = [*displayed(frame, self.data.background, self.data.is_linear_radiance), frame.alpha]
            dr.eval(planes)
            pixels = camera.width * camera.height
            yield index, np.stack([np.broadcast_to(np.array(x, np.float32), pixels) for x in planes])

    def _psnr(self, index: int, planes: np.ndarray) -> float:
        """Return the PSNR in dB of the image or of alpha, which other backgrounds show; the lower one."""
        whole = self.whole[index]
        return min(psnr(planes[:3], whole[:3]), psnr(planes[3], whole[3]))
