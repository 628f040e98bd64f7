"""Images through a sensor's film, and their derivatives."""

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_refgs.errors import InputError, require_between
from mi_refgs.kernels.device import children_of
from mi_refgs.kernels.memory import DERIVATIVE_SAMPLES, require_image
from mi_refgs.plugins.aovs import aov_values
from mi_refgs.render.display import composited
from mi_refgs.render.passes import Band, bands
from mi_refgs.render.pipeline import Frame
from mi_refgs.render.samples import samples_per_axis, supersampled
from mi_refgs.splat.camera import Camera


@dataclass(frozen=True)
class FilmImage:
    """The image of a `view` through a sensor's film, and its derivatives in both modes, in passes. Raises
    InputError for another film, and where an image of `surfels` does not fit into memory."""

    sensor: Any
    spp: int  # see `render.samples`; 0: that of the sampler
    view: Callable[[Camera], Frame]
    types: list[str]  # of AOVs, see `plugins.aovs`
    aovs: list[str]  # names of their channels
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
        return self._developed(self._joined(None, self._values))

    def adjoints(self, δ_image: Any) -> Iterator[tuple[Any, Any]]:
        """Attached values of each pass, and their adjoints; delete them before the next."""
        found = self._passes(DERIVATIVE_SAMPLES)
        if len(found) == 1:
            yield self._developed(self._values(*found[0])), δ_image
            return
        δ_values = self._through_film(dr.ADMode.Backward, δ_image)
        height, views = self._size[0], len(self._sensors)
        row = dr.width(δ_values) // (height * views)  # entries of a view's row
        at = 0
        for sensor, band in found:
            index = dr.arange(mi.UInt32, band.size[1] * row)
            place = divmod(at, height)  # view, and first row of the band in it
            first = dr.opaque(mi.UInt32, place[1] * views + place[0])
            at += band.size[1]
            δ_band = dr.gather(mi.Float, δ_values, (index // row * views + first) * row + index % row)
            yield self._values(sensor, band), δ_band

    def tangent(self) -> Any:
        """Tangent of the image for the tangents of the parameters; zero where none of these changes it."""
        # The tangents of the parameters stay: other losses and later passes read them, too.
        forward = partial(dr.forward_to, flags=dr.ADFlag.ClearEdges | dr.ADFlag.AllowNoGrad)
        found = self._passes(DERIVATIVE_SAMPLES)
        if len(found) == 1:
            return forward(self._developed(self._values(*found[0])))
        joined = self._joined(DERIVATIVE_SAMPLES, lambda *of: forward(self._values(*of)))
        return self._through_film(dr.ADMode.Forward, joined)

    @property
    def _size(self) -> tuple[int, int]:
        width, height = (int(x) for x in self.film.crop_size())
        return height, width

    @property
    def _alpha(self) -> bool:
        return bool(mi.has_flag(self.film.flags(), mi.FilmFlags.Alpha))

    @property
    def _samples(self) -> int:
        require_between(int(self.spp), "spp", 0)
        return int(self.spp) or max(1, int(self.sensor.sampler().sample_count()))

    @property
    def _sensors(self) -> list[Any]:
        """The sensors of a `batch`, whose images are side by side in its film; else the sensor itself."""
        inner = [one for _, one in children_of(self.sensor) if isinstance(one, mi.Sensor)]
        if inner and (*self.film.crop_size(),) != (*self.film.size(),):
            raise InputError("a crop of a `batch`", "refgs", "film", "render its sensors one by one")
        return inner or [self.sensor]

    def _passes(self, most: int | None) -> list[tuple[Any, Band]]:
        """Bands of at most `most` samples of each sensor's view, one view after the other."""
        found = []
        for sensor in self._sensors:
            camera, channels = Camera.from_sensor(sensor), 5 + len(self.aovs)
            size = camera.width, camera.height
            require_image(size, self._samples, self.surfels, channels, most is not None)
            parts = bands(camera, samples_per_axis(self._samples), self.neighbours, most)
            found += [(sensor, band) for band in parts]
        return found

    def _joined(self, most: int | None, of: Callable[[Any, Band], Any]) -> Any:
        """What `of` returns for all pixels of the film, pixel by pixel, from its passes."""
        parts, (height, _), views = [], self._size, len(self._sensors)
        for sensor, band in self._passes(most):
            parts.append(of(sensor, band))
            if views > 1 or band.size[1] < height:
                dr.eval(parts[-1])
        values = dr.concat(parts) if len(parts) > 1 else parts[0]
        parts.clear()
        if views == 1:
            return values
        row = dr.width(values) // (height * views)  # entries of a view's row
        index = dr.arange(mi.UInt32, dr.width(values))
        line = index // row
        return dr.gather(mi.Float, values, (line % views * height + line // views) * row + index % row)

    def _values(self, sensor: Any, band: Band) -> Any:
        """Channels of the pixels of a band (mi.Float), pixel by pixel; under AD."""
        # Attached anew in each pass: a traversal removes the graph from the sensor to its camera.
        camera = band.camera.attached(sensor)
        frame = supersampled(self.view, camera, self._samples)
        rgb, coverage = composited(frame)
        more = [value for aov in self.types for value in aov_values(aov, frame, camera)]
        # As the film's blocks have them.
        made = [*rgb, *([coverage] if self._alpha else []), mi.Float(1), *more]
        pixels = dr.zeros(mi.Float, camera.width * camera.height)
        return dr.ravel(mi.ArrayXf([band.kept(channel + pixels) for channel in made]))

    def _developed(self, values: Any) -> Any:
        height, width = self._size
        tensor = mi.TensorXf(values, (height, width, dr.width(values) // (height * width)))
        self.film.prepare(self.aovs)
        self.film.put_block(mi.ImageBlock(tensor, self.film.crop_offset()))
        return self.film.develop()

    def _through_film(self, mode: Any, derivative: Any) -> Any:
        """Tangent of the image for that of the channels, or their adjoint for that of the image."""
        before = None
        with contextlib.suppress(RuntimeError):  # it was never used
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
        # Restore the image before, unless there was none or another integrator made it.
        if before is not None and before.shape[2] == count:
            self.film.prepare(self.aovs)
            self.film.put_block(mi.ImageBlock(before, self.film.crop_offset()))
        return found
