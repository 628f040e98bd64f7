"""Pictures to look at: maps as colours, previews, contact sheets, and a light beside the true one. All NumPy.

A picture is (H, W, 3), display-encoded, in [0, 1].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from mi_refgs.data.dataset import Dataset
from mi_refgs.data.view import View
from mi_refgs.evaluation.metrics import environment
from mi_refgs.io.images import srgb_from_linear
from mi_refgs.render.display import displayed
from mi_refgs.render.pipeline import Frame
from mi_refgs.surfels.attributes import ATTRIBUTES

LIGHT_KEY = 0.36
"""Average luminance of a shown light before the tone curve x / (1 + x), which displays it as 0.55."""
CELL_MIN = 128
"""Pixels: smaller pictures are enlarged by a whole factor, so that a sheet of thumbnails can be read."""
MARGIN = 4
"""Pixels between pictures."""
TITLE_HEIGHT = 16
"""Pixels above each picture, enough for Pillow's built-in font."""
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Luminance of the linear sRGB primaries (ITU-R BT.709)."""


@dataclass(frozen=True, eq=False)
class RenderedView:
    """A rendered view as NumPy arrays."""

    image: np.ndarray  # (H, W, 3) display-encoded, over the data's background
    alpha: np.ndarray  # (H, W)
    normal: np.ndarray  # (H, W, 3) unit, or 0 where nothing is seen
    maps: dict[str, np.ndarray]  # (H, W) or (H, W, 3), linear

    @staticmethod
    def of(frame: Frame, data: Dataset, view: View) -> RenderedView:
        """Copy a frame of one of the data set's views; waits for the device."""
        size = view.height, view.width
        normal = image_array(frame.normal, *size)
        length = np.linalg.norm(normal, axis=-1, keepdims=True)
        return RenderedView(
            image_array(displayed(frame, data.background, data.is_linear_radiance), *size),
            image_array(frame.alpha, *size),
            np.where(length > 1e-6, normal / np.maximum(length, 1e-6), 0),
            RenderedView.maps_of(frame, *size),
        )

    @staticmethod
    def maps_of(frame: Frame, height: int, width: int) -> dict[str, np.ndarray]:
        """The maps of a frame alone."""
        return {name: image_array(m, height, width) for name, m in frame.maps.items()}


def image_array(array: Any, height: int, width: int) -> np.ndarray:
    """An array over pixels as (H, W), one of colours or vectors as (H, W, 3), float32."""
    if isinstance(array, list) or dr.depth_v(array) > 1:
        return np.stack([image_array(part, height, width) for part in array], axis=-1)
    values = np.array(array, dtype=np.float32).ravel()
    return np.broadcast_to(values, height * width).reshape(height, width)


def panels(shot: RenderedView, view: View) -> dict[str, np.ndarray]:
    """Everything there is to see of a view, by title."""
    shown = {"ground truth": view.load().displayed, "render": shot.image}
    if view.normal is not None:
        covered = np.linalg.norm(view.normal, axis=-1)
        shown["true normals"] = on_white(0.5 + 0.5 * view.normal, covered)
    shown["normals"] = on_white(0.5 + 0.5 * shot.normal, shot.alpha)
    for name in (*(name for name, channel in ATTRIBUTES.items() if channel.aov), "visibility"):
        if name in shot.maps:
            values = shot.maps[name]
            grey = srgb_from_linear(values) if values.ndim == 3 else np.repeat(values[..., None], 3, axis=-1)
            shown[name] = on_white(grey, shot.alpha)
    return {title: np.clip(picture, 0, 1) for title, picture in shown.items()}


def light_panels(light: np.ndarray, truth: np.ndarray | None = None) -> dict[str, np.ndarray]:
    """A recovered lat-long light (h, w, 3), linear, and the true one at one exposure, by title.

    The recovered one is first brought to the true one by a least-squares scale per channel.
    """
    if truth is None:
        return {"recovered light": tonemap(light, _exposure(light))}
    fitted = light * np.array(environment(light, truth)["env_scale"])
    exposure = _exposure(truth)
    return {"recovered light": tonemap(fitted, exposure), "true light": tonemap(truth, exposure)}


