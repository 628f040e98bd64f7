"""Selection of surfels by their values, such as `metallic > 0.5 and z < 0`, and their positions."""

import contextlib
import re
from collections.abc import Callable
from typing import Any

import numpy as np

from mi_refgs.constants import MAX_NUMBER
from mi_refgs.editing.options import Selection
from mi_refgs.errors import InputError, abbreviated
from mi_refgs.runs.relightable import outward
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.surfels.attributes import ATTRIBUTES, SH_DC, sigmoid

COLOUR = "colour"  # the SH term of degree 0 of radiance_sh, ½ + c Y₀: linear radiance
AXES = "xyz"
NORMALS = [f"normal.{axis}" for axis in AXES]
COMPARISON = re.compile(r"\s*([A-Za-z_][\w.]*)\s*([<>]=?)\s*(\S+)\s*", re.ASCII)
OPERATORS: dict[str, Callable[..., Any]]
OPERATORS = {"<": np.less, "<=": np.less_equal, ">": np.greater, ">=": np.greater_equal}
Condition = list[list[tuple[str, str, float]]]  # groups of comparisons: all those of one are true


def parse_condition(text: str) -> Condition:
    """Parse comparisons of names with numbers between `and` and `or`; raises InputError for anything else."""
    groups = re.split(r"\bor\b", f"{text}")
    return [[_comparison(part) for part in re.split(r"\band\b", group)] for group in groups]


def _comparison(text: str) -> tuple[str, str, float]:
    if match := COMPARISON.fullmatch(text):
        with contextlib.suppress(ValueError):
            return match[1], match[2], float(match[3])
    raise InputError("no comparison", "--where", abbreviated(text.strip()), "write it like metallic > 0.5")


def activated(name: str, raw: dict[str, np.ndarray]) -> np.ndarray:
    """Return an attribute with a linear or sigmoid activation, or the COLOUR, (N, D) float64."""
    if name == COLOUR:
        return 0.5 + SH_DC * raw["radiance_sh"][:, :3].astype(np.float64)
    values = raw[name].astype(np.float64)
    return sigmoid(values) if ATTRIBUTES[name].activation == "sigmoid" else values


class SurfelValues:
    """The activated attributes of a scene's surfels, (N,) float64 by name, computed when they are read.

    Names: single columns, such as `roughness`, `albedo.r` or `x`; `colour.r` … `.b` (COLOUR); `size`, the
    largest standard deviation (scene units); and `normal.x` … `.z`, outwards."""

    def __init__(self, scene: TrainedScene) -> None:
        self.scene, self.raw = scene, scene.surfels.to_numpy()
        self.columns: dict[str, tuple[str, list[int]]] = {}  # attribute, or COLOUR, and its columns by name
        for name, table in self.raw.items():
            declared, width = ATTRIBUTES[name], table.shape[1]
            if not declared.harmonics and declared.activation not in ("quaternion", "exp"):
                self._add(name, width, declared.aov.lower() if len(declared.aov) == width else AXES)
        self.columns |= {axis: ("position", [i]) for i, axis in enumerate(AXES)}
        if "radiance_sh" in self.raw:
            self._add(COLOUR, 3, "rgb")
        singles = [name for name, (_, columns) in self.columns.items() if len(columns) == 1]
        self.names = [*singles, "size", *NORMALS]

    def _add(self, of: str, width: int, letters: str) -> None:
        self.columns[of] = of, list(range(width))
        if width > 1:
            self.columns |= {f"{of}.{letter}": (of, [i]) for i, letter in enumerate(letters)}

    @property
    def settable(self) -> list[str]:
        """The names that can be given other values, of all columns of an attribute or of one."""
        bounded = {COLOUR} | {n for n, one in ATTRIBUTES.items() if one.activation == "sigmoid"}
        return [name for name, (of, _) in self.columns.items() if of in bounded]

    def __getitem__(self, name: str) -> np.ndarray:
        """Return the values (N,) of a name; raises InputError for an unknown one."""
        if name == "size":
            return self.scene.surfels.primitive.extent(self.raw)[1].max(axis=1).astype(float)
        if name in NORMALS:
            return outward(self.scene.surfels, self.scene.mesh)[0][:, NORMALS.index(name)].astype(np.float64)
        if name not in self.names:
            what = f"{abbreviated(name)} is no value of these surfels"
            raise InputError(what, "--where", remedy=f"use one of {', '.join(self.names)}")
        of, columns = self.columns[name]
        return activated(of, self.raw)[:, columns[0]]

    def where(self, condition: Condition) -> np.ndarray:
        """Return the surfels (N,) bool that meet a condition; raises InputError for an unknown name."""
        groups = [[OPERATORS[sign](self[name], x) for name, sign, x in group] for group in condition]
        return np.any([np.all(group, axis=0) for group in groups], axis=0)


def select(scene: TrainedScene, selection: Selection) -> np.ndarray:
    """Return the selected surfels (N,) bool; raises InputError for bad conditions, or if none is selected."""
    count = scene.surfels.count
    chosen = np.ones(count, bool)
    if selection.where is not None:
        chosen &= SurfelValues(scene).where(parse_condition(selection.where))
    if selection.box is not None:
        try:
            corners = np.asarray(selection.box, dtype=np.float64)
        except (ValueError, TypeError):
            corners = np.zeros(0)
        if corners.shape != (6,) or not (np.abs(corners) <= MAX_NUMBER).all():
            what = f"6 finite numbers are needed, none beyond {MAX_NUMBER:g}"
            raise InputError(what, "--box", remedy="give them")
        corners = corners.reshape(2, 3)
        position = scene.surfels.to_numpy()["position"].astype(np.float64)
        chosen &= np.all((position >= corners.min(0)) & (position <= corners.max(0)), axis=1)
    chosen = ~chosen if selection.invert else chosen
    if not chosen.any():
        raise InputError(f"none of the {count} surfels is in it", "selection", remedy="choose a wider one")
    return chosen
