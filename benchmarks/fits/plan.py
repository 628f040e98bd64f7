"""Data sets, and groups of fits; each group is a data file, benchmarks/results/GROUP.json."""

from __future__ import annotations

import re
from dataclasses import dataclass

MAPS = ("potsdamer_platz_1k", "venice_sunset_1k")  # of Poly Haven, in envmaps/ of --data


@dataclass(frozen=True)
class Source:
    """A data set: path-traced from scenes/NAME.xml, or from elsewhere."""

    about: str
    samples: int = 128  # per pixel
    views: tuple[int, int] = (100, 20)  # training and test views
    size: str = "200"
    options: tuple[str, ...] = ()  # of `refgs dataset`
    folder: str | None = None  # below --data
    downscale: int | None = None  # pixels of a file per pixel of a fit, along a side
    minutes: float = 4.5  # of a fit at `quick`, on an idle machine


def _room(about: str, size: str, options: str) -> Source:
    return Source(about, 64, (48, 8), size, (*options.split(),), downscale=1)


SOURCES = {
    "mirror_ring": Source("gold ring around a steel ball, roughness 0.1"),
    "gold_cavities": Source("gold shell, roughness 0.15, around a ball of clay", 64),
    "plastic_hollows": Source("green plastic, roughness 0.22", 64),
    "studded": Source("matte bricks, open below", 64),
    "glossy_demo": Source("glazed ball on a bronze block", 64, (60, 8), "112", minutes=1.7),
    "chair": Source("NeRF-Synthetic, at half its size", folder="chair_400", downscale=2),
    "tabletop": _room(
        "copper jug in a room",
        "135x240",
        "--object jug handle knob --fov 42 --distance 2.7 3.4 --elevation 5 65",
    ),
    "figure": _room(
        "red gloss and silver in a kitchen",
        "180x320",
        "--object red_parts silver_parts --fov 30 --distance 1.9 2.3 --elevation 8 55",
    ),
    "can": _room(
        "printed aluminium on bright tiles",
        "320x180",
        "--object ends wall tab --fov 30 --distance 3.2 3.8 --elevation 10 55",
    ),
    "glass_shelf": _room(
        "glazed mug on glass",
        "180x320",
        "--object mug_outside mug_inside --max-depth 8 --fov 30 --distance 3.4 4.2 --elevation 5 55 "
        "--azimuth -160 -20",
    ),
}


@dataclass(frozen=True)
class Fit:
    """One fit of a source, and its evaluation; of `relighting`, also relit images."""

    source: str
    method: str = "auto"
    preset: str = "standard"
    threads: int = 1
    seed: int = 0
    samples: int | None = None  # per pixel, of a second evaluation

    @property
    def name(self) -> str:
        """Its folder."""
        parts = (self.source, self.method, self.preset, f"seed{self.seed}", self.threads)
        return re.sub(r"[^\w.]+", "_", "-".join(map(str, parts)))

    @property
    def minutes(self) -> float:
        """Expected time with its evaluation, on an idle machine."""
        length = SOURCES[self.source].minutes * (2 if self.preset == "standard" else 1)
        factors = {"relighting": 1.6, "auto": 1.0, "photographs": 2.4, "photographs_relighting": 2.4}
        factor = factors.get(self.method, 0.8)
        return length * factor + (self.samples or 0) / 8


RING = Fit("mirror_ring", samples=4)
SHINY = ("mirror_ring", "gold_cavities", "plastic_hollows")
ROOMS = ("tabletop", "figure", "can")
ABLATIONS = """ref_gaussian gaussians_3d no_interreflection no_material_aware no_pbr no_initial_stage
    no_deferred ref_gaussian_paper base_3dgs_dr base_gaussian_shader base_r3dg base_3dgs base_2dgs""".split()
DECIDED_SCENES = ("mirror_ring", "glossy_demo", "chair", "studded", "plastic_hollows")
DECIDED = [Fit(name, preset="quick", samples=16) for name in DECIDED_SCENES]
TIMED = DECIDED[0]  # the fit of which frames and the viewer are timed

GROUPS: dict[str, list[Fit]] = {
    "front": [RING, *(Fit(RING.source, method) for method in ("base_3dgs_dr", "base_2dgs", "relighting"))],
    "decisions": DECIDED,
    "images": [fit for own in DECIDED for fit in (own, Fit(own.source, "base_2dgs", "quick"))],
    "relighting": [Fit(name, "relighting", "quick") for name in SHINY],
    "methods": [Fit("glossy_demo", method, "quick") for method in ABLATIONS],
    "photographs": [
        *(Fit(name, method, "quick") for name in ROOMS for method in ("photographs", "base_3dgs")),
        Fit("glass_shelf", "photographs", "quick"),
    ],
    "photographs_relighting": [Fit(name, "photographs_relighting", "quick") for name in ROOMS],
}
