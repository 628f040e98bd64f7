"""Trials on validation views: whether spherical-harmonic colour suffices, and whether more surfels pay."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

from mi_refgs import methods
from mi_refgs.errors import InputError
from mi_refgs.fitting.decide import Decision, Trial
from mi_refgs.fitting.events.densify import fill
from mi_refgs.fitting.train import Trainer
from mi_refgs.methods.extensions import LOSSES, register_event
from mi_refgs.methods.method import Method
from mi_refgs.methods.read import table_at


@register_event
@dataclass(frozen=True)
class ColourAlone(Decision, Trial):
    """Tries a method without light and materials: a matt scene needs neither."""

    name: ClassVar[str] = "colour_alone"
    gain: ClassVar[float] = -0.1  # it costs less, and may lose a little
    method: str  # the other method, by its name or path

    def trial_of(self, component: str) -> Trial:
        return self

    def chosen(self, method: Method, component: str) -> Method:
        """The other method, with the length, the size of images and the settings of this one, but for those
        of tables that the other has not. Raises InputError for a light that is given, which it has not."""
        if method.light is not None and (method.light.turntable or method.light.name != "learnt"):
            raise InputError("it is given", field="light")
        preset = method.preset or f"{method.iterations}:{method.surfels.max_count}"
        here = Path(method.file).parent  # of a method file that names another one
        plain = methods.plain(bare := methods.load(self.method, preset, folder=here))
        keys = [(text, text.partition("=")[0].strip().split(".")) for text in method.assignments]
        lost = [["loss", n] for n, x in LOSSES.items() if {*x.attributes} - {*bare.surfels.names}]
        fitting = [t for t, path in keys if table_at(plain, path[:-1]) is not None and path[:2] not in lost]
        other = methods.load(self.method, preset, fitting, here)
        kept = "iterations seed checkpoint_every preview_every log_every about name file preset assignments"
        own = {name: getattr(method, name) for name in kept.split()}
        read = method.data
        data = replace(other.data, downscale=read.downscale, images=read.images, background=read.background)
        surfels = replace(other.surfels, max_count=method.surfels.max_count)
        return replace(other, data=data, surfels=surfels, **own)


@register_event
@dataclass(frozen=True)
class MoreSurfels(Decision):
    """Doubles the largest number of surfels as long as that pays."""

    name: ClassVar[str] = "more_surfels"
    gain: ClassVar[float] = 0.15  # a part of what twice as many gain in the end
    # In their order; children of a split improve the images after about 100 iterations.
    doubling: tuple[Trial, ...]

    def components(self) -> Sequence[str]:
        return [f"surfels_{2 ** (i + 1)}x" for i in range(len(self.doubling))]

    def chosen(self, method: Method, component: str) -> Method:
        capacity = 2.0 ** (1 + self.components().index(component))
        return replace(method, surfels=replace(method.surfels, capacity=capacity))

    def trial_of(self, component: str) -> Trial:
        return self.doubling[self.components().index(component)]

    def begin(self, rival: Trainer) -> str:
        before = rival.surfels.count
        fill(rival)
        return "" if rival.surfels.count > before else "no surfels to split: densification has ended"

    def pending(self, decisions: Sequence[Mapping[str, Any]]) -> list[str]:
        """Those after a doubling that did not pay are decided, too."""
        mine = [row for row in decisions if row["component"] in self.components()]
        return super().pending(decisions) if all(row["stays"] for row in mine) else []
