"""A table of a fit as its parameters: edits of the rows, which moments and statistics follow."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.errors import InputError
from mi_refgs.fitting.refine import TableEdit
from mi_refgs.kernels.device import upload
from mi_refgs.runs.parameters import channels_of
from mi_refgs.surfels.table import Surfels

if TYPE_CHECKING:
    from mi_refgs.fitting.train import Trainer


class Table:
    """The rows of the parameters whose names are `prefix` and a channel, and how their pixels moved."""

    def __init__(self, trainer: Trainer, prefix: str = "") -> None:
        self.trainer, self.prefix = trainer, prefix
        self.gradient_sum: Any = None  # of each surfel since it was densified last, and of how many views
        self.gradient_count: Any = None

    @property
    def surfels(self) -> Surfels:
        """The table, attached to the leaves that the optimiser owns."""
        return Surfels(channels_of(self.trainer.params, self.prefix))

    @property
    def max_count(self) -> int:
        """Most rows that the method allows."""
        method = self.trainer.method
        options = method.surroundings if self.prefix else method.surfels
        assert options is not None
        return options.max_count

    @property
    def gradient(self) -> np.ndarray:
        """Mean length of the gradients that were observed (N,); waits for the device."""
        mean: np.ndarray = self.gradient_sum.numpy() / np.maximum(self.gradient_count.numpy(), 1)
        return mean

    def clear(self) -> None:
        """Forget the statistics."""
        count = self.surfels.count
        self.gradient_sum = dr.opaque(mi.Float, 0, count)
        self.gradient_count = dr.opaque(mi.Float, 0, count)

    def observe(self, length: Any) -> None:
        """Take in the lengths of a step's gradients with respect to places on the screen, in NDC units."""
        seen = (length > 0) & dr.isfinite(length)
        self.gradient_sum += dr.select(seen, length, 0.0)
        self.gradient_count += dr.select(seen, mi.Float(1), 0)
        dr.schedule(self.gradient_sum, self.gradient_count)

    def adopt(self, edit: TableEdit) -> None:
        """Put an edited table in place of the present one; moments and statistics follow the rows."""
        edit = edit.ordered()
        parent, fresh = upload(edit.parent, mi.UInt32), upload(edit.fresh, mi.Bool)
        self.replace(edit.surfels)
        self.trainer.optimiser.gather(parent, self._names(edit.surfels), fresh)
        self.gradient_sum = dr.select(fresh, 0, dr.gather(mi.Float, self.gradient_sum, parent))
        self.gradient_count = dr.select(fresh, 0, dr.gather(mi.Float, self.gradient_count, parent))
        dr.eval(self.gradient_sum, self.gradient_count)

    def remove(self, rows: np.ndarray) -> None:
        """Take surfels out of the table; raises InputError if none would be left."""
        surfels = self.surfels
        parent = np.delete(np.arange(surfels.count), rows)
        if not len(parent):
            raise InputError("surfels: none of them is finite; lower the rates (--set rates.…)")
        index = upload(parent, mi.UInt32)
        self.replace(surfels.gather(index))
        self.trainer.optimiser.gather(index, self._names(surfels))
        self.gradient_sum = dr.gather(mi.Float, self.gradient_sum, index)
        self.gradient_count = dr.gather(mi.Float, self.gradient_count, index)

    def replace(self, surfels: Surfels, cleared: tuple[str, ...] = ()) -> None:
        """Put a table in place of the present one; `cleared` channels lose their moments."""
        fit = self.trainer
        fit.params.update({self.prefix + name: tensor for name, tensor in surfels.raw.items()})
        dr.enable_grad([fit.params[name] for name in self._names(surfels)])
        for name in cleared:
            if self.prefix + name in fit.params:
                fit.optimiser.reset(self.prefix + name)

    def state(self) -> dict[str, np.ndarray]:
        """The statistics, for a checkpoint."""
        return {
            f"{self.prefix}gradient_sum": self.gradient_sum.numpy(),
            f"{self.prefix}gradient_count": self.gradient_count.numpy(),
        }

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Go on where `state` was taken."""
        self.gradient_sum = upload(state[f"{self.prefix}gradient_sum"])
        self.gradient_count = upload(state[f"{self.prefix}gradient_count"])

    def _names(self, surfels: Surfels) -> list[str]:
        """The parameters of its channels."""
        return [self.prefix + name for name in surfels.raw]
