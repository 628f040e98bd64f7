"""Kinds of light, what a fit learns of it: a new one is a `FittedLight` and a registered `LightKind`."""

from dataclasses import dataclass, field
from typing import ClassVar, Self

from mi_refgs.registry import Registry
from mi_refgs.shade.light.envmap import EnvironmentLight, FittedLight
from mi_refgs.types import TensorXf

RADIANCE = {"allowed": (lambda value: 1e-4 <= value <= 1e6, "a number from 0.0001 to 1e+06")}  # initial


@dataclass(frozen=True)
class LightKind:
    """Settings of one kind of light, the table `[light]` of a method."""

    # Iterations that share one prefiltered light, which then receives all their gradients.
    every: int = field(default=1, metadata={"allowed": (lambda n: n >= 1, "1 or more")})

    # Whether the object turns before a fixed camera and lamp: in its frame, the light turns with the camera.
    turntable: bool = False

    name: ClassVar[str] = ""

    @property
    def placement(self) -> tuple[str, ...]:
        """Of "rotation" and "scale" (`placed.PlacedLight`), what a fit learns beside the raw values."""
        return ()

    @property
    def learns(self) -> bool:
        """Whether a fit changes the raw values."""
        return True

    def sized(self, pixels: int) -> Self:
        """The settings for images of so many pixels; raises InputError if one cannot be used."""
        return self

    def start(self) -> TensorXf:
        """Raw values that a fit begins with; raises InputError if a setting cannot be used."""
        raise NotImplementedError

    def shape(self) -> tuple[int, ...]:
        """Of the raw values."""
        return tuple(self.start().shape)

    def of(self, raw: TensorXf) -> FittedLight:
        """The light of raw values, under AD; unless it is overridden, an environment map."""
        return EnvironmentLight(raw)


LIGHTS: Registry[type[LightKind]] = Registry("light", of=LightKind, classes=True)
register = LIGHTS.register
"""Add a kind of light, which method files can name from then on."""
