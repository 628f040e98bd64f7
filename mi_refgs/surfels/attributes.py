"""Attributes of a surfel: the one place where they are declared. A new one is a `register`ed `Attribute`."""

import re
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from mi_refgs.errors import InputError, abbreviated
from mi_refgs.registry import Registry

MAX_SH_DEGREE = 3  # of the 3DGS family; `shade.sh` evaluates no more
ALBEDO_JITTER = 0.025  # half the width of the initial albedo's noise: breaks ties. [Ref-Gaussian]
SH_DC = 0.28209479177387814  # Y_0 = 1 / (2 √π): a constant coefficient c adds the colour Y_0 c. [3DGS]
JITTER_RANGE = (0.001, 0.999)  # of initial values with noise: beyond, the sigmoid is flat
PROBABILITY_MARGIN = 1e-6  # least distance of initial values from 0 and 1, where the logit is infinite

RESERVED = """normal depth alpha visibility radiance diffuse specular indirect object surroundings
    light light_to_world near_field mesh background aovs filename occlusion shade_at reflectance
    dominant antialias visibility_rays traced_bounces ambient_rays directions
    gain pose light_rotation light_scale light_turntable""".split()
"""Names of maps, of options of the integrator, and of what fits learn beside surfels."""

Activation = Literal["identity", "quaternion", "exp", "sigmoid", "harmonics"]
"""Activation of a raw value. "quaternion": normalised (x, y, z, w); "sigmoid": logistic; `harmonics`: raw
values are SH coefficients of a colour, column = 3 coefficient + rgb."""


def sh_columns(degree: int) -> int:
    """Number of raw columns of spherical harmonics up to a degree."""
    return 3 * (degree + 1) ** 2


SH_WIDTHS = tuple(sh_columns(degree) for degree in range(MAX_SH_DEGREE + 1))


@dataclass(frozen=True)
class Attribute:
    """One attribute of a surfel, such as its albedo: a group of raw columns of the surfel model."""

    name: str
    widths: tuple[int, ...]  # numbers of raw columns that it may have
    activation: Activation
    rate: float  # Adam's, raw units per step; of positions, scene extents, of curvature 1/scene extent
    properties: tuple[str, ...]  # PLY properties per raw column; of spherical harmonics their prefix
    initial: float = 0.0  # activated; the points decide for geometry and the first colour
    jitter: float = 0.0  # half the width of uniform noise added to it, activated
    rest_rate: float = 1.0  # factor of the rate for spherical harmonics of degree 1 and above
    geometry: bool = False  # position or shape of a primitive; present only if its primitive has it
    aov: str = ""  # suffixes of its AOV as Mitsuba names them: "RGB", "Y"; empty without an AOV

    @property
    def harmonics(self) -> bool:
        return self.activation == "harmonics"

    @property
    def bounded(self) -> bool:
        """Whether its activation is finite for every finite raw value; else RAW_LIMIT bounds these."""
        return self.activation not in ("identity", "harmonics")

    def width(self, degree: int = 0) -> int:
        """Number of raw columns; `degree` of spherical harmonics."""
        return sh_columns(degree) if self.harmonics else self.widths[0]

    def start(
        self, count: int, width: int, rng: np.random.Generator, value: float | np.ndarray | None = None
    ) -> np.ndarray:  # (count, width) float64
        """Initial raw values around the activated `value`, for SH what the constant coefficient adds;
        InputError for one that the activation cannot return."""
        value = self.initial if value is None else value
        given, shown = np.asarray(value, dtype=np.float64), abbreviated(value)
        columns = 3 if self.harmonics else width
        by_row = given[:, None] if columns == 1 and given.shape == (count,) else given
        try:
            value = np.broadcast_to(by_row, (count, columns))
        except ValueError as error:
            remedy = f"give one number, or an array {(count, columns)}"
            raise InputError(f"shape {given.shape}", "surfels", self.name, remedy) from error
        if self.activation == "sigmoid":
            if not np.all((value >= 0) & (value <= 1)):
                raise InputError(f"{shown} is out of range", "surfels", self.name, "start it between 0 and 1")
            if self.jitter:
                noise = rng.uniform(-self.jitter, self.jitter, (count, width))
                return logit(np.clip(value + noise, *JITTER_RANGE))
            return logit(value)
        if self.activation == "exp":
            if not np.all((value > 0) & (value < np.inf)):
                raise InputError(f"{shown} is out of range", "surfels", self.name, "start it above 0")
            value = np.log(value)
        if self.harmonics:
            return np.hstack([value / SH_DC, np.zeros((count, width - 3))])
        return np.array(value)


