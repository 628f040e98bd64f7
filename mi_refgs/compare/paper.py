"""The figures that the paper prints, from paper.json, and where a data set stands in them.

They are the paper's own, read off its tables: nothing here measured them.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mi_refgs.io.files import read_json

FILE = Path(__file__).with_name("paper.json")
OTHER_WORDS = {"blender", "synthetic", "ref", "scene", "data", "dataset"}
"""Words, beside a data set's own and numbers, that a folder's name may hold beside the scene's."""


@dataclass(frozen=True)
class Place:
    """A scene of the paper."""

    data_set: str
    scene: str
    size: tuple[int, int] | None = None  # of the paper's pictures: width, height


@dataclass(frozen=True)
class PaperTable:
    """A table of the paper: metrics → systems → a figure for each column, a (data set, scene) pair.

    A column without a scene is an average over its data set, or, without a data set, over some that the
    paper does not name.
    """

    number: int
    caption: str
    columns: tuple[Place, ...]
    metrics: dict[str, dict[str, list[float]]]


@dataclass(frozen=True)
class Figures:
    """All tables, and the data sets that they are about."""

    source: str
    data_sets: dict[str, dict[str, Any]]  # name → of, folder, words, size, scenes → folder names
    tables: dict[int, PaperTable]

    @staticmethod
    def read() -> Figures:
        """Read the file that comes with the package."""
        content = read_json(FILE)
        tables = {
            table["table"]: PaperTable(
                table["table"],
                table["caption"],
                tuple(Place(*column) for column in table["columns"]),
                table["metrics"],
            )
            for table in content["tables"]
        }
        return Figures(content["source"], content["data_sets"], tables)

    def of(self, place: Place, system: str) -> dict[str, float]:
        """Metric → figure of a system on a scene, from every table that has it."""
        found: dict[str, float] = {}
        for table in self.tables.values():
            for i, column in enumerate(table.columns):
                if (column.data_set, column.scene) == (place.data_set, place.scene):
                    for metric, systems in table.metrics.items():
                        if system in systems:
                            found.setdefault(metric, systems[system][i])
        return found

    def systems(self, place: Place) -> list[str]:
        """The systems that have figures on a scene, in the order of the tables."""
        names = [
            name
            for table in self.tables.values()
            for systems in table.metrics.values()
            for name in systems
            if self.of(place, name)
        ]
        return list(dict.fromkeys(names))


def place_of(folder: Path, figures: Figures | None = None) -> Place | None:
    """The paper's scene that a data set's folder is named after; None if it is none, or it could be two.

    The folder's name is the scene's, with nothing but numbers and the data set's words beside it: `ball`,
    `chair_400`, `teapot_glossy`. Where two data sets have a scene of that name, a word of one of them must
    stand in the folder's name or in its parent's.
    """
    figures = figures or Figures.read()
    tokens = {token for token in re.split(r"[^a-z0-9]+", folder.name.lower()) if token}
    found = []
    for name, about in figures.data_sets.items():
        for scene, aliases in about["scenes"].items():
            rest = tokens - set(aliases)
            if rest != tokens and all(
                token.isdecimal() or token in OTHER_WORDS or token in about["words"] for token in rest
            ):
                found.append(Place(name, scene, tuple(about["size"]) if about["size"] else None))
    if len(found) > 1:
        above = f"{folder.parent.name} {folder.name}".lower()
        found = [
            place
            for place in found
            if any(word in above for word in figures.data_sets[place.data_set]["words"])
        ]
    return found[0] if len(found) == 1 else None
