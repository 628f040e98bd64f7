"""A finished fit without what its pictures do not need: rows, channels, harmonics, light, mesh.

Each candidate is dropped on trial and kept out if the pictures of all training views stay within a limit.
Nothing is fitted again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.constants import PRUNE_LIMIT
from mi_refgs.data.dataset import Dataset
from mi_refgs.errors import InputError
from mi_refgs.evaluation.metrics import psnr
from mi_refgs.evaluation.speed import milliseconds
from mi_refgs.io.images import PSNR_MAX
from mi_refgs.kernels.device import upload
from mi_refgs.render.display import displayed
from mi_refgs.runs.trained_scene import Pruned, TrainedScene
from mi_refgs.shade.options import TRACED, ShadingOptions
from mi_refgs.splat import Camera, splat
from mi_refgs.surfels.attributes import attribute, sh_columns
from mi_refgs.surfels.ply import encode_ply
from mi_refgs.surfels.table import Surfels

ROWS_STEP = 1 / 1000
"""Share of the rows to which the number of those that go is searched."""

Tell = Callable[[str], None]


@dataclass(frozen=True)
class Trial:
    """Something that was left out on trial."""

    what: str
    psnr: float  # dB, of the worst view, or of the first below the limit
    dropped: bool


def contributions(surfels: Surfels, cameras: Sequence[Camera]) -> np.ndarray:
    """Blended weight Σ w of each row over all pixels of the views (N,) float64, in pixels; 0 where unseen.

    The gradient of a blended feature Σ w f with respect to f.
    """
    table, total = surfels.detach(), np.zeros(surfels.count)
    for camera in cameras:
        feature = dr.opaque(mi.Float, 0, table.count)
        dr.enable_grad(feature)
        dr.backward(dr.sum(splat(table, [feature], camera).features[0]))
        total += np.array(dr.grad(feature), dtype=np.float64)
    return total


def prune(
    whole: TrainedScene,
    train: Dataset,
    test: Dataset | None = None,
    limit: float = PRUNE_LIMIT,
    tell: Tell = lambda _: None,
) -> tuple[TrainedScene, dict[str, Any]]:
    """The scene without what its pictures do not need, and a report that JSON can hold.

    First what the shading never reads goes. Then, on trial and in this order: the traced mesh, channels that
    the model can do without, degrees of harmonics, which every row pays for, and as many rows of the least
    blended weight as the training views allow.
    The worst training view stays at `limit` dB (above 0, at most 100: the same to rounding) or above, both
    its displayed picture and its alpha. `tell` is called with every trial.

    The report has rows, channels and bytes of the PLY file `before` and `after`, the PSNR against the whole
    scene over the training and the test views, the median time of a frame, and the trials. Raises InputError
    for a limit out of range.
    """
    if not 0 < limit <= PSNR_MAX:
        raise InputError(
            f"--limit: {limit:g} dB is out of range; give a number above 0, at most {PSNR_MAX:g}"
        )
    search = _Search(_unread(whole), _Pictures(whole, train), tell)
    if search.scene.surfels.count:
        weight = contributions(whole.surfels, search.pictures.cameras)
        _drop_terms(search, limit)
        _drop_rows(search, weight, limit)
    pruned = search.scene
    compared = {"train": search.pictures.all(pruned)}
    if test is not None:
        compared["test"] = _Pictures(whole, test).all(pruned)
    report: dict[str, Any] = {"limit": limit, "before": _size(whole), "after": _size(pruned)}
    for split, values in compared.items():
        report[split] = {"views": len(values), "worst": min(values), "mean": float(np.mean(values))}
    views = [scene.renderer(aovs=False) for scene in (whole, pruned)]
    for name, time in zip(
        ("before", "after"), milliseconds(views, search.pictures.cameras, train), strict=True
    ):
        report[name]["ms_per_frame"] = time
    report["trials"] = [asdict(trial) for trial in search.trials]
    note = Pruned(whole.surfels.count, limit, report["train"]["worst"])
    return replace(pruned, pruned=note), report


# ---------------- what may go ----------------


def _unread(scene: TrainedScene) -> TrainedScene:
    """The scene without the light and the mesh that its shading does not ask for."""
    light = None if scene.shading.model.light == "none" else scene.light
    return replace(scene, light=light, mesh=scene.mesh if scene.shading.occlusion else None)


def _drop_terms(search: _Search, limit: float) -> None:
    """Try the scene without tracing, without each channel that it can do without, with fewer harmonics."""
    shading = search.scene.shading
    if shading.occlusion:
        defaults = {name: getattr(ShadingOptions, name) for name in TRACED}
        untraced = replace(shading, occlusion=False, **defaults)
        search.attempt("mesh", replace(search.scene, mesh=None, shading=untraced), limit)
    surfels = search.scene.surfels
    needed = {*surfels.primitive.widths, *shading.channels}
    for name in [name for name in surfels.raw if name not in needed]:
        raw = {other: values for other, values in search.scene.surfels.raw.items() if other != name}
        search.attempt(name, search.with_surfels(Surfels(raw)), limit)
    for name in [name for name in search.scene.surfels.raw if attribute(name).harmonics]:
        for degree in reversed(range(search.scene.surfels.sh_degree(name))):
            arrays = search.scene.surfels.to_numpy()
            arrays[name] = np.ascontiguousarray(arrays[name][:, : sh_columns(degree)])
            lower = search.with_surfels(Surfels.from_numpy(arrays))
            if not search.attempt(f"{name} above degree {degree}", lower, limit):
                break


def _drop_rows(search: _Search, weight: np.ndarray, limit: float) -> None:
    """Drop as many rows of the least weight as the limit allows, by bisection; one stays at least."""
    table, order = search.scene.surfels, np.argsort(weight, kind="stable")

    def without(count: int) -> bool:
        kept = upload(np.sort(order[count:]), mi.UInt32)
        return search.attempt(f"{count} surfels", search.with_surfels(table.gather(kept)), limit)

    unseen = min(int(np.count_nonzero(weight == 0)), table.count - 1)
    if unseen and not without(unseen):
        return
    most, too_many = unseen, table.count
    while too_many - most > max(1, round(ROWS_STEP * table.count)):
        middle = (most + too_many) // 2
        most, too_many = (middle, too_many) if without(middle) else (most, middle)


@dataclass
class _Search:
    """The scene so far, and what was tried."""

    scene: TrainedScene
    pictures: _Pictures
    tell: Tell

    def __post_init__(self) -> None:
        self.trials: list[Trial] = []

    def with_surfels(self, surfels: Surfels) -> TrainedScene:
        """The scene so far with another table."""
        return replace(self.scene, surfels=surfels)

    def attempt(self, what: str, candidate: TrainedScene, limit: float) -> bool:
        """Take the candidate if no picture falls below the limit."""
        worst = self.pictures.worst(candidate, limit)
        trial = Trial(what, worst, worst >= limit)
        self.trials.append(trial)
        self.tell(f"without {what}: {worst:.1f} dB, {'dropped' if trial.dropped else 'stays'}")
        if trial.dropped:
            self.scene = candidate
        return trial.dropped


# ---------------- the measure ----------------


class _Pictures:
    """What the views of a split show of the whole scene: four float32 planes a view are kept."""

    def __init__(self, whole: TrainedScene, data: Dataset) -> None:
        self.data = data
        self.cameras = [view.camera() for view in data.views]
        self.order = list(range(len(self.cameras)))
        self.whole = [planes for _, planes in self._shown(whole)]

    def worst(self, scene: TrainedScene, limit: float) -> float:
        """The lowest PSNR; of the first view below the limit, if there is one.

        That view is the first to be looked at the next time.
        """
        lowest = PSNR_MAX
        for place, planes in self._shown(scene):
            lowest = min(lowest, self._psnr(place, planes))
            if lowest < limit:
                self.order.remove(place)
                self.order.insert(0, place)
                break
        return lowest

    def all(self, scene: TrainedScene) -> list[float]:
        """The PSNR of every view."""
        return [self._psnr(place, planes) for place, planes in self._shown(scene)]

    def _shown(self, scene: TrainedScene) -> Iterator[tuple[int, np.ndarray]]:
        """Place of a view in the split, and its planes (4, H·W): displayed colour, and alpha."""
        view = scene.renderer(aovs=False)
        for place in list(self.order):
            frame, camera = view(self.cameras[place]), self.cameras[place]
            shown = [*displayed(frame, self.data.background, self.data.is_linear_radiance), frame.alpha]
            dr.eval(shown)
            pixels = camera.width * camera.height
            yield place, np.stack([np.broadcast_to(np.array(x, np.float32), pixels) for x in shown])

    def _psnr(self, place: int, planes: np.ndarray) -> float:
        """PSNR in dB of the picture, or of alpha, which other backgrounds show, where that is lower."""
        whole = self.whole[place]
        return min(psnr(planes[:3], whole[:3]), psnr(planes[3], whole[3]))


def _size(scene: TrainedScene) -> dict[str, Any]:
    surfels = scene.surfels
    return {
        "surfels": surfels.count,
        "channels": {name: int(values.shape[1]) for name, values in surfels.raw.items()},
        "light": scene.light is not None,
        "mesh": scene.mesh is not None,
        "ply_bytes": len(encode_ply(surfels)),
    }
