"""Images (H, W, 3) for display, encoded, in [0, 1]: views, maps as colours, contact sheets, environments."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from scipy.ndimage import map_coordinates
from skimage.transform import resize_local_mean

from mi_refgs.data.dataset import Dataset
from mi_refgs.data.view import View
from mi_refgs.evaluation.metrics import environment
from mi_refgs.fitting.image_error import displayed_image
from mi_refgs.io.exr import LUMINANCE
from mi_refgs.io.images import srgb_from_linear
from mi_refgs.render.display import image_array
from mi_refgs.render.pipeline import Frame
from mi_refgs.shade.light.lobe_matrices import map_directions
from mi_refgs.surfels.attributes import ATTRIBUTES

Maps = dict[str, np.ndarray]  # images by title, or maps by name
LIGHT_KEY = 0.36  # average luminance of a displayed environment before the tone curve, which maps it to 0.55
CELL_MIN = 128  # pixels: smaller images are enlarged by a whole factor
MARGIN = 4  # pixels between images
TITLE_MIN, TITLE_MAX, TITLE_PART = 10, 22, 14  # heights of titles, pixels, and widths of images per height
BESIDE_GREYS = np.array([0.80, 0.87, 0.95])  # pale blue: on white, a metallic of 1 would not be visible


def displayed_over(rgba: np.ndarray, background: np.ndarray, scale: np.ndarray | float = 1.0) -> np.ndarray:
    """Display-encode premultiplied linear RGBA (H, W, 4), scaled, over an encoded background: (H, W, 3)."""
    alpha = np.clip(rgba[..., 3:], 0, 1)
    return encoded_over_black(rgba[..., :3] * scale, alpha) + (1 - alpha) * background


def encoded_over_black(radiance: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Display-encode premultiplied radiance over black."""
    return alpha * np.clip(srgb_from_linear(np.maximum(radiance, 0) / np.maximum(alpha, 1e-6)), 0, 1)


@dataclass(frozen=True, eq=False)
class RenderedView:
    """A rendered view as NumPy arrays."""

    image: np.ndarray  # (H, W, 3) display-encoded, over the data's background
    alpha: np.ndarray  # (H, W) of the object, which has the normals and maps
    normal: np.ndarray  # (H, W, 3) unit, or 0 where there is no surface
    maps: Maps  # (H, W) or (H, W, 3), linear

    @staticmethod
    def of(frame: Frame, data: Dataset, view: View) -> RenderedView:
        """Copy a frame of one of the data set's views; waits for the device."""
        size = view.height, view.width
        normal = image_array(frame.normal, *size)
        length = np.linalg.norm(normal, axis=-1, keepdims=True)
        return RenderedView(
            displayed_image(frame, view, data),
            image_array(frame.object_alpha, *size),
            np.where(length > 1e-6, normal / np.maximum(length, 1e-6), 0),
            RenderedView.maps_of(frame, *size),
        )

    @staticmethod
    def maps_of(frame: Frame, height: int, width: int) -> Maps:
        """Copy only the maps of a frame."""
        return {name: image_array(m, height, width) for name, m in frame.maps.items()}


