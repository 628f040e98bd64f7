"""Channels of a picture are sampled, filtered and developed by a sensor's film.

No Mitsuba class is defined here, so that this module need not be reloaded when the variant changes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_refgs.errors import InputError
from mi_refgs.render.pipeline import Frame
from mi_refgs.render.samples import supersampled
from mi_refgs.splat.camera import Camera

Channels = Callable[[Frame, Camera, bool], list[Any]]
"""Channels of a frame, arrays of one value per pixel or one in all, for its camera and whether the film has
alpha: R, G, B, (A), the weight and the AOVs, as the film's blocks have them."""


def through_film(
    sensor: Any, spp: int, view: Callable[[Camera], Frame], channels: Channels, aovs: list[str]
) -> Any:
    """The image (h, w, c) of a `view`, sampled, filtered and developed for a sensor; under AD.

    A sample count n (`spp`, or 0 for that of the sampler) gives k × k regular samples per pixel, k = ⌈√n⌉,
    averaged as by `render.samples`. `aovs` names the channels beyond the weight. Raises InputError for a film
    of another kind.
    """
    film = sensor.film()
    if mi.has_flag(film.flags(), mi.FilmFlags.Special):
        raise InputError("refgs: film: refgs renders RGB radiance only; use an `hdrfilm`")
    camera = Camera.from_sensor(sensor)
    frame = supersampled(view, camera, max(1, int(spp) or int(sensor.sampler().sample_count())))
    made = channels(frame, camera, mi.has_flag(film.flags(), mi.FilmFlags.Alpha))
    pixels = dr.zeros(mi.Float, camera.width * camera.height)
    values = dr.ravel(mi.ArrayXf([channel + pixels for channel in made]))
    tensor = mi.TensorXf(values, (camera.height, camera.width, len(made)))
    film.prepare(aovs)
    film.put_block(mi.ImageBlock(tensor, film.crop_offset()))
    return film.develop()