def _check(attribute: Attribute) -> None:
    def refuse(what: str, remedy: str) -> None:
        raise InputError(f"attribute '{attribute.name}': {what}", remedy=remedy)

    names, widths, aov = attribute.properties, attribute.widths, attribute.aov
    tuples = isinstance(names, tuple) and isinstance(widths, tuple) and widths
    if not tuples or not all(re.fullmatch("[!-~]+", name) for name in names):
        refuse("widths, properties: not tuples, or not of names", "write (1,) and ('name',), in ASCII")
    known = [name for name in get_args(Activation) if attribute.geometry or name != "quaternion"]
    if attribute.activation not in known:
        refuse(f"activation: {attribute.activation!r} is unknown", f"use {' or '.join(known)}")
    if len(names) < (columns := 1 if attribute.harmonics else max(widths)):
        refuse(f"properties: {len(names)} for {columns} columns", "name one for each")
    if aov not in ("", "Y", "RGB", "XYZ") or len(aov) not in (0, *widths):
        what = f"aov: {aov!r} does not fit {' or '.join(map(str, widths))} columns"
        refuse(what, 'use Mitsuba\'s "Y" for one, "RGB" or "XYZ" for three, or ""')
    if attribute.name in RESERVED:
        refuse("the name is taken", "rename it")
    if taken := [other.name for other in ATTRIBUTES.values() if {*other.properties} & {*names}]:
        refuse(f"'{taken[0]}' has its PLY property", "rename it")


ATTRIBUTES: Registry[Attribute] = Registry("attribute", _check, of=Attribute)
"""Every attribute by name, in the order of the surfel model."""
register = ATTRIBUTES.register
"""Add an attribute; raises InputError if its name, properties or AOV do not fit."""


def attribute(name: str) -> Attribute:
    """Return an attribute by name; raises InputError if it is unknown."""
    return ATTRIBUTES.find(name, "surfels")


def logit(value: float | np.ndarray) -> np.ndarray:
    """Inverse of the logistic sigmoid, float64, of values clipped to [1e-6, 1 - 1e-6]."""
    value = np.clip(np.asarray(value, dtype=np.float64), PROBABILITY_MARGIN, 1 - PROBABILITY_MARGIN)
    return np.log(value) - np.log1p(-value)


def sigmoid(raw: float | np.ndarray) -> np.ndarray:
    """Logistic sigmoid without overflow, float64."""
    return 0.5 * (1 + np.tanh(0.5 * np.asarray(raw, dtype=np.float64)))


def _numbered(prefix: str) -> tuple[str, ...]:
    return tuple(f"{prefix}_{i}" for i in range(3))


QUATERNION = ("rot_1", "rot_2", "rot_3", "rot_0")  # of the raw columns (x, y, z, w): files have w first

# Rates as in 2DGS, those of materials and light as in Ref-Gaussian (appendix, implementation details); tint
# and offset of the normal belong to GaussianShader (Jiang et al. 2024, §4).
for _declared in (
    Attribute("position", (3,), "identity", 1.6e-4, ("x", "y", "z"), geometry=True),
    Attribute("rotation", (4,), "quaternion", 1e-3, QUATERNION, geometry=True),
    Attribute("scale", (2, 3), "exp", 5e-3, _numbered("scale"), geometry=True),
    Attribute("opacity", (1,), "sigmoid", 0.05, ("opacity",), 0.1, geometry=True),
    Attribute("radiance_sh", SH_WIDTHS, "harmonics", 7.5e-3, ("f",), rest_rate=0.05),
    Attribute("albedo", (3,), "sigmoid", 7.5e-3, _numbered("albedo"), 0.5, ALBEDO_JITTER, aov="RGB"),
    Attribute("metallic", (1,), "sigmoid", 5e-3, ("metallic",), 0.01, aov="Y"),
    Attribute("roughness", (1,), "sigmoid", 5e-3, ("roughness",), 0.1, aov="Y"),
    Attribute("indirect_sh", SH_WIDTHS, "harmonics", 7.5e-3, ("ind",), rest_rate=0.05),
    Attribute("residual_sh", SH_WIDTHS, "harmonics", 0.08, ("res",), rest_rate=0.3),
    Attribute("tint", (3,), "sigmoid", 7.5e-3, _numbered("tint"), 0.5, aov="RGB"),
    Attribute("normal_offset", (3,), "identity", 1e-3, _numbered("offset")),
    Attribute("curvature", (3,), "identity", 0.2, _numbered("curvature"), geometry=True),
    # Of metallic: nothing shades with it, and it does not learn. Files of scanners have a `confidence`, too.
    Attribute("confidence", (1,), "sigmoid", 0.0, ("metallic_confidence",), aov="Y"),
):
    register(_declared)