def panels(rendered: RenderedView, view: View, scale: np.ndarray | float = 1.0) -> Maps:
    """Return fitted maps next to the ground truth that a loaded view has, by title; albedo after a scale."""
    pairs = {"image": [rendered.image, view.displayed]}
    pairs["normals"] = [normal_colours(rendered.normal, rendered.alpha)]
    if view.normal is not None:
        pairs["normals"].append(normal_colours(view.normal, np.linalg.norm(view.normal, axis=-1)))
    for name in (*(name for name, attribute in ATTRIBUTES.items() if attribute.aov), "visibility"):
        if name in rendered.maps:
            ours = rendered.maps[name] * (scale if name == "albedo" else 1.0)
            pairs[name] = [material_colours(ours, rendered.alpha)]
            if (true := view.materials.get(name)) is not None:
                pairs[name].append(material_colours(true[..., :-1], true[..., -1]))
    sides = {1: "fitted", 2: "fitted | ground truth"}
    found = {}
    for name, pair in pairs.items():
        gap = np.ones((view.height, MARGIN // 2, 3))
        row = np.concatenate([part for image in pair for part in (gap, image)][1:], axis=1)
        found[f"{name}: {sides[len(pair)]}"] = np.clip(row, 0, 1)
    return found


def normal_colours(normal: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Convert unit normals (H, W, 3) to colours over white."""
    return over_colour(0.5 + 0.5 * normal, alpha)


def material_colours(values: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Convert linear colours (H, W, 3) to colours over white, numbers (H, W[, 1]) to greys over pale blue."""
    values = values.reshape(*alpha.shape, -1)
    if values.shape[-1] == 3:
        return over_colour(srgb_from_linear(values), alpha)
    return over_colour(np.repeat(values, 3, axis=-1), alpha, BESIDE_GREYS)


def over_colour(image: np.ndarray, alpha: np.ndarray, colour: np.ndarray | float = 1.0) -> np.ndarray:
    """Composite an image (H, W, 3) by alpha (H, W) over a colour (3,), by default white."""
    alpha = np.clip(alpha, 0, 1)[..., None]
    return alpha * image + (1 - alpha) * colour


def light_panels(light: np.ndarray, truth: np.ndarray | None = None) -> Maps:
    """Tone-map a fitted map (h, w, 3), scaled per channel, and the ground truth at one exposure, by title."""
    if truth is None:
        return {"fitted environment": light_image(light)}
    fitted = light_image(light * np.array(environment(light, truth)["env_scale"]), truth)
    return {"fitted environment": fitted, "ground-truth environment": light_image(truth)}


def light_image(radiance: np.ndarray, reference: np.ndarray | None = None) -> np.ndarray:
    """Map a lat-long map (h, 2h, 3) to an image, +z at the top, by x / (1 + x) [Reinhard et al. 2002, eq. 3]
    at the exposure that maps the mean luminance of `reference`, or of the map, to LIGHT_KEY."""
    reference = radiance if reference is None else reference
    rows = np.sin((np.arange(len(reference)) + 0.5) / len(reference) * np.pi)
    mean = float(np.average((reference @ LUMINANCE).mean(axis=1), weights=rows))
    scaled = np.maximum(radiance, 0) * (LIGHT_KEY / max(mean, 1e-8))
    return upright(np.clip(srgb_from_linear(scaled / (1 + scaled)), 0, 1))


def upright(image: np.ndarray) -> np.ndarray:
    """Turn a map (h, 2h, 3) whose top is +y, as in files, so that it is +z, which is up in scenes."""
    height = len(image)
    x, z, y = np.moveaxis(map_directions(height) * [1, 1, -1], -1, 0)  # world directions of the new texels
    row = np.arccos(np.clip(y, -1, 1)) / np.pi * (height - 1)
    column = np.arctan2(x, -z) % (2 * np.pi) / (2 * np.pi) * 2 * height - 0.5
    wrapped = np.pad(image, ((0, 0), (1, 1), (0, 0)), mode="wrap")
    planes = [map_coordinates(wrapped[..., i], (row, column + 1), order=1, mode="nearest") for i in range(3)]
    return np.stack(planes, axis=-1)


def contact_sheet(rows: Sequence[Maps], footer: Maps | None = None) -> np.ndarray:
    """Arrange titled images in a sheet: one row per view, and `footer` (environment maps) below."""
    titles = list(dict.fromkeys(title for row in rows for title in row))
    factor = -(-CELL_MIN // min(next(iter(rows[0].values())).shape[:2]))
    enlarged = [{t: row[t].repeat(factor, 0).repeat(factor, 1) for t in titles if t in row} for row in rows]
    narrowest = min(image.shape[1] for row in enlarged for image in row.values())
    size = min(max(narrowest // TITLE_PART, TITLE_MIN), TITLE_MAX)
    lines = [_line(row, size) for row in enlarged]
    width = max(line.shape[1] for line in lines)
    if footer:
        part = (width - MARGIN * (len(footer) - 1)) // max(len(footer), 2)
        sizes = {title: (round(len(image) * part / image.shape[1]), part) for title, image in footer.items()}
        shown = {title: resize_local_mean(footer[title], shape) for title, shape in sizes.items()}
        lines.append(_line(shown, size))  # no wider
    return np.concatenate([_padded(line, MARGIN, width - line.shape[1]) for line in lines])


def _line(cells: Maps, size: int) -> np.ndarray:
    """Place images with titles of a size side by side."""
    font = ImageFont.load_default(size)
    title_height = round(1.2 * size) + 2
    height = max(image.shape[0] for image in cells.values())
    columns = []
    for text, image in cells.items():
        label = Image.new("RGB", (image.shape[1], title_height), "white")
        ImageDraw.Draw(label).text((2, 0), text, fill="black", font=font)
        title = np.asarray(label, dtype=np.float32) / 255
        columns.append(_padded(np.concatenate([title, image]), height - image.shape[0], MARGIN))
    return np.concatenate(columns, axis=1)[:, :-MARGIN]


def _padded(image: np.ndarray, below: int, right: int) -> np.ndarray:
    return np.pad(image, ((0, below), (0, right), (0, 0)), constant_values=1)
