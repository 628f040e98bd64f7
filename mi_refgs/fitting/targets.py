"""The images of a fit, kept on the device as far as memory allows."""

import math
from collections import OrderedDict
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.data.dataset import Dataset
from mi_refgs.data.images import CACHE_BYTES
from mi_refgs.data.view import View
from mi_refgs.fitting import losses
from mi_refgs.kernels.device import upload
from mi_refgs.kernels.memory import of_fit, require
from mi_refgs.methods.method import DataOptions, Method
from mi_refgs.render.display import srgb_from_linear
from mi_refgs.splat import Camera
from mi_refgs.types import Array, Bool, Float

BUDGET = 2**30  # bytes of targets that stay on the device: a thousand images of 200², or ten of 2000²
PIXEL_BYTES = 4 * 4 + 3  # three colours and alpha as float32, and a mask per colour


def require_memory(method: Method, data: Dataset) -> None:
    """Raise InputError if the fit requires more memory than there is."""
    size = max(((view.width, view.height) for view in data.views), key=math.prod, default=(0, 0))
    pixels, views, surfels = math.prod(size), len(data.views), method.surfels.most
    around = 0 if method.surroundings is None else method.surroundings.max_count
    images = min(views * pixels * 12, CACHE_BYTES) + min(views * pixels * PIXEL_BYTES, BUDGET)
    require(
        of_fit(math.prod(method.data.crop_of(*size)), surfels + around, images),
        f"fit: images of {pixels:,} pixels, {surfels:,} surfels at most",
        "read them smaller with --set data.downscale=N, or lower surfels.max_count",
    )


@dataclass(frozen=True)
class Target:
    """A training image on the device."""

    camera: Camera
    image: list[Float]  # three planes (H*W,), display-encoded
    clipped: list[Bool] | None  # where an 8-bit value only means "at least this bright"
    alpha: Float | None  # (H*W,)

    @property
    def size(self) -> tuple[int, int]:
        return self.camera.width, self.camera.height

    @staticmethod
    def of(view: View, background: np.ndarray) -> "Target":
        """Upload a view; `background` (3,) is in the colour space of its image."""
        loaded = view.load()
        planes = [upload(loaded.image[..., i]) for i in range(3)]
        image = [srgb_from_linear(plane) for plane in planes] if view.is_linear_radiance else planes
        alpha = None if loaded.alpha is None else upload(loaded.alpha)
        clipped = None if view.is_linear_radiance else losses.saturated(image, alpha, map(float, background))
        target = Target(view.camera(), image, clipped, alpha)
        dr.eval(target.image, target.clipped, target.alpha)
        return target

    def cropped(self, x: int, y: int, width: int, height: int) -> "Target":
        """The part from column x and row y on."""
        camera = self.camera.window(x, y, width, height)
        index = camera.image_index(dr.arange(mi.UInt32, width * height))

        def part(plane: Array) -> Array:
            return None if plane is None else dr.gather(type(plane), plane, index)

        clipped = None if self.clipped is None else [part(plane) for plane in self.clipped]
        target = Target(camera, [part(plane) for plane in self.image], clipped, part(self.alpha))
        dr.eval(target.image, target.clipped, target.alpha)
        return target


class Targets:
    """Targets by the index of their view; the most recently used ones stay on the device."""

    def __init__(self, data: Dataset, options: DataOptions, budget: int = BUDGET) -> None:
        self.data, self.options, self.budget = data, options, budget
        self._kept: OrderedDict[tuple[int, int], Target] = OrderedDict()
        self._bytes = 0
        sizes = [view.width * view.height for view in data.views]
        wanted = [(i, 1) for i in range(len(sizes))]
        wanted += [(i, c.block) for c in options.coarse for i, size in enumerate(sizes) if c.applies(size)]
        if sum(PIXEL_BYTES * sizes[i] // block**2 for i, block in {*wanted}) <= budget:
            for index, block in wanted:
                self._target(index, block)

    def at(self, iteration: int, index: int) -> Target:
        """The target of a view in a (1-based) iteration, whose images may be coarse."""
        view = self.data.views[index]
        return self._target(index, self.options.block_at(iteration, view.width * view.height))

    def _target(self, index: int, block: int) -> Target:
        if (key := (index, block)) in self._kept:
            self._kept.move_to_end(key)
            return self._kept[key]
        target = Target.of(self.data.views[index].averaged(block), self.data.background)
        self._kept[key] = target
        self._bytes += PIXEL_BYTES * len(target.image[0])
        while self._bytes > self.budget and len(self._kept) > 1:
            self._bytes -= PIXEL_BYTES * len(self._kept.popitem(last=False)[1].image[0])
        return target
