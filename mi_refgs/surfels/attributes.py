"""What a surfel has: the one place where a channel is declared.

The table, its PLY file, the optimiser, the method files, the AOVs and the plugin read these declarations. A
new channel is one `register`ed `Channel`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from mi_refgs.errors import InputError

MAX_SH_DEGREE = 3
"""Highest spherical-harmonic degree that the 3DGS family stores; `shade.sh` evaluates no more."""

ALBEDO_JITTER = 0.025
"""Uniform jitter of the initial albedo around its mean: breaks ties between surfels. [Ref-Gaussian]"""

SH_DC = 0.28209479177387814
"""Y_0 = 1 / (2 √π): a constant coefficient c adds the colour Y_0 c. [3DGS]"""

JITTER_RANGE = (0.001, 0.999)
"""Where a jittered initial value in 0 … 1 is kept: away from the ends, where the sigmoid has no slope."""

PROBABILITY_MARGIN = 1e-6
"""Distance that initial values keep from 0 and 1, where the logit ends."""

Activation = Literal["identity", "quaternion", "exp", "sigmoid", "harmonics"]
"""What a raw number means: itself, a normalised quaternion (x, y, z, w), exp, the logistic sigmoid, or
spherical-harmonic coefficients of a colour, column = 3 coefficient + rgb."""


def sh_columns(degree: int) -> int:
    """Number of raw columns of a spherical-harmonic channel of this degree."""
    return 3 * (degree + 1) ** 2


SH_WIDTHS = tuple(sh_columns(degree) for degree in range(MAX_SH_DEGREE + 1))


@dataclass(frozen=True)
class Channel:
    """One group of raw columns of the table."""

    name: str
    widths: tuple[int, ...]  # numbers of raw columns that it may have
    activation: Activation
    rate: float  # Adam's learning rate, raw units a step; of positions, scene extents a step
    properties: tuple[str, ...]  # PLY properties by raw column; of harmonics the prefix alone
    initial: float = 0.0  # activated; the points decide for geometry and the first colour
    jitter: float = 0.0  # half the width of the uniform noise on it, activated
    rest_rate: float = 1.0  # factor of the rate for harmonics of degree 1 and above
    direction: bool = False  # a vector in world directions, which turns with its primitive
    geometry: bool = False  # says where and how large a primitive is; there if its primitive has it
    aov: str = ""  # suffixes of its AOV, Mitsuba's: "RGB", "Y"; none without

    @property
    def harmonics(self) -> bool:
        """Whether it holds spherical harmonics."""
        return self.activation == "harmonics"

    @property
    def bounded(self) -> bool:
        """Whether its activation is finite for every finite raw value; else RAW_LIMIT bounds that."""
        return self.activation not in ("identity", "harmonics")

    def width(self, degree: int = 0) -> int:
        """Raw columns, of harmonics those of a degree."""
        return sh_columns(degree) if self.harmonics else self.widths[0]

    def start(
        self, count: int, width: int, rng: np.random.Generator, value: float | np.ndarray | None = None
    ) -> np.ndarray:
        """Initial raw values (count, width) float64 around `value` (activated; absent: `initial`).

        Of harmonics it is what the constant part adds to a colour. Raises InputError for a value that the
        activation cannot give.
        """
        value = self.initial if value is None else value
        if self.activation == "sigmoid":
            if not np.all((np.asarray(value) >= 0) & (np.asarray(value) <= 1)):
                raise InputError(f"surfels: {self.name}: {value} is no share; start it between 0 and 1")
            if self.jitter:
                noise = rng.uniform(-self.jitter, self.jitter, (count, width))
                return logit(np.clip(value + noise, *JITTER_RANGE))
            return np.broadcast_to(logit(value), (count, width)).copy()
        if self.activation == "exp":
            if not 0 < value < np.inf:
                raise InputError(f"surfels: {self.name}: {value} is no size; start it above 0")
            value = np.log(value)
        if self.harmonics:  # the same from everywhere
            constant = np.arange(width) < 3
            return np.tile(np.where(constant, value / SH_DC, 0.0), (count, 1))
        return np.full((count, width), float(value))


CHANNELS: dict[str, Channel] = {}
"""Every channel by name, in table order."""


def register(channel: Channel) -> Channel:
    """Make a channel known to tables, PLY files, method files, AOVs and the plugin; returns it.

    Raises InputError if another channel has its name or one of its PLY properties.
    """
    for other in CHANNELS.values():
        if other.name == channel.name or {*other.properties} & {*channel.properties}:
            raise InputError(f"surfels: {channel.name}: '{other.name}' has its name or a property; rename it")
    CHANNELS[channel.name] = channel
    return channel


def unregister(name: str) -> None:
    """Forget a registered channel."""
    del CHANNELS[name]


def channel(name: str) -> Channel:
    """The channel of this name; raises InputError if there is none."""
    if name not in CHANNELS:
        raise InputError(f"surfels: {name}: unknown channel; use one of {', '.join(CHANNELS)}")
    return CHANNELS[name]


def logit(value: float | np.ndarray) -> np.ndarray:
    """Inverse of the logistic sigmoid, float64, of values clipped to [1e-6, 1 - 1e-6]."""
    value = np.clip(np.asarray(value, dtype=np.float64), PROBABILITY_MARGIN, 1 - PROBABILITY_MARGIN)
    return np.log(value) - np.log1p(-value)


def sigmoid(raw: float | np.ndarray) -> np.ndarray:
    """Logistic sigmoid without overflow, float64."""
    return 0.5 * (1 + np.tanh(0.5 * np.asarray(raw, dtype=np.float64)))


def _numbered(prefix: str, count: int = 3) -> tuple[str, ...]:
    return tuple(f"{prefix}_{i}" for i in range(count))


QUATERNION = ("rot_1", "rot_2", "rot_3", "rot_0")
"""PLY files have w first."""

# Rates as in 2DGS, those of materials and light as in Ref-Gaussian (appendix, implementation details); tint
# and offset of the normal belong to GaussianShader (Jiang et al. 2024, §4).
for _declared in (
    Channel("position", (3,), "identity", 1.6e-4, ("x", "y", "z"), geometry=True),
    Channel("rotation", (4,), "quaternion", 1e-3, QUATERNION, geometry=True),
    Channel("scale", (2, 3), "exp", 5e-3, _numbered("scale"), geometry=True),
    Channel("opacity", (1,), "sigmoid", 0.05, ("opacity",), 0.1, geometry=True),
    Channel("radiance_sh", SH_WIDTHS, "harmonics", 7.5e-3, ("f",), rest_rate=0.05),
    Channel("albedo", (3,), "sigmoid", 7.5e-3, _numbered("albedo"), 0.5, ALBEDO_JITTER, aov="RGB"),
    Channel("metallic", (1,), "sigmoid", 5e-3, ("metallic",), 0.01, aov="Y"),
    Channel("roughness", (1,), "sigmoid", 5e-3, ("roughness",), 0.1, aov="Y"),
    Channel("indirect_sh", SH_WIDTHS, "harmonics", 7.5e-3, ("ind",), rest_rate=0.05),
    Channel("tint", (3,), "sigmoid", 7.5e-3, _numbered("tint"), 0.5, aov="RGB"),
    Channel("normal_offset", (3,), "identity", 1e-3, _numbered("offset"), direction=True),
):
    register(_declared)
