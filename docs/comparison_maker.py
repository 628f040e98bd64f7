"""Make the image pairs of the sliders in docs/: a view rendered by a fit, and the same view path-traced.

`python docs/comparison_maker.py RUN SCENE.xml -o docs/images/NAME` writes NAME_ours.webp and
NAME_reference.webp. A tool of maintainers.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import mi_refgs  # isort: skip  (chooses the LLVM before Mitsuba is imported)
import mitsuba as mi
import numpy as np
import tyro
from PIL import Image

from mi_refgs.io.files import write_bytes
from mi_refgs.io.images import straight_srgb, to_8_bits
from mi_refgs.synthesis.settings import load_scene, under_light

QUALITY = 90
"""WebP quality, 0 to 100."""
MARGIN = 0.05
"""Margin around the object, as a part of the image."""


@dataclass(frozen=True)
class Pair:
    """A view of a fitted run, and the same view of the scene that it was fitted to."""

    run: tyro.conf.Positional[Path]  # run folder
    scene: tyro.conf.Positional[Path]  # Mitsuba scene
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]  # both files without their endings
    view: int = 0  # test view
    light: Path | None = None  # relight both with this map; ours is then scaled per channel
    size: int = 480  # pixels per side
    samples: int = 16  # per pixel of our image
    spp: int = 512  # of the path-traced image

    def write(self) -> None:
        """Render both images and write them with straight alpha."""
        fitted = mi_refgs.load(self.run, write=False)
        if self.light:
            fitted = fitted.relight(self.light)
        camera = fitted.camera(self.view, self.size)
        ours = fitted.render(camera, samples=self.samples)
        traced = self._path_traced(fitted.scene(camera).sensors()[0])
        if self.light:
            ours[..., :3] *= np.sum(ours * traced, (0, 1))[:3] / np.sum(ours**2, (0, 1))[:3]
        part = around_object(np.maximum(ours[..., 3], traced[..., 3]))
        for name, image in {"ours": ours[part], "reference": traced[part]}.items():
            buffer = io.BytesIO()
            Image.fromarray(to_8_bits(straight_srgb(image))).save(buffer, "WEBP", quality=QUALITY, method=6)
            write_bytes(Path(f"{self.output}_{name}.webp"), buffer.getvalue())

    def _path_traced(self, sensor: mi.Sensor) -> np.ndarray:
        """Path-trace a sensor's view of the scene: premultiplied linear RGBA (H, W, 4)."""
        scene = load_scene(self.scene)
        if self.light:
            scene = under_light(scene, self.light)
        integrator = mi.load_dict({"type": "path", "max_depth": 6, "hide_emitters": True})
        return np.array(mi.render(scene, sensor=sensor, integrator=integrator, spp=self.spp))


def around_object(alpha: np.ndarray) -> tuple[slice, slice]:
    """Rows and columns of an image (H, W) that the object covers, with a margin."""
    margin = round(MARGIN * max(alpha.shape))
    covered = [np.flatnonzero(alpha.max(axis=axis) > 0.01) for axis in (1, 0)]
    rows, columns = (slice(max(found[0] - margin, 0), found[-1] + 1 + margin) for found in covered)
    return rows, columns


if __name__ == "__main__":
    mi.set_variant("llvm_ad_rgb")
    tyro.cli(Pair).write()
