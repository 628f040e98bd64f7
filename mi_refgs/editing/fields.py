"""The values of surfels by the names that expressions and assignments call them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from mi_refgs.errors import InputError, abbreviated
from mi_refgs.evaluation.images import LUMINANCE
from mi_refgs.runs.relightable import outward
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.surfels.attributes import CHANNELS, SH_DC, channel, sigmoid

COLOUR = "colour"
"""The part of radiance_sh that is the same from everywhere, ½ + c Y_0: linear radiance."""
NORMAL = "normal"
AXES = "xyz"


def columns_by_name(raw: Mapping[str, np.ndarray]) -> dict[str, tuple[str, list[int]]]:
    """Channel and raw columns by name: "roughness", "albedo" and "albedo.r", "position.x" and "x".

    Rotation, scale and harmonics have other names: size, normal and colour.
    """
    found: dict[str, tuple[str, list[int]]] = {}
    for name, table in raw.items():
        declared, width = CHANNELS[name], table.shape[1]
        if declared.harmonics or declared.activation in ("quaternion", "exp"):
            continue
        found[name] = name, list(range(width))
        if width > 1:
            letters = declared.aov.lower() if len(declared.aov) == width else AXES
            found |= {f"{name}.{letter}": (name, [i]) for i, letter in enumerate(letters)}
    return found | {axis: ("position", [i]) for i, axis in enumerate(AXES)}


def constant_colour(radiance_sh: np.ndarray) -> np.ndarray:
    """The COLOUR (N, 3) float64 of raw radiance_sh (N, D), which may be negative."""
    return 0.5 + SH_DC * radiance_sh[:, :3].astype(np.float64)


class Fields(Mapping[str, np.ndarray]):
    """The activated values (N,) float64 of a scene's surfels, computed when they are asked for.

    Names: those of single columns in `columns_by_name`; `size`, the largest standard deviation (scene units);
    `normal.x` … `.z`, turned outwards as `runs.relightable.outward` says; of radiance_sh `colour.r` … `.b`
    (COLOUR); `luminance` of what the diffuse term is made of: of the colour where it is fitted, else of the
    albedo; and both apart, `colour.luminance` and `albedo.luminance`.
    """

    def __init__(self, scene: TrainedScene) -> None:
        self.scene = scene
        self.raw = scene.surfels.to_numpy()
        self.columns = columns_by_name(self.raw)
        self._normals: np.ndarray | None = None

    @property
    def settable(self) -> list[str]:
        """Names that can be given other values: shares, whole or by column, and `colour`."""
        names = [name for name, (of, _) in self.columns.items() if channel(of).activation == "sigmoid"]
        return [*names, COLOUR, *(f"{COLOUR}.{letter}" for letter in "rgb")] if self._has(COLOUR) else names

    def __iter__(self) -> Iterator[str]:
        names = [name for name, (_, columns) in self.columns.items() if len(columns) == 1]
        names += ["size", *(f"{NORMAL}.{axis}" for axis in AXES)]
        bright = [name for name in ("albedo", COLOUR) if self._has(name)]
        if COLOUR in bright:
            names += [f"{COLOUR}.{letter}" for letter in "rgb"]
        return iter([*names, *(f"{name}.luminance" for name in bright), *(["luminance"] if bright else [])])

    def __len__(self) -> int:
        return len(list(iter(self)))

    def __contains__(self, name: object) -> bool:
        return name in [*self]

    def check(self, names: frozenset[str], where: str) -> None:
        """Raise InputError, with `where` in the message, for names that the surfels have no values of."""
        for name in sorted(names - {*self}):
            raise InputError(
                f"{where}: {abbreviated(name)} is no value of these surfels; use one of {', '.join(self)}"
            )

    def __getitem__(self, name: str) -> np.ndarray:
        first, _, last = name.partition(".")
        if name == "size":
            _, spread = self.scene.surfels.primitive.extent(self.raw)
            return spread.max(axis=1).astype(np.float64)
        if first == NORMAL and last:
            if self._normals is None:
                self._normals = outward(self.scene.surfels, self.scene.mesh)[0].astype(np.float64)
            return self._normals[:, AXES.index(last)]
        if name == "luminance":
            fitted = "radiance_sh" in self.scene.shading.model.channels(self.scene.shading.diffuse)
            return self.rgb(COLOUR if fitted and self._has(COLOUR) else "albedo") @ LUMINANCE
        if last == "luminance":
            return self.rgb(first) @ LUMINANCE
        if first == COLOUR:
            return self.rgb(COLOUR)[:, "rgb".index(last)]
        of, columns = self.columns[name]
        return self.activated(of)[:, columns[0]]

    def rgb(self, name: str) -> np.ndarray:
        """A colour (N, 3) float64: `colour`, or a channel of three columns."""
        return constant_colour(self.raw["radiance_sh"]) if name == COLOUR else self.activated(name)

    def activated(self, name: str) -> np.ndarray:
        """Activated values (N, D) float64 of a channel that is itself, or a share."""
        values = self.raw[name].astype(np.float64)
        return sigmoid(values) if channel(name).activation == "sigmoid" else values

    def _has(self, name: str) -> bool:
        return ("radiance_sh" if name == COLOUR else name) in self.raw
