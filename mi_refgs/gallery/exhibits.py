"""What the gallery shows: scenes of the package, and the edits that are made to each."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mi_refgs.editing import EditOptions


@dataclass(frozen=True)
class Exhibit:
    """A scene, and what is done to it."""

    caption: str
    edits: Mapping[str, EditOptions]  # by title: keywords of `Reconstruction.edit`, on materials alone
    samples: int = 64  # a pixel of the path-traced pictures


EXHIBITS: dict[str, Exhibit] = {
    "mirror_ring": Exhibit(
        "A gold ring around a steel ball, both of roughness 0.1: a near-mirror that reflects itself.",
        {
            "brushed": {"set": ["roughness=0.45"]},
            "copper": {"set": ["albedo=0.93,0.48,0.34"]},
            "red glaze": {"set": ["metallic=0", "albedo=0.5,0.03,0.03", "roughness=0.1"]},
        },
        samples=128,
    ),
    "plastic_hollows": Exhibit(
        "A block of green plastic, roughness 0.22, with bowls and a hole: a dielectric with hollows.",
        {
            "red": {"set": ["albedo=0.6,0.05,0.04"]},
            "matt": {"set": ["roughness=0.9"]},
            "gold": {"set": ["metallic=1", "albedo=1.0,0.77,0.34", "roughness=0.2"]},
        },
    ),
    "gold_cavities": Exhibit(
        "A gold shell with six windows, roughness 0.15, around a ball of clay: metal that is concave.",
        {
            "silver": {"where": "metallic > 0.5", "set": ["albedo=0.95,0.93,0.88"]},
            "polished": {"where": "metallic > 0.5", "set": ["roughness=0.05"]},
            "empty": {"where": "metallic < 0.5", "cut": True},
        },
    ),
    "studded": Exhibit(
        "Three building bricks, open below, matt: nothing that reflects.",
        {
            "red": {"set": ["albedo=0.6,0.05,0.04"]},
            "gold": {"set": ["metallic=1", "albedo=1.0,0.77,0.34", "roughness=0.15"]},
            "two": {"duplicate": [0.0, 0.0, 0.7]},
        },
    ),
}
"""The exhibits by scene, in the order of the page."""
