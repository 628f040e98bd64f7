"""What is looked at before the first step of a fit, and by `refgs doctor DATA`: cameras are compared with
points, images with those of neighbouring cameras."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.distance import cdist

from mi_refgs.data.dataset import Dataset
from mi_refgs.data.images import CACHE_BYTES, ImageSource
from mi_refgs.data.region import region_of
from mi_refgs.data.view import View, evenly_spread
from mi_refgs.errors import InputError
from mi_refgs.io.images import linear_from_srgb

FINE, SAID, REFUSED = LEVELS = "fine", "said", "refused"
FEW_VIEWS = 20  # number of training views below which surfels overfit; published scenes have 100 and more
ONE_PLACE = 1e-4  # distance of cameras in one place from their mean, over that from the origin or the points
KEYPOINTS = 20  # in all, and of a view, from which a median is more than chance
FAR, TOO_FAR = 2.0, 8.0  # pixels of the file from a keypoint; COLMAP keeps 4 at most
WHOLE = 400  # longer side of a file, pixels, below which both are less in proportion: fits read about as many
OFF_VIEWS = 0.1  # share of views too far off from which a fit is refused: it would make fog of the scene
AHEAD, HALF, CLOUD = 0.95, 0.5, 0.25  # shares in front: of keypoints all are; at random, and in a room, half
STRETCHED, OFF_CENTRE = 0.05, 0.2  # fx / fy − 1, and distance from the centre over the size; lenses have 0.02
STOPS = 1.5  # 90 % range of brightness against neighbours; up to 1.0 in sets of one exposure
SHARP = 0.2  # of the neighbours' variance of the Laplacian; 0.5 in sharp sets, 0.1 at a blur of σ = 1 pixel
OVERLAP, COSINE = 0.1, 0.5  # share of its points that another view shows, and of the angle of the two, 60°
ALIKE, CONSTANT = 4 / 255, 0.9  # difference of colours of one background; share of the border that is it
POINTS, NEIGHBOURS = 2_000, 4  # points of a scene that are projected; views with which one is compared
IMAGES, PIXELS = 200, 150  # images that are looked at, and samples along their shorter side, at most
NOISE, ROUGH = 4.0, 3 * ALIKE  # tolerance in median deviations from a plain backdrop, and at most
STILL, TURNED = 0.75, 0.87  # share of the border that stays before a turntable; cosine of its least turn, 30°


@dataclass(frozen=True)
class Finding:
    name: str
    level: str  # of LEVELS
    numbers: dict[str, Any]  # for JSON
    error: InputError  # what is odd, likely causes and the remedy


def examine(data: Dataset) -> list[Finding]:
    """What CHECKS find in training views, whose images are decoded into the cache of the data set."""
    sight, found = Sight(data), list[Finding]()
    for name, measure, sentence in CHECKS:
        if (measured := measure(sight)) is not None:
            numbers = {k: float(f"{x:.3g}") if isinstance(x, float) else x for k, x in measured[0].items()}
            level, odd = LEVELS[measured[1]], [view.name for view in measured[2]]
            which = f"{len(odd)} of {len(data.views)} views, such as '{odd[0]}'," if odd else "all views"
            forced = "; `refgs train --force` fits them" if level == REFUSED else ""
            what = sentence.format(which=which, **numbers) + forced
            error = InputError(what, data.source or data.path, name)
            found.append(Finding(name, level, numbers | {"views": odd, "result": level}, error))
    return found


def heed(found: Sequence[Finding], warn: Callable[[str], None], force: bool) -> None:
    """Warn of what is odd; raises InputError for what no fit can use, unless forced."""
    for one in sorted(found, key=lambda one: one.level != REFUSED):
        if one.level == REFUSED and not force:
            raise one.error
        if one.level != FINE:
            warn(str(one.error))


def border_of(image: np.ndarray) -> np.ndarray:
    return np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]])


def off_backdrop(image: np.ndarray) -> np.ndarray:
    """How far the colours of an encoded image are from a plain backdrop, a polynomial of degree 2 that fits
    most of the border, in tolerances (H, W): the backdrop is where it is 1 at most."""
    y, x = np.mgrid[-1 : 1 : len(image) * 1j, -1 : 1 : len(image[0]) * 1j].astype(np.float32)
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)
    at, colours = border_of(terms), border_of(image)
    near = np.ones(len(at), bool)
    for _ in range(4):  # what is something else at the border is left out
        factors = np.linalg.lstsq(at[near], colours[near], rcond=None)[0].astype(np.float32)
        off = abs(at @ factors - colours).max(axis=-1)
        near = off <= np.quantile(off, CONSTANT)
    tolerance = min(max(ALIKE, NOISE * float(np.median(off))), ROUGH)
    return np.asarray(abs(terms @ factors - image).max(axis=-1) / tolerance)


class _Look(NamedTuple):
    view: View
    sharpness: float  # log2 of the variance of the Laplacian over the squared mean, as displayed
    brightness: float  # log2 of the mean linear colour of what is covered; both are NaN if nothing is
    border: np.ndarray  # (N, 3)
    plain: float  # share of it that a plain backdrop explains


def _look(view: View) -> _Look:
    loaded, step = view.load(), max(min(view.width, view.height) // PIXELS, 1)
    image, weight = loaded.displayed, loaded.covered()[::step, ::step]
    grey = np.clip(image[..., 1], 0, 1)
    bend = grey[1:-1, 1:-1] * 4 - grey[1:-1, :-2] - grey[1:-1, 2:] - grey[:-2, 1:-1] - grey[2:, 1:-1]
    colour = linear_from_srgb(np.clip(image[::step, ::step], 0, 1)).mean(axis=-1)
    sharp = bend.var() / max(grey.mean() ** 2, 1e-6) if bend.size and weight.any() else np.nan
    bright = np.average(colour, weights=weight) if weight.any() else np.nan
    off = np.inf if view.has_alpha else border_of(off_backdrop(image[::step, ::step]))
    sharpness, brightness = float(np.log2(sharp + 1e-12)), float(np.log2(bright + 1e-6))
    return _Look(view, sharpness, brightness, border_of(image)[::step], float(np.mean(off <= 1)))


Measured = tuple[dict[str, Any], int, Sequence[View]]  # numbers, index of LEVELS, and the views that are odd


class Sight:
    """The training views, what several checks need of them, and the checks; None: nothing to measure."""

    def __init__(self, data: Dataset) -> None:
        self.data, self.views = data, data.views
        poses = np.array([view.to_world for view in data.views])
        self.origins, self.axes = poses[:, :3, 3], poses[:, :3, 2]

    @cached_property
    def points(self) -> np.ndarray | None:
        """Some points (P, 3) of the scene: those of the data, or on a sphere that the cameras look at."""
        if self.data.points is not None:
            return self.data.points.position[evenly_spread(len(self.data.points.position), POINTS)]
        try:
            region = self.data.region or region_of(self.views)
        except InputError:
            return None
        offset = np.random.default_rng(0).normal(size=(POINTS, 3))
        return region.centre + region.radius * offset / np.linalg.norm(offset, axis=1)[:, None]

    @cached_property
    def shown(self) -> np.ndarray | None:
        """(V, P) whether a view shows a point."""
        return None if self.points is None else np.array([v.project(self.points)[2] for v in self.views])

    @cached_property
    def tracks(self) -> list[tuple[View, np.ndarray]]:
        """Views with the distances (K,) of points from keypoints, pixels; NaN behind the camera."""
        found = list[tuple[View, np.ndarray]]()
        for view in self.views:
            if view.tracks is not None and view.file is not None:
                local = (view.tracks[:, 2:] - view.to_world[:3, 3]) @ view.to_world[:3, :3]
                (fx, fy, cx, cy), lens = view.file.intrinsics, view.file.lens
                with np.errstate(over="ignore", invalid="ignore"):  # a lens is anything far out of the image
                    x, y = -local[:, :2].T / np.where(local[:, 2] > 0, local[:, 2], np.nan)
                    x, y = (x, y) if lens is None else lens.distort(x, y)
                    off = np.stack([fx * x + cx, fy * y + cy]) - view.tracks[:, :2].T
                found.append((view, np.hypot(*off)))
        return found

    @cached_property
    def looks(self) -> list[_Look]:
        """Of as many images as the cache holds at once, so that a fit does not decode them again."""
        held = CACHE_BYTES // (16 * max(view.width * view.height for view in self.views))
        with ThreadPoolExecutor() as pool:
            chosen = evenly_spread(len(self.views), max(min(IMAGES, held), 1))
            return [*pool.map(_look, [self.views[i] for i in chosen])]

    def beside(self, name: str) -> tuple[list[View], np.ndarray]:
        """Views, and how a number of their `looks` differs from the median of their neighbours, (L,)."""
        looks = [look for look in self.looks if np.isfinite(getattr(look, name))]
        if len(looks) <= 2 * NEIGHBOURS:
            return [], np.empty(0)
        values, views = np.array([getattr(look, name) for look in looks]), [look.view for look in looks]
        place = [[*v.to_world[:3, 3] / self.data.scene_extent, *v.to_world[:3, 2]] for v in views]
        near = np.argsort(cdist(place, place), axis=1)[:, 1 : 1 + NEIGHBOURS]
        return views, values - np.median(values[near], axis=1)

    def one_place(self) -> Measured:
        middle, scale = self.origins.mean(axis=0), float(np.abs(self.origins).max())
        spread = float(np.linalg.norm(self.origins - middle, axis=1).max())
        if self.data.points is not None:
            scale = max(scale, float(np.median(np.linalg.norm(self.data.points.position - middle, axis=1))))
        return {"spread": spread}, 2 * (spread <= ONE_PLACE * scale), ()

    def within(self) -> Measured | None:
        if self.data.region is None:
            return None
        inside = np.flatnonzero(self.data.region.contains(self.origins))
        level = (len(inside) > 0) + (2 * len(inside) > len(self.views))
        return {"count": len(inside)}, level, [self.views[i] for i in inside]

    def ahead(self) -> Measured | None:
        if self.tracks:
            share = 1 - float(np.isnan(np.concatenate([distance for _, distance in self.tracks])).mean())
            return {"share": share}, (share < AHEAD) + (share < HALF), ()
        if self.data.points is None or self.points is None:
            return None
        share = float(np.median([np.mean(view.depth_of(self.points) > 0) for view in self.views]))
        return {"share": share}, share < CLOUD, ()

    def keypoints(self) -> Measured | None:
        found = [(view, distance[np.isfinite(distance)]) for view, distance in self.tracks]
        every = np.concatenate([np.empty(0), *(distance for _, distance in found)])
        if len(every) < KEYPOINTS or (file := found[0][0].file) is None:
            return None
        median, p90 = np.quantile(every, (0.5, 0.9)).tolist()
        of_views = {view: float(np.median(d)) for view, d in found if len(d) >= KEYPOINTS}
        typical = max(median, float(np.quantile([median, *of_views.values()], 1 - OFF_VIEWS)))
        unit, worst = min(max(file.width, file.height) / WHOLE, 1), max([median, *of_views.values()])
        level = 2 if typical > TOO_FAR * unit else int(max(typical / FAR, worst / TOO_FAR) > unit)
        numbers = {"median": median, "p90": p90, "worst": worst, "size": f"{file.width} × {file.height}"}
        return numbers, level, [view for view, one in of_views.items() if one > FAR * unit and level]

    def aimless(self) -> Measured:
        odd = {look.view.name for look in self.looks if np.isnan(look.brightness)}
        if self.shown is not None:
            odd |= {self.views[i].name for i in np.flatnonzero(~self.shown.any(axis=1))}
        return {}, len(odd) > 0, [view for view in self.views if view.name in odd]

    def shape(self) -> Measured:
        given = [(v.fx / v.fy, v.cx / v.width + 0.5, v.cy / v.height + 0.5) for v in self.views]
        odd = abs(np.array(given) - 1) > (STRETCHED, OFF_CENTRE, OFF_CENTRE)
        stretch, *centre = abs(np.array(given) - 1).max(axis=0).tolist()
        views = [self.views[i] for i in np.flatnonzero(odd.any(axis=1))]
        return {"stretch": stretch, "offset": max(centre)}, len(views) > 0, views

    def exposure(self) -> Measured | None:
        views, stops = self.beside("brightness")
        spread = float(np.subtract(*np.quantile(stops, (0.95, 0.05)))) if views else 0.0
        return ({"stops": spread}, spread > STOPS, ()) if views else None

    def blur(self) -> Measured | None:
        views, sharp = self.beside("sharpness")
        odd = [views[i] for i in np.flatnonzero(2**sharp < SHARP)]
        return ({"least": float(2 ** sharp.min())}, len(odd) > 0, odd) if views else None

    def overlap(self) -> Measured | None:
        if self.shown is None or len(self.views) < 2:
            return None
        shown = self.shown.astype(np.float32)
        share = shown @ shown.T / np.maximum(shown.sum(axis=1), 1)[:, None]
        share[(self.axes @ self.axes.T < COSINE) | np.eye(len(share), dtype=bool)] = 0
        odd = [self.views[i] for i in np.flatnonzero((share.max(axis=1) < OVERLAP) & self.shown.any(axis=1))]
        return {"least": float(share.max(axis=1).min())}, len(odd) > 0, odd

    def background(self) -> Measured | None:
        if self.data.has_alpha:
            return None
        colour = np.median(np.concatenate([look.border for look in self.looks]), axis=0)
        share = float(np.mean([look.plain for look in self.looks]))
        return {"share": share, "colour": (255 * colour).round().tolist()}, share >= CONSTANT, ()

    def turntable(self) -> Measured | None:
        """Whether the background stays while the cameras turn, and is not the one colour of a cut-out."""
        if np.min(self.axes @ self.axes.T) > TURNED or len({(v.width, v.height) for v in self.views}) > 1:
            return None
        masked = [p for p in (v.pixels for v in self.views) if isinstance(p, ImageSource) and p.file.mask]
        borders = [look.border for look in self.looks]
        if masked:  # as photographed
            some = (masked[i] for i in evenly_spread(len(masked), 8))
            whole = (replace(x, file=replace(x.file, mask=None), has_alpha=False) for x in some)
            borders = [border_of(replace(self.views[0], pixels=x).load().displayed) for x in whole]
        middle = np.median(borders, axis=0)
        still = np.median(abs(borders - middle), axis=0).max(axis=-1) <= 2 * ALIKE
        varied = still.any() and middle[still].std(axis=0).max() > ALIKE
        return {"still": float(still.mean())}, bool(varied and still.mean() >= STILL), ()


WRONG = "another model's images file; images turned by EXIF, resized or cropped"
CHECKS: tuple[tuple[str, Callable[[Sight], Measured | None], str], ...] = (
    ("cameras", Sight.one_place, "{which} in one place show no shape; add images from other sides"),
    ("region", Sight.within, "{which} are inside of it, as the object would be; make its radius smaller"),
    ("views", lambda sight: ({"count": (count := len(sight.views))}, count < FEW_VIEWS, ()),
     "only {count} training views; others may look wrong"),
    ("points", Sight.ahead, "{share:.0%} are in front of their cameras; correct the axes of the poses"),
    ("keypoints", Sight.keypoints, "points project {median} pixels off in the median, {p90} at 90 %, in "
     f"images of {{size}}; {{which}} are off by up to {{worst}} ({WRONG}?); use files of one model"),
    ("frusta", Sight.aimless, "{which} show no point and no object; correct or leave them out"),
    ("shape", Sight.shape, "{which} are stretched by {stretch:.0%}, or cropped, {offset:.0%} off-centre"),
    ("exposure", Sight.exposure, "neighbours differ by {stops} stops; fit gains: --set event.exposure={{}}"),
    ("blur", Sight.blur, "{which} are blurred: {least:.0%} as sharp as neighbours; leave them out"),
    ("overlap", Sight.overlap, "{which} share nearly nothing with others; add images between them"),
    ("background", Sight.background, "{share:.0%} of the border is plain; doctor --masks cuts it out"),
    ("turntable", Sight.turntable, "{still:.0%} of the border stays while the cameras turn: seen from an "
     "object on a turntable, the light turns, too; fit with --turntable, or move the camera"),
)  # fmt: skip
"""Name, function and sentence of each check, in the order in which they are reported."""