def tonemap(radiance: np.ndarray, exposure: float) -> np.ndarray:
    """Radiance of any range as a picture: x / (1 + x) [Reinhard et al. 2002, eq. 3], sRGB-encoded."""
    scaled = np.maximum(radiance, 0) * exposure
    return np.clip(srgb_from_linear(scaled / (1 + scaled)), 0, 1)


def contact_sheet(
    rows: Sequence[dict[str, np.ndarray]], footer: dict[str, np.ndarray] | None = None
) -> np.ndarray:
    """A contact sheet: a row of titled pictures a view, and `footer` (lights) across the foot."""
    titles = list(dict.fromkeys(title for row in rows for title in row))
    factor = -(-CELL_MIN // min(next(iter(rows[0].values())).shape[:2]))
    body = [[(title, _enlarge(row[title], factor)) for title in titles if title in row] for row in rows]
    lines = [_line(cells) for cells in body]
    width = max(line.shape[1] for line in lines)
    if footer:
        share = (width - MARGIN * (len(footer) - 1)) // max(len(footer), 2)
        lines.append(_line([(title, _fit_width(picture, share)) for title, picture in footer.items()]))
    width = max(line.shape[1] for line in lines)
    padded = [
        np.pad(line, ((0, MARGIN), (0, width - line.shape[1]), (0, 0)), constant_values=1) for line in lines
    ]
    return np.concatenate(padded)


def _line(cells: Sequence[tuple[str, np.ndarray]]) -> np.ndarray:
    height = max(picture.shape[0] for _, picture in cells)
    columns = []
    for title, picture in cells:
        below = height - picture.shape[0]
        column = np.concatenate(
            [
                _title(title, picture.shape[1]),
                np.pad(picture, ((0, below), (0, 0), (0, 0)), constant_values=1),
            ]
        )
        columns.append(np.pad(column, ((0, 0), (0, MARGIN), (0, 0)), constant_values=1))
    return np.concatenate(columns, axis=1)[:, :-MARGIN]


def _title(text: str, width: int) -> np.ndarray:
    from PIL import Image, ImageDraw

    label = Image.new("RGB", (width, TITLE_HEIGHT), "white")
    ImageDraw.Draw(label).text((2, 2), text, fill="black")
    return np.asarray(label, dtype=np.float32) / 255


def _enlarge(picture: np.ndarray, factor: int) -> np.ndarray:
    return picture.repeat(factor, axis=0).repeat(factor, axis=1)


def _fit_width(picture: np.ndarray, width: int) -> np.ndarray:
    """A picture at another width, aspect kept, each channel resampled by Pillow's box filter."""
    from PIL import Image

    size = (width, max(1, round(picture.shape[0] * width / picture.shape[1])))
    planes = [Image.fromarray(np.ascontiguousarray(picture[..., i], dtype=np.float32)) for i in range(3)]
    return np.stack([np.asarray(plane.resize(size, Image.Resampling.BOX)) for plane in planes], axis=-1)


def side_by_side(pictures: Sequence[np.ndarray]) -> np.ndarray:
    """Pictures of one height side by side."""
    gap = np.ones((pictures[0].shape[0], MARGIN // 2, 3))
    parts = [part for picture in pictures for part in (gap, picture)]
    return np.concatenate(parts[1:], axis=1)


def on_white(picture: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """A picture (H, W, 3) over white."""
    alpha = np.clip(alpha, 0, 1)[..., None]
    return alpha * picture + (1 - alpha)


def _exposure(radiance: np.ndarray) -> float:
    """Scale that brings the average luminance over the sphere to LIGHT_KEY."""
    rows = np.sin((np.arange(radiance.shape[0]) + 0.5) / radiance.shape[0] * np.pi)
    mean = float(np.average((radiance @ LUMINANCE).mean(axis=1), weights=rows))
    return LIGHT_KEY / max(mean, 1e-8)
