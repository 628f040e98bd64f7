"""A method as data: a file of `variants/` in frozen dataclasses. Iteration numbers count in the file's own
`iterations`, and are scaled to those of a preset."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

from mi_refgs.constants import PATCH_EDGE
from mi_refgs.errors import InputError, UnknownNameError, within
from mi_refgs.methods.extensions import EVENTS, INITIALISERS, LOSSES, Event
from mi_refgs.methods.fields import FLAT, ITERATIONS, Window, at_least, between
from mi_refgs.registry import load_again
from mi_refgs.shade.light.kind import LIGHTS, LightKind
from mi_refgs.shade.options import ShadingOptions
from mi_refgs.shade.shading import Shading
from mi_refgs.surfels.attributes import ATTRIBUTES, MAX_SH_DEGREE, attribute
from mi_refgs.surfels.primitives.primitive import PRIMITIVES

# Names among the parameters of a fit, beside the attributes of the surfels:
LIGHT, BACKGROUND = "light", "background"  # the environment maps
LIGHT_ROTATION, LIGHT_SCALE = "light_rotation", "light_scale"  # of a known light
TURNTABLE = "light_turntable"  # axes (3, 3) of the first camera, with which the light turns
GAIN = "gain"  # log exposure gains of the training views
POSE = "pose"  # corrections of their cameras
PER_VIEW = (GAIN, POSE)  # parameters with a row per training view, which a fit may lack
AROUND = "surroundings/"  # prefix of the background Gaussians' attributes
APART = (LIGHT, LIGHT_ROTATION, LIGHT_SCALE, TURNTABLE, BACKGROUND, *PER_VIEW)  # not attributes of surfels
AT_ONCE = Window(0, 3, 1)  # one SH degree more in each of the first three iterations


@dataclass(frozen=True)
class About:
    """What the file reproduces."""

    name: str = ""  # in tables
    paper: str = ""  # authors, title, venue, address
    deviations: tuple[str, ...] = ()  # from the original, a sentence each
    purpose: str = ""  # one word, in one file only, by which `refgs train --for` finds it
    without_alpha: str = ""  # method that is fitted in its place to images without alpha
    paper_row: str = ""  # its row in the paper's tables


@dataclass(frozen=True)
class SurfelOptions:
    """The surfels at the start, and their largest number."""

    primitive: str = "surfel"  # what is splatted
    # Attributes beside the geometry of the primitive.
    attributes: tuple[str, ...] = ("radiance_sh", "albedo", "metallic", "roughness", "indirect_sh")
    count: int = field(default=20_000, metadata=at_least(1))  # initial surfels, set by the preset or `--set`
    # Densification stops at this number, times `capacity`; set by the preset or `--set`.
    max_count: int = field(default=40_000, metadata=at_least(1))
    # Factor of `max_count`; a decision that raises it fills the room at once.
    capacity: float = field(default=1.0, metadata=at_least(1))
    # Largest number that a preset may set `max_count` to; absent: any.
    preset_limit: int | None = field(default=None, metadata=at_least(1))
    # Initialisers (`fitting.initialisers`), of which the first that fits the data says where surfels start.
    start: tuple[str, ...] = ("hull", "points", "random")
    # Fraction of the initial surfels in the visual hull's volume; the others are on its surface.
    inside: float = field(default=0.0, metadata=between(0, 1))
    # SH degree by attribute; else 3.
    degree: dict[str, int] = field(default_factory=dict, metadata=between(0, MAX_SH_DEGREE))
    sh_raise: Window = AT_ONCE  # one SH degree of radiance_sh more at each event
    initial: dict[str, float] = field(default_factory=dict)  # activated, by attribute; else its own default
    from_images: tuple[Literal["albedo"], ...] = ()  # attributes that start with the hue of the images

    def degree_of(self, name: str) -> int:
        return self.degree.get(name, MAX_SH_DEGREE)

    @property
    def most(self) -> int:
        """Largest number of surfels."""
        return round(self.capacity * self.max_count)

    @property
    def names(self) -> tuple[str, ...]:
        """All attributes, those of the primitive first."""
        return (*PRIMITIVES.find(self.primitive, "primitive").widths, *self.attributes)

    def columns(self, name: str) -> int:
        """Raw columns of an attribute."""
        widths = PRIMITIVES.find(self.primitive, "primitive").widths
        return widths[name] if name in widths else attribute(name).width(self.degree_of(name))

    def first(self, name: str) -> float:
        """Initial value of an attribute, activated."""
        return self.initial.get(name, attribute(name).initial)


@dataclass(frozen=True)
class SurroundingsOptions:
    """The scene outside the region of interest: background Gaussians and an environment behind everything."""

    primitive: str = "gaussian"  # what is splatted: needs no normals, and a surfel is a flat Gaussian
    count: int = field(default=20_000, metadata=at_least(1))  # initial surfels, set by the preset or `--set`
    # Densification stops where both together have as many as both may.
    max_count: int = field(default=40_000, metadata=at_least(1))
    degree: int = field(default=2, metadata=between(0, MAX_SH_DEGREE))  # of radiance_sh

    share: ClassVar = 0.75  # fraction of all surfels that may be the background's: it has most of the pixels
    scattered: ClassVar = 0.5  # fraction of the initial surfels anywhere; the others at sparse points
    opacity: ClassVar = 0.1  # initial, of both: a cloud of 0.3 closes before the object forms
    size: ClassVar = 0.1  # largest initial size, in distances from the region's centre
    height: ClassVar = 32  # texels of the environment; width is twice that
    rate: ClassVar = 0.01  # Adam learning rate of the environment's texels

    def limits(self, most: int) -> tuple[int, int]:
        """Largest numbers of surfels of an object that alone may have `most`, and of its background."""
        together = most + self.max_count
        background = round(self.share * together)
        return together - background, background

    @property
    def names(self) -> tuple[str, ...]:
        return (*PRIMITIVES.find(self.primitive, "primitive").widths, "radiance_sh")


@dataclass(frozen=True)
class Stage:
    """One part of the schedule with its own shading, up to and including iteration `until`."""

    until: int = field(metadata=ITERATIONS)  # last iteration of the stage
    shading: ShadingOptions = field(default_factory=ShadingOptions, metadata=FLAT)
    restart: tuple[str, ...] = ()  # attributes, and `light`, reset to initial values when the stage begins
    # Factors of rates, by attribute or `light`.
    rates: dict[str, float] = field(default_factory=dict, metadata=at_least(0))


@dataclass(frozen=True)
class Rates:
    """Adam learning rates, raw units per step; those of positions in scene extents."""

    # By name; else its own default.
    attribute: dict[str, float] = field(default_factory=dict, metadata=at_least(0))
    rest: dict[str, float] = field(default_factory=dict)  # factors for SH degrees above 0; else their own
    light: float = field(default=0.01, metadata=at_least(0))  # texels of the environment map
    light_relative: bool = False  # texels brighter than 1: times their radiance, so that lamps can form
    diffuse_relative: bool = False  # SH of the diffuse colour: over 1 - metallic, by which it is displayed
    # Factor of all other rates at the last iteration.
    decay: float = field(default=1.0, metadata=at_least(1e-9))
    # Pixels of an image from which all rates fall linearly; of smaller ones, and if absent, log-linearly.
    linear_from: int | None = field(default=None, metadata=at_least(1))

    def of(self, name: str) -> float:
        return self.attribute.get(name, attribute(name).rate)


@dataclass(frozen=True)
class LossWeight:
    """Weight of the loss NAME over the iterations; a number in `[loss]`, `NAME = 0.1`, is its `weight` alone.
    L = `l1` L1 + `ssim` (1 - SSIM) + `normal` L_n + `mirror_normal` a m (1 - r)⁴ L_n, of mean albedo a,
    metallic m and roughness r, + `smooth` L_s + `alpha` L_α, and priors: `gain` prefers equal exposures,
    `half_opaque` opacity near 0 or 1, `half_metal` metallic of the object, `materials` equal
    roughness and metallic of neighbouring pixels of similar colour, `light_colour` a grey light over a grey
    albedo, `photographed` a light that is the background. Other NAMEs are those of `register_loss`.

    Losses on material maps apply to deferred stages only: forward shading blends no materials.
    """

    weight: float = field(metadata=at_least(0))  # factor in the sum of losses
    start: int = field(default=0, metadata=ITERATIONS | at_least(0))  # iterations without the loss
    rise: int = field(default=0, metadata=ITERATIONS | at_least(0))  # then its weight rises linearly from 0
    until: int | None = field(default=None, metadata=ITERATIONS | at_least(0))  # last iteration with the loss

    def at(self, iteration: int) -> float:
        """The weight in this (1-based) iteration."""
        if iteration <= self.start or (self.until is not None and iteration > self.until):
            return 0.0
        return self.weight * (min((iteration - self.start) / self.rise, 1) if self.rise else 1)


LOSS_WEIGHTS = dict.fromkeys(
    "alpha mirror_normal half_opaque half_metal materials light_colour photographed".split(), LossWeight(0.0)
) | {
    "l1": LossWeight(0.8),
    "gain": LossWeight(1e-3),  # two stops cost as much as 0.6 % of brightness
    "ssim": LossWeight(0.2),
    "normal": LossWeight(0.05),
    "smooth": LossWeight(0.0, until=18_000),
}
"""Weights that a method has unless its file says otherwise."""


@dataclass(frozen=True)
class CoarseImages:
    """Downscaled images for the iterations up to `until`; the table that ends first applies."""

    until: int = field(metadata=ITERATIONS)  # iterations
    block: int = field(default=2, metadata=at_least(2))  # pixels along a side that are averaged into one
    least: int = 0  # pixels that are left at least: smaller images are not averaged

    def applies(self, pixels: int) -> bool:
        return pixels // self.block**2 >= self.least


@dataclass(frozen=True)
class DataOptions:
    """How images are read, and their resolution in the course of a fit."""

    images: Literal["png", "exr"] = "png"  # 8-bit sRGB or linear radiance
    background: Literal["white", "black"] = "white"  # behind images with alpha
    # Pixels of a file per pixel, along a side; absent: as the preset allows.
    downscale: float | None = field(default=None, metadata=at_least(1))
    coarse: tuple[CoarseImages, ...] = ()  # downscaled images at the start of a fit
    # Pixels that a step renders at most, of a larger image; absent: all of it.
    crop: int | None = field(default=None, metadata=at_least(64 * 64))

    def block_at(self, iteration: int, pixels: int) -> int:
        """Pixels along a side that a (1-based) iteration averages into one, in an image of so many."""
        due = [images for images in self.coarse if iteration <= images.until and images.applies(pixels)]
        return min(due, key=lambda images: images.until).block if due else 1

    def crop_of(self, width: int, height: int) -> tuple[int, int]:
        """Width and height of the part of an image that a step renders: whole patches, for equal kernels."""
        if self.crop is None or self.crop >= width * height:
            return width, height
        left_out = 1 - math.sqrt(self.crop / (width * height))
        wide, high = (size - PATCH_EDGE * math.ceil(left_out * size / PATCH_EDGE) for size in (width, height))
        return max(wide, 1), max(high, 1)


@dataclass(frozen=True)
class Method:
    """All settings of a fit; the resolved copy is saved with the run."""

    # Of the fit, in which all others of the file count.
    iterations: int = field(metadata=ITERATIONS | at_least(1))
    stage: dict[str, Stage]  # by name
    about: About = About()
    surfels: SurfelOptions = SurfelOptions()
    light: LightKind | None = field(default=None, metadata={"by_kind": (LIGHTS, "learnt")})  # absent: none
    surroundings: SurroundingsOptions | None = None  # absent: the object is everything
    # What happens beside gradient steps (`fitting.events`), by name; of an unregistered one the plain table.
    event: dict[str, Event[Any]] = field(default_factory=dict, metadata={"by_name": EVENTS})
    loss: dict[str, LossWeight] = field(default_factory=LOSS_WEIGHTS.copy)  # by name
    rates: Rates = Rates()
    data: DataOptions = DataOptions()
    seed: int = field(default=0, metadata=at_least(0))  # of initial surfels, order of views and random draws
    checkpoint_every: int = field(default=1_000, metadata=at_least(1))  # iterations; a kill loses so many
    # Iterations; the last one has a preview, too.
    preview_every: int = field(default=1_000, metadata=at_least(1))
    log_every: int = field(default=50, metadata=at_least(1))  # iterations
    name: str = ""  # filled in by `load`, as the others below: the file's stem
    file: str = ""
    preset: str = ""
    assignments: tuple[str, ...] = ()
    plugins: tuple[str, ...] = ()  # files outside the package that had registered something when it was saved

    def __post_init__(self) -> None:
        if not self.stage:
            raise InputError("expected at least one named table", field="stage", remedy="add one")

    def check(self) -> None:
        """Raise InputError for an unknown name, and for a stage or an event without what it needs."""
        surfels = self.surfels
        primitive = PRIMITIVES.find(surfels.primitive, "surfels.primitive")
        if self.surroundings is not None:
            PRIMITIVES.find(self.surroundings.primitive, "surroundings.primitive")
        attributes = {*surfels.names}
        others = {LIGHT} if self.light is not None else set()
        harmonics = {name for name, one in ATTRIBUTES.items() if one.harmonics}
        primitive.require_own(attributes)
        allowed = {name for name, one in ATTRIBUTES.items() if not one.geometry} | {*primitive.optional}
        _require_known("surfels.attributes", surfels.attributes, allowed)
        _require_known("surfels.initial", surfels.initial, attributes)
        _require_known("surfels.degree", surfels.degree, harmonics)
        _require_known("surfels.from_images", surfels.from_images, {*surfels.attributes})
        _require_known("rates.attribute", self.rates.attribute, {*ATTRIBUTES})
        _require_known("rates.rest", self.rates.rest, harmonics)
        self.require_registered()
        lit = False
        for name, stage in self.stages():
            _require_known(f"stage.{name}.restart", stage.restart, {*surfels.attributes} | others)
            _require_known(f"stage.{name}.rates", stage.rates, attributes | others)
            with within(field=f"stage.{name}"):
                resolved = Shading.resolve(stage.shading, self.has_mesh)
                resolved.require_inputs(attributes, self.light is not None)
            lit |= resolved.model.light != "none"
        if self.light is not None and not lit:
            raise InputError("no stage uses it", field="light", remedy="choose a method with materials")

    def require_registered(self) -> None:
        """Raise InputError for an event, a loss or an initialiser that is not registered, or whose inputs the
        method lacks. Only a fit needs them."""
        attributes = self.surfels.names
        deferred = any(stage.shading.at == "pixel" for stage in self.stage.values())
        try:
            for name in self.surfels.start:
                INITIALISERS.find(name, "surfels.start")
            for name in self.event:
                EVENTS.find(name, "event")
            losses = {name: LOSSES.find(name, f"loss.{name}") for name in self.loss}
        except UnknownNameError as error:
            raise load_again(error, self.plugins) from None
        for name, event in self.event.items():
            with within(field=f"event.{name}"):
                event.require(attributes)
        for name, loss in losses.items():
            absent = [f"the attribute {one}" for one in loss.attributes if one not in attributes]
            absent += ["a stage at = pixel"] * (loss.maps and not deferred)
            absent += ["a light"] * (loss.light and self.light is None)
            if absent and self.loss[name].weight:
                what = f"needs {' and '.join(absent)}"
                raise InputError(what, f"loss.{name}", remedy="add it, or drop the loss")

    @property
    def has_mesh(self) -> bool:
        return "mesh" in self.event

    def stages(self) -> list[tuple[str, Stage]]:
        """Stages in the order of their `until`."""
        return sorted(self.stage.items(), key=lambda item: item[1].until)

    def stage_at(self, iteration: int) -> tuple[str, Stage]:
        """The stage that contains a (1-based) iteration."""
        return next((item for item in self.stages() if iteration <= item[1].until), self.stages()[-1])


def _require_known(key: str, names: Iterable[str], known: set[str]) -> None:
    if unknown := [name for name in names if name not in known]:
        some = ", ".join(name for name in (*ATTRIBUTES, *{*known} - {*ATTRIBUTES}) if name in known)
        hint = "" if unknown[0] in ATTRIBUTES else "; or load its file with --plugin"
        raise InputError(f"'{unknown[0]}' is unknown", None, key, f"use some of {some or 'none'}{hint}")
