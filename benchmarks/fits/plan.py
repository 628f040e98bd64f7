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
    images_of: str | None = None  # source whose images `refgs capture` gets


TABLETOP = "--shapes jug handle knob --fov 42 --distance 2.7 3.4 --elevation 5 65".split()
SOURCES = {
    "mirror_ring": Source("gold ring around a steel ball, roughness 0.1"),
    "mirror_balls": Source("steel and gold balls, roughness 0.1"),
    "mixed": Source("metal and glaze, roughness 0.1 to 0.6", 256),
    "diffuse": Source("clay and paint, the control"),
    "gold_cavities": Source("gold shell, roughness 0.15, around a ball of clay", 64),
    "plastic_hollows": Source("green plastic, roughness 0.22", 64),
    "ceramic_cup": Source("blue and cream glaze, roughness 0.15", 64),
    "studded": Source("matte bricks, open below", 64),
    "patched_ball": Source("bronze ball, roughness 0.1 and 0.3"),
    "glossy_demo": Source("glazed ball on a bronze block", 64, (60, 8), "112"),
    "tabletop": Source("copper jug in a room", 64, size="270x480", options=(*TABLETOP,), downscale=1),
    "tabletop_captured": Source("cameras and points by `refgs capture`", images_of="tabletop", downscale=1),
    "chair": Source("NeRF-Synthetic, at half its size", folder="chair_400", downscale=2),
    "chair_full": Source("NeRF-Synthetic", folder="chair_400", downscale=1),
}


@dataclass(frozen=True)
class Fit:
    """One fit of a source, and its evaluation; of `relighting`, also relit images."""

    source: str
    method: str = "auto"
    preset: str = "standard"
    settings: tuple[str, ...] = ()  # KEY=VALUE
    threads: int = 1
    seed: int = 0
    samples: int | None = None  # per pixel, of a second evaluation

    @property
    def name(self) -> str:
        """Its folder."""
        parts = (self.source, self.method, self.preset, *self.settings, f"seed{self.seed}", self.threads)
        return re.sub(r"[^\w.]+", "_", "-".join(map(str, parts)))

    @property
    def minutes(self) -> float:
        """Expected time with its evaluation, on an idle machine."""
        length = 9.0 if self.preset == "standard" else 4.5
        return length * {"relighting": 1.6, "auto": 1.0}.get(self.method, 0.8) + (self.samples or 0) / 8


RING = Fit("mirror_ring", samples=4)
"""The fit of which frames and the viewer are timed."""
SHINY = ("mirror_ring", "gold_cavities", "plastic_hollows", "studded")
ABLATIONS = """ref_gaussian gaussians_3d no_interreflection no_material_aware no_pbr no_initial_stage
    no_deferred ref_gaussian_paper base_3dgs_dr base_gaussian_shader base_r3dg base_3dgs base_2dgs""".split()
REPEATED = ["ref_gaussian", "base_3dgs_dr", "base_2dgs"]  # with two seeds

GROUPS: dict[str, list[Fit]] = {
    "front": [
        RING,
        *(Fit(RING.source, method) for method in ("base_3dgs_dr", "base_2dgs", "relighting")),
    ],
    "images": [
        fit
        for name in ("mirror_ring", "gold_cavities", "studded", "chair", "mirror_balls", "mixed", "diffuse")
        for fit in (Fit(name, samples=4), Fit(name, "base_2dgs"))
    ]
    + [Fit("chair", "ref_gaussian")],
    "decisions": [
        *(Fit(x, preset="quick", samples=16) for x in (*SHINY, "glossy_demo", "chair", "chair_full")),
        Fit("mirror_ring", settings=("select.surfels=40000",)),
    ],
    "relighting": [Fit(name, "relighting") for name in (*SHINY, "ceramic_cup")],
    "methods": [
        Fit(name, method, "quick", seed=seed)
        for seed in (0, 1)
        for name in ("mirror_ring", "patched_ball", "glossy_demo")
        for method in (REPEATED if seed else ABLATIONS)
    ],
    "photographs": [
        Fit("tabletop", "photographs", "quick"),
        Fit("tabletop_captured", "photographs", "quick"),
        Fit("tabletop", "base_2dgs", "quick"),
        Fit("tabletop", "base_3dgs", "quick"),
    ],
    "times": [
        *(Fit(name, preset="quick", threads=2) for name in ("mirror_ring", "chair", "chair_full")),
        Fit("chair", "base_2dgs", "quick", threads=2),
        Fit("chair", "base_2dgs", "2000:40000", threads=2),
    ],
}
