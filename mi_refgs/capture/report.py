"""What a capture found: in capture.json, in words, and drawn from two sides."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mi_refgs.capture.failure import some
from mi_refgs.capture.solved import Solved
from mi_refgs.data.region import Region
from mi_refgs.io.files import replace_file

if TYPE_CHECKING:
    from mi_refgs.capture.output import Straight
    from mi_refgs.capture.pipeline import Job

SHOWN_RADII = 6.0
"""Half the width of the plot in radii of the region, unless the cameras need more: far points would hide the
rest."""
GOOD_ERROR = 1.0
"""Mean reprojection error, pixels, above which something is wrong: a lens, a rolling shutter, what moved."""


@dataclass(frozen=True)
class Report:
    """The content of capture.json."""

    content: dict[str, Any]

    @classmethod
    def of(
        cls,
        job: Job,
        model: Any,
        world: Solved,
        groups: Sequence[Sequence[str]],
        straight: dict[str, Straight],
        region: Region,
        key: str,
        seconds: float,
    ) -> Report:
        """The report on a reconstruction and on the data set that was made of it."""
        placed = {job.copies[name].name for name in world.names}
        cameras = {(s.size, s.focal): s for s in straight.values()}
        return cls(
            {
                "key": key,
                "photographs": len(job.photographs),
                "placed": len(placed),
                "not_placed": [p.name for p in job.photographs if p.name not in placed],
                "other_groups": [[job.copies[name].name for name in group] for group in groups[1:]],
                "points": len(world.points),
                "observations": int(world.length.sum()),
                "mean_track_length": float(world.length.mean()) if len(world.length) else 0.0,
                "mean_reprojection_error": float(model.compute_mean_reprojection_error()),
                "lens": {
                    "model": next(iter(model.cameras.values())).model_name,
                    "cameras": [
                        {"width": c.width, "height": c.height, "parameters": [float(x) for x in c.params]}
                        for c in model.cameras.values()
                    ],
                },
                "pinholes": [
                    {"size": s.size, "focal": [*map(float, s.focal)], "centre": [*map(float, s.centre)]}
                    for s in cameras.values()
                ],
                "region": {"centre": region.centre, "radius": region.radius},
                "masks": bool(job.masks),
                "seconds": round(seconds, 1),
            }
        )

    def text(self, folder: Path) -> str:
        """The report for people."""
        c = self.content
        lines = [
            f"{folder}: {c['placed']} of {c['photographs']} photographs placed, {c['points']} points, "
            f"each seen by {c['mean_track_length']:.1f} pictures on average; mean reprojection error "
            f"{c['mean_reprojection_error']:.2f} pixels; lens {c['lens']['model']}"
        ]
        if c["not_placed"]:
            lines.append(
                f"not placed: {some(c['not_placed'])}; take more pictures between them and the others"
            )
        if c["mean_reprojection_error"] > GOOD_ERROR:
            lines.append("the error is high: something moved, or the lens needs another --camera")
        lines.append(f"look at {folder / 'capture.png'}; next: refgs train {folder} -o runs/{folder.name}")
        return "\n".join(lines)


def draw(path: Path, world: Solved, region: Region) -> None:
    """A plot of cameras, points and region, from above and from the side."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    centre = np.array(region.centre)
    reach = float(np.abs(world.origin - centre).max())
    half = 1.1 * max(reach, min(SHOWN_RADII * region.radius, 2 * reach))
    near = world.points[(np.abs(world.points - centre) < half).all(axis=1)]
    step = half / 12
    figure = Figure(figsize=(12, 6), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, (across, up), title in zip(
        figure.subplots(1, 2), ((0, 1), (0, 2)), ("from above", "from the side"), strict=True
    ):
        axes.scatter(near[:, across], near[:, up], s=0.5, c="0.5", linewidths=0)
        ends = world.origin + step * world.axis
        axes.plot(
            *np.stack([world.origin, ends], axis=2)[:, [across, up]].transpose(1, 2, 0), color="C0", lw=0.8
        )
        axes.scatter(world.origin[:, across], world.origin[:, up], s=8, color="C0")
        angle = np.linspace(0, 2 * np.pi, 100)
        axes.plot(
            centre[across] + region.radius * np.cos(angle),
            centre[up] + region.radius * np.sin(angle),
            color="C3",
        )
        axes.set(title=title, xlabel="xyz"[across], ylabel="xyz"[up], aspect="equal")
        axes.set_xlim(centre[across] - half, centre[across] + half)
        axes.set_ylim(centre[up] - half, centre[up] + half)
    figure.suptitle(
        f"{len(world.names)} cameras (blue), {len(world.points)} points, region of interest (red)"
    )
    replace_file(path, lambda temporary: figure.savefig(temporary, dpi=100))
