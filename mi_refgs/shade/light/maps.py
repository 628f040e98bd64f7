"""Kinds of light that are environment maps: learnt, or known from a file."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from mi_refgs.errors import InputError
from mi_refgs.shade.light.envmap import DEFAULT_HEIGHT, MIN_HEIGHT, EnvironmentLight, is_height
from mi_refgs.shade.light.kind import LightKind
from mi_refgs.types import TensorXf

HEIGHT = {"allowed": (is_height, f"a multiple of 4 from {MIN_HEIGHT}")}


@dataclass(frozen=True)
class Learnt(LightKind):
    """An environment map, each of whose texels is learnt."""

    height: int = field(default=DEFAULT_HEIGHT, metadata=HEIGHT)  # texels; width is twice that
    radiance: float = 0.5  # initial, everywhere

    name: ClassVar[str] = "learnt"

    def start(self) -> TensorXf:
        return EnvironmentLight.constant(self.radiance, self.height).raw


@dataclass(frozen=True)
class Known(LightKind):
    """The lat-long map of a file (EXR, HDR), in the orientation of Mitsuba's `envmap` without rotation."""

    file: str = ""  # its path
    height: int | None = None  # texels; width is twice that; absent: those of the file

    name: ClassVar[str] = "file"
    learnt: ClassVar[bool] = False

    def start(self) -> TensorXf:
        if not self.file:
            raise InputError("none is named", field="light.file", remedy="give an EXR or HDR file")
        return EnvironmentLight.from_file(self.file, self.height).raw
