"""Images through a sensor's film, and their derivatives."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_refgs.errors import InputError
from mi_refgs.kernels.memory import DERIVATIVE_SAMPLES, require_image
from mi_refgs.render.passes import Band, bands
from mi_refgs.render.pipeline import Frame
from mi_refgs.render.samples import samples_per_axis, supersampled
from mi_refgs.splat.camera import Camera

Channels = Callable[[Frame, Camera, bool], list[Any]]
"""R, G, B, (A), the weight and the AOVs of a frame, of width N or 1; the last argument: with alpha or not."""


@dataclass(frozen=True)
class FilmImage:
    """The image of a `view` through a sensor's film, and its derivatives in both modes, in passes. Raises
    InputError for another film, and where an image of `surfels` does not fit into memory."""

    sensor: Any
    spp: int  # see `render.samples`; 0: that of the sampler
    view: Callable[[Camera], Frame]
    channels: Channels
    aovs: list[str]  # names of the channels beyond the weight
    neighbours: int  # see `Shading`
    surfels: int

    def __post_init__(self) -> None:
        if mi.has_flag(self.film.flags(), mi.FilmFlags.Special):
            raise InputError("refgs renders RGB radiance only", "refgs", "film", "use an `hdrfilm`")

    @property
    def film(self) -> Any:
        return self.sensor.film()

    def image(self) -> Any:
        """The image (h, w, c), without derivatives."""
        parts = []
        for band in self._bands(None):
            parts.append(self._values(band))
            if band.size[1] < self._size[0]:
                dr.eval(parts[-1])
        values = dr.concat(parts) if len(parts) > 1 else parts[0]
        parts.clear()
        return self._developed(values)

    def adjoints(self, δ_image: Any) -> Iterator[tuple[Any, Any]]:
        """Attached values of each pass, and their adjoints; delete them before the next."""
        found = self._bands(DERIVATIVE_SAMPLES)
        if len(found) == 1:
            yield self._developed(self._values(found[0])), δ_image
            return
        δ_values = self._through_film(dr.ADMode.Backward, δ_image)
        at = 0
        for band in found:
            entries = band.size[1] * dr.width(δ_values) // self._size[0]
            index = dr.arange(mi.UInt32, entries) + dr.opaque(mi.UInt32, at)
            at += entries
            yield self._values(band), dr.gather(mi.Float, δ_values, index)

    def tangent(self) -> Any:
        """Tangent of the image for the tangents of the parameters; zero where none of these changes it."""
        found = self._bands(DERIVATIVE_SAMPLES)
        # The tangents of the parameters stay: other losses and later passes read them, too.
        flags = dr.ADFlag.ClearEdges | dr.ADFlag.AllowNoGrad
        if len(found) == 1:
            return dr.forward_to(self._developed(self._values(found[0])), flags=flags)
        parts = []
        for band in found:
            values = self._values(band)
            parts.append(dr.forward_to(values, flags=flags))
            dr.eval(parts[-1])
            del values
        tangent = dr.concat(parts)
        return self._through_film(dr.ADMode.Forward, tangent)

    # ---------------- passes ----------------

    @property
    def _size(self) -> tuple[int, int]:
        width, height = (int(x) for x in self.film.crop_size())
        return height, width

    @property
    def _alpha(self) -> bool:
        return bool(mi.has_flag(self.film.flags(), mi.FilmFlags.Alpha))

    @property
    def _samples(self) -> int:
        return max(1, int(self.spp) or int(self.sensor.sampler().sample_count()))

    def _bands(self, most: int | None) -> list[Band]:
        camera, channels = Camera.from_sensor(self.sensor), 5 + len(self.aovs)
        size = camera.width, camera.height
        require_image(size, self._samples, self.surfels, channels, most is not None)
        return bands(camera, samples_per_axis(self._samples), self.neighbours, most)

    def _values(self, band: Band) -> Any:
        """Channels of the pixels of a band (mi.Float), pixel by pixel; under AD."""
        # Attached anew in each pass: a traversal removes the graph from the sensor to its camera.
        camera = band.camera.attached(self.sensor)
        frame = supersampled(self.view, camera, self._samples)
        made = self.channels(frame, camera, self._alpha)
        pixels = dr.zeros(mi.Float, camera.width * camera.height)
        return dr.ravel(mi.ArrayXf([band.kept(channel + pixels) for channel in made]))

    # ---------------- the film ----------------

    def _developed(self, values: Any) -> Any:
        height, width = self._size
        tensor = mi.TensorXf(values, (height, width, dr.width(values) // (height * width)))
        self.film.prepare(self.aovs)
        self.film.put_block(mi.ImageBlock(tensor, self.film.crop_offset()))
        return self.film.develop()

    def _through_film(self, mode: dr.ADMode, derivative: Any) -> Any:
        """Tangent of the image for that of the channels, or their adjoint for that of the image."""
        before = self.film.develop(True)
        height, width = self._size
        weight = 4 if self._alpha else 3  # the channel that it divides by
        count = weight + 1 + len(self.aovs)
        index = dr.arange(mi.UInt32, height * width * count) % count
        values = dr.select(index == weight, mi.Float(1), 0)  # the film is linear: any will do
        dr.enable_grad(values)
        image = self._developed(values)
        start, end = (values, image) if mode == dr.ADMode.Forward else (image, values)
        dr.set_grad(start, derivative)
        dr.enqueue(mode, start)
        dr.traverse(mode)
        found = dr.detach(dr.grad(end))
        dr.eval(found)
        self.film.prepare(self.aovs)  # restore the image before
        self.film.put_block(mi.ImageBlock(before, self.film.crop_offset()))
        return found
