"""A method as data: what a file of `variants/` says, in frozen dataclasses.

Iteration numbers in a file are written for the file's own `iterations`; a preset gives the number to run, and
every window, stage and interval is scaled with it (`methods.read`).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from mi_refgs.methods.build import FLAT
from mi_refgs.methods.surroundings import BACKGROUND, SurroundingsOptions
from mi_refgs.methods.weights import LossWeights
from mi_refgs.methods.window import ITERATIONS, Window
from mi_refgs.shade.options import ShadingOptions
from mi_refgs.surfels.attributes import MAX_SH_DEGREE, attribute
from mi_refgs.surfels.primitives import PRIMITIVES

LIGHT = "light"
"""Name of the environment among the parameters of a fit, beside the channels of the surfels."""
GAIN = "gain"
"""Name of the log gains of the training views among them."""
APART = (LIGHT, GAIN, BACKGROUND)
"""Parameters that are no channels of surfels."""
AT_ONCE = Window(0, 3, 1)
"""One degree of spherical harmonics more in each of the first three iterations."""
MESH_WINDOW = Window(20_000, 50_000, 2_000)
"""When the released Ref-Gaussian code extracts its mesh on synthetic scenes."""


@dataclass(frozen=True)
class About:
    """What the file stands for."""

    name: str = ""
    paper: str = ""
    deviations: tuple[str, ...] = ()
    purpose: str = ""  # a word, one file's alone, by which `refgs train --for` finds it
    paper_row: str = ""  # what the paper's tables call it, as in compare/paper.json


@dataclass(frozen=True)
class SurfelOptions:
    """The table of surfels at the start, and its limits."""

    primitive: str = "surfel"  # what is splatted
    channels: tuple[str, ...] = ("radiance_sh", "albedo", "metallic", "roughness", "indirect_sh")
    count: int = 20_000  # initial surfels
    max_count: int = 40_000  # densification stops here
    inside: float = 0.0  # share of the initial surfels in the visual hull's volume; the others on its surface
    degree: dict[str, int] = field(default_factory=dict)  # of spherical harmonics by channel; else 3
    sh_raise: Window = AT_ONCE  # one more degree of radiance_sh each time it is due
    initial: dict[str, float] = field(default_factory=dict)  # activated, by channel; else the channel's own
    from_pictures: tuple[Literal["albedo"], ...] = ()  # channels that start with the hue of the pictures

    def degree_of(self, name: str) -> int:
        """Degree of the spherical harmonics of a channel."""
        return self.degree.get(name, MAX_SH_DEGREE)

    @property
    def names(self) -> tuple[str, ...]:
        """All channels, those of the primitive first; raises InputError for an unknown primitive."""
        return (*PRIMITIVES.find(self.primitive, "primitive").widths, *self.channels)

    def columns(self, name: str) -> int:
        """Raw columns of a channel."""
        widths = PRIMITIVES.find(self.primitive, "primitive").widths
        return widths[name] if name in widths else attribute(name).width(self.degree_of(name))

    def start(self, name: str) -> float:
        """Initial value of a channel, activated."""
        return self.initial.get(name, attribute(name).initial)


@dataclass(frozen=True)
class LightOptions:
    """The learnable lat-long environment; absent channels and light cost nothing."""

    height: int = 64  # texels; width is twice that
    radiance: float = 0.5  # initial, everywhere
    every: int = 1  # iterations that share one filtered light; it learns from all of them at once


@dataclass(frozen=True)
class Stage:
    """One stretch of the schedule with its own way to shade, up to and including iteration `until`."""

    until: int = field(metadata=ITERATIONS)
    shading: ShadingOptions = field(default_factory=ShadingOptions, metadata=FLAT)  # keys of the stage itself
    samples: int = 1  # per pixel, k × k, in the steps of a fit
    restart: tuple[str, ...] = ()  # channels, and `light`, that start anew when the stage begins
    rates: dict[str, float] = field(default_factory=dict)  # factors of the rates of channels, and of `light`


@dataclass(frozen=True)
class Propagation:
    """Normal propagation: opaque surfels, of which the reflective grow over their neighbours.

    [3DGS-DR, Ye et al. 2024, §3.3; aware of the material: Ref-Gaussian §3.4]
    """

    when: Window
    opacity: float = 0.9  # all surfels are made at least this opaque
    scale: float = 1.5  # factor of the sizes of the reflective
    metallic: float = 0.02  # reflective is what is at least this metallic …
    roughness: float | None = None  # … and at most this rough; absent: however rough
    noise: float = 0.0  # half the width of the noise on the constant colour of the others, in coefficients
    noise_metallic: float = 0.05  # which are at most this metallic
    hold: int = field(default=200, metadata=ITERATIONS)  # iterations without opacity learning afterwards


@dataclass(frozen=True)
class Relocation:
    """Idle surfels move onto seen ones, and positions take random steps. [3DGS-MCMC, Kheradmand et al. 2024]

    The steps end with the window.
    """

    when: Window
    opacity: float = 0.005  # at most; what is as transparent is idle
    grow: float = 0.0  # share of the table that is added each time, up to max_count
    noise: float = 1e7  # of positions: 5e5 per squared unit where the extent is 4.5 units; 0: none


@dataclass(frozen=True)
class Refine:
    """Adaptive control of the table [3DGS §5.2, 2DGS; Ref-Gaussian §3.4]."""

    densify: Window | None = None
    gradient: float = 2e-4  # NDC units; a mean over views, which no number of iterations changes
    dense_extent: float = 0.01  # clone below, split above, in scene extents
    prune_opacity: float = 0.05
    prune_extent: float = 0.1  # scene extents; larger surfels go
    reset: Window | None = None  # opacity to at most reset_opacity
    reset_opacity: float = 0.01
    reset_raise: tuple[str, ...] = ()  # channels that it lifts to at least their initial value
    propagate: Propagation | None = None
    relocate: Relocation | None = None


@dataclass(frozen=True)
class MeshOptions:
    """Extraction of the occluding mesh, when due."""

    extract: Window = MESH_WINDOW
    resolution: int = 128  # voxels along the longest side; unbounded, along the region's diameter
    unbounded: bool = False  # of pictures without alpha: with the surroundings, in all of space


@dataclass(frozen=True)
class Rates:
    """Adam learning rates, raw units a step; of positions in scene extents."""

    channel: dict[str, float] = field(default_factory=dict)  # by channel; else the channel's own
    rest: dict[str, float] = field(default_factory=dict)  # factor of the higher degrees; likewise
    light: float = 0.01  # texels of the environment
    light_relative: bool = False  # those brighter than 1: times their radiance, so that they grow to lamps
    position_final: float = 1.6e-6  # of positions, at 0.6 of the iterations
    decay: float = 1.0  # factor that all but the position's rate reach, log-linearly, at the last iteration

    def of(self, name: str) -> float:
        """Rate of a channel."""
        return self.channel.get(name, attribute(name).rate)

    def rest_of(self, name: str) -> float:
        """Factor of that for harmonics of degree 1 and above."""
        return self.rest.get(name, attribute(name).rest_rate)


@dataclass(frozen=True)
class ExposureOptions:
    """A gain a channel of each training view, on the linear radiance; decided once (`fitting.exposure`)."""

    gains: Literal["judged", "on", "off"] = "judged"  # judged: if they pay
    after: int = field(default=1_200, metadata=ITERATIONS)  # iterations, then it is decided
    worth: float = 0.5  # dB that the training views must gain, on pixels that the gains were not fitted to
    rate: float = 3e-3  # of log gains, a step; a tenth at the end


@dataclass(frozen=True)
class CoarsePictures:
    """Pictures of fewer pixels for the iterations up to `until`; of several such tables the one that ends
    first counts."""

    until: int = field(metadata=ITERATIONS)  # iterations
    block: int = 2  # pixels along a side of the squares that are averaged into one


@dataclass(frozen=True)
class DataOptions:
    """How pictures are read, and how large they are in the course of a fit."""

    images: Literal["png", "exr"] = "png"
    background: Literal["white", "black"] = "white"
    downscale: int | None = None  # pixels of a file along a pixel's side; absent: what the preset can afford
    coarse: tuple[CoarsePictures, ...] = ()

    def block_at(self, iteration: int) -> int:
        """Pixels along a side of what a (1-based) iteration takes for one pixel; 1 is a whole picture."""
        due = [pictures for pictures in self.coarse if iteration <= pictures.until]
        return min(due, key=lambda pictures: pictures.until).block if due else 1


@dataclass(frozen=True)
class Term:
    """Something that a method can do without, as changes of its file, and when a fit tries it."""

    after: int = field(metadata=ITERATIONS)  # iterations before it is tried
    trial: int = field(metadata=ITERATIONS)  # iterations with it, and without it, that are compared
    change: dict[str, Any] = field(default_factory=dict)  # tables merged over the method's
    drop: tuple[str, ...] = ()  # keys that it removes before, where they are there
    needs: tuple[str, ...] = ()  # terms that must be in use
    unless: tuple[str, ...] = ()  # terms that must not


@dataclass(frozen=True)
class Selection:
    """Terms that a fit tries on training views held out for it, and what each must bring to stay.

    A term stays if the PSNR of these views rises by the price of the time of a step and of the memory that it
    costs, and by `gain` if it costs anything; one that saves time and memory may lose as much.
    """

    term: dict[str, Term]
    holdout: int = 8  # every so many training views judge
    gain: float = 0.02  # dB
    gain_per_ms: float = 0.003  # dB for each millisecond of a step
    gain_per_mb: float = 0.001  # dB for each MB of parameters and their moments

    @property
    def order(self) -> list[str]:
        """The terms in the order in which they are tried: as they fall due, then as the file has them."""
        return sorted(self.term, key=lambda name: self.term[name].after)


@dataclass(frozen=True)
class Method:
    """Everything that describes a fit; the resolved copy is saved with the run."""

    iterations: int = field(metadata=ITERATIONS)
    stage: dict[str, Stage]
    about: About = About()
    surfels: SurfelOptions = SurfelOptions()
    light: LightOptions | None = None
    surroundings: SurroundingsOptions | None = None  # absent: everything is of the object
    refine: Refine = Refine()
    mesh: MeshOptions | None = None
    loss: LossWeights = field(default_factory=LossWeights)
    rates: Rates = Rates()
    data: DataOptions = DataOptions()
    exposure: ExposureOptions | None = None
    seed: int = 0
    checkpoint_every: int = 1_000  # iterations; a kill loses at most so many
    preview_every: int = 1_000
    log_every: int = 50
    select: Selection | None = None
    terms: tuple[str, ...] = ()  # of `select`, in use
    variant: str = ""  # filled in by `load`, as the others below: the file's stem
    file: str = ""
    preset: str = ""
    assignments: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.iterations < 1:
            raise ValueError("iterations: less than 1; give how many to run")
        if not self.stage:
            raise ValueError("stage: expected at least one named table; add one")

    def stages(self) -> list[tuple[str, Stage]]:
        """Stages in the order of their `until`."""
        return sorted(self.stage.items(), key=lambda item: item[1].until)

    def stage_at(self, iteration: int) -> tuple[str, Stage]:
        """The stage a (1-based) iteration belongs to."""
        return next((item for item in self.stages() if iteration <= item[1].until), self.stages()[-1])
