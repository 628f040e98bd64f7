"""A light that is known from a file, and that a fit does not change."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from mi_refgs.errors import InputError
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.light.kind import LightKind
from mi_refgs.types import TensorXf


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

    def of(self, raw: TensorXf) -> EnvironmentLight:
        return EnvironmentLight(raw)
