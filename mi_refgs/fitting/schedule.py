"""What follows from the method, the data and the iteration number alone, and lights that steps share."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np

from mi_refgs.constants import PATCH_EDGE
from mi_refgs.data.dataset import Dataset
from mi_refgs.data.hull import view_focus
from mi_refgs.errors import InputError
from mi_refgs.fitting import row_rates
from mi_refgs.fitting.events import place
from mi_refgs.fitting.optim import LearningRate
from mi_refgs.kernels.device import upload
from mi_refgs.methods import method as leaf
from mi_refgs.methods.extensions import EVENTS, Event
from mi_refgs.methods.method import Method, Rates
from mi_refgs.runs.checkpoint import PARAMS, part
from mi_refgs.shade.light.envmap import PrefilteredLight
from mi_refgs.shade.light.kind import FittedLight
from mi_refgs.shade.light.light import Light
from mi_refgs.shade.light.placed import PlacedLight
from mi_refgs.shade.shading import Shading
from mi_refgs.surfels.attributes import attribute
from mi_refgs.types import Float, TensorXf

DEFAULT_RATES = Rates()
LEARNT_BESIDE = {
    leaf.GAIN: (1e-3, 1e-4),
    leaf.POSE: (2e-3, 6e-5),
    leaf.LIGHT_ROTATION: (1e-2, 1e-4),
    leaf.LIGHT_SCALE: (1e-2, 1e-4),
}
"""Rates at start and end: of log gains, of radians or half widths, of radians and log scale of a light."""
POSITION_STEPS, POSITION_FINAL = 0.6, 1.6e-6
"""Share of the iterations until positions learn at their final rate, extents per step. [Ref-Gaussian]"""


@dataclass(frozen=True, eq=False)
class FitSetup:
    """Method and data of a fit, and what follows from them alone, by (1-based) iteration."""

    method: Method
    data: Dataset

    @cached_property
    def open_scene(self) -> bool:
        """Whether the images show a background that the method models apart from the object."""
        known = self.method.surroundings is not None and self.data.region is not None
        return known and not self.data.has_alpha

    @cached_property
    def events(self) -> list[Event[Any]]:
        """The events of the method, and those of every method, in their order."""
        always = {name: kind() for name, kind in EVENTS.items() if kind.always}
        return sorted((always | self.method.event).values(), key=lambda event: place(event.name))

    @cached_property
    def focus(self) -> np.ndarray:
        """The point (3,) that the training cameras look at, the region's centre, or else their mean."""
        views, region = self.data.views, self.data.region
        if region is not None:
            return np.array(region.centre)
        try:
            return view_focus(views)[0]
        except InputError:
            return np.mean([view.to_world[:3, 3] for view in views], axis=0)

    @cached_property
    def reach(self) -> float:
        """Half of the width that the median training view shows at the distance of `focus`, scene units."""
        views = self.data.views
        distance = [np.linalg.norm(view.to_world[:3, 3] - self.focus) for view in views]
        return float(np.median([d * v.width / (2 * v.fx) for d, v in zip(distance, views, strict=True)]))

    @cached_property
    def camera_axes(self) -> Float:
        """Axes of the training cameras in the world, (9 V,): rows of matrices that map to the world."""
        return upload(np.concatenate([view.to_world[:3, :3].ravel() for view in self.data.views]))

    def rng(self, iteration: int, operation: str) -> np.random.Generator:
        """Generator for one operation of an iteration; 0 is the initialisation."""
        return np.random.default_rng([self.method.seed, iteration, *operation.encode()])

    def view(self, iteration: int) -> int:
        """Index of the training view: sampling without replacement, a new permutation every epoch."""
        count = len(self.data.views)
        epoch, place = divmod(iteration - 1, count)
        return int(np.random.default_rng([self.method.seed, epoch, 1]).permutation(count)[place])

    def crop(self, iteration: int, width: int, height: int) -> tuple[int, int, int, int] | None:
        """Column, row, width and height of the part of an image that an iteration renders; None: all of it.
        It is drawn uniformly among the rectangles that overlap the image, then moved into it."""
        size = self.method.data.crop_of(width, height)
        if size == (width, height):
            return None
        draws, corner = self.rng(iteration, "crop"), []
        for side, whole in zip(size, (width, height), strict=True):
            first = draws.integers(-(side // PATCH_EDGE), whole // PATCH_EDGE + 1)
            corner.append(min(max(PATCH_EDGE * int(first), 0), whole - side))
        return corner[0], corner[1], *size

    def sh_degree(self, iteration: int) -> int:
        """SH degree of the radiance that is in use."""
        surfels = self.method.surfels
        return min(surfels.sh_raise.count(iteration), surfels.degree_of("radiance_sh"))

    def light_learns(self, iteration: int) -> bool:
        """Whether the light learns from the iterations since it last did; always where a stage ends."""
        light = self.method.light
        ends = [stage.until for _, stage in self.method.stages()]
        return light is not None and (iteration % light.every == 0 or iteration in ends)

    def groups(self, params: Mapping[str, TensorXf]) -> dict[str, LearningRate]:
        """Learning rates by the name of the parameter."""
        rates, iterations, extent = self.method.rates, self.method.iterations, self.data.scene_extent
        groups = learning_rates(self.method.surfels.names, extent, iterations, rates)
        around = self.method.surroundings
        if self.open_scene and around is not None:
            table = learning_rates(around.names, extent, iterations, rates)
            # The farther a surface, the less is known of its place.
            assert self.data.region is not None
            distance = row_rates.ByDistance(self.data.region.centre, extent)
            table["position"] = replace(table["position"], by_row=distance)
            groups |= {leaf.AROUND + name: group for name, group in table.items()}
            groups[leaf.BACKGROUND] = LearningRate(around.rate, around.rate * rates.decay, iterations)
        if self.method.light is not None and self.method.light.learns:
            final = rates.light * rates.decay
            by_row = row_rates.relative if rates.light_relative else None
            groups[leaf.LIGHT] = LearningRate(rates.light, final, iterations, by_row=by_row)
        for name, (rate, final) in LEARNT_BESIDE.items():
            if name in params:
                groups[name] = LearningRate(rate, final, iterations)
        cameras: Any = self.method.event.get("cameras")
        if leaf.POSE in groups and cameras is not None:  # whose corrections begin late
            groups[leaf.POSE] = replace(groups[leaf.POSE], begin=cameras.begins(iterations))
        pixels = max(view.width * view.height for view in self.data.views)
        linear = rates.linear_from is not None and pixels >= rates.linear_from
        return {name: replace(group, linear=linear) for name, group in groups.items()}

    def require_own(self, state: Mapping[str, np.ndarray], run: Path | None = None) -> None:
        """Raise InputError for a parameter of a state, written to `run`, of another shape than this fit's,
        but for the numbers of surfels and pixels."""
        surfels, around, light = self.method.surfels, self.method.surroundings, self.method.light
        wanted: dict[str, tuple[int, ...]] = {name: (surfels.columns(name),) for name in surfels.names}
        if self.open_scene and around is not None:
            background = replace(surfels, primitive=around.primitive, degree={"radiance_sh": around.degree})
            wanted |= {leaf.AROUND + name: (background.columns(name),) for name in around.names}
            wanted[leaf.BACKGROUND] = (2 * around.height, 3)
        if light is not None:
            wanted[leaf.LIGHT] = light.shape()[1:]
            wanted |= {f"{leaf.LIGHT}_{name}": (3,) for name in light.placement}
            wanted |= {leaf.TURNTABLE: (3,)} if light.turntable else {}
        found = {
            name: values.shape if name in leaf.PER_VIEW else values.shape[1:]
            for name, values in part(state, PARAMS).items()
        }
        per_view = {leaf.GAIN: (len(self.data.views), 3), leaf.POSE: (len(self.data.views), 6)}
        wanted |= {name: shape for name, shape in per_view.items() if name in found}
        for name in wanted | found:
            if found.get(name) != wanted.get(name):
                has, wants = found.get(name, "none"), wanted.get(name, "none")
                what = f"it has {has}, a fit of this method to {self.data.path} {wants}"
                remedy = "resume with the method and the data set that the run began with"
                raise InputError(what, run or "checkpoint", name, f"{remedy}, or choose another -o")


def learning_rates(
    names: Iterable[str], extent: float, iterations: int, rates: Rates = DEFAULT_RATES
) -> dict[str, LearningRate]:
    """The rates at which attributes of surfels learn in a fit of so many iterations, by their names;
    positions in parts of the scene's extent, scene units (`Dataset.scene_extent`)."""
    groups = {}
    for name in names:
        rate, head = rates.of(name), 3 if attribute(name).harmonics else 0
        rest = rates.rest.get(name, attribute(name).rest_rate)
        groups[name] = LearningRate(rate, rate * rates.decay, iterations, head, rest)
    if "radiance_sh" in groups and rates.diffuse_relative:
        groups["radiance_sh"] = replace(groups["radiance_sh"], by_row=row_rates.of_diffuse_colour)
    if "curvature" in groups:  # 1/scene unit
        groups["curvature"] = replace(groups["curvature"], by_row=row_rates.of_mirrors, unit=1 / extent)
    start, final = rates.of("position") * extent, POSITION_FINAL * extent
    groups["position"] = LearningRate(start, final, int(POSITION_STEPS * iterations), unit=extent)
    return groups


GATHERED = "light_gradient"  # name of the gradient of the levels in a checkpoint


class SharedPrefilter:
    """The light of a fit, filtered once for several steps, whose gradients it learns from together when
    `close` ends them: filtering costs a quarter of a small step."""

    def __init__(self) -> None:
        self._light: PrefilteredLight | None = None  # attached to the environment
        self._leaf: Float = None  # its levels, which accumulate the gradients of the steps if it learns

    def light(self, environment: FittedLight | None, shading: Shading) -> Light | None:
        """The light of a step, under AD; a light that is not filtered stays attached to its environment."""
        if isinstance(environment, PlacedLight):
            light = self.light(environment.map, shading)
            return None if light is None else environment.placed(light)
        if self._light is not None and shading.model.light == "filtered":
            return replace(self._light, levels=self._leaf)
        light = shading.light_of(environment)
        if not isinstance(light, PrefilteredLight):
            return light
        self._light, self._leaf = light, dr.detach(light.levels)
        dr.set_grad_enabled(self._leaf, dr.grad_enabled(light.levels))
        return replace(light, levels=self._leaf)

    def close(self) -> None:
        """Add the accumulated gradient to that of the environment; a fixed light stays filtered."""
        if self._light is None or not dr.grad_enabled(self._leaf):
            return
        dr.set_grad(self._light.levels, dr.grad(self._leaf))
        dr.enqueue(dr.ADMode.Backward, self._light.levels)
        dr.traverse(dr.ADMode.Backward)
        self._light = self._leaf = None

    def state(self) -> dict[str, np.ndarray]:
        """The accumulated gradient for a checkpoint; empty if there is none."""
        learns = self._leaf is not None and dr.grad_enabled(self._leaf)
        return {} if not learns else {GATHERED: np.array(dr.grad(self._leaf), dtype=np.float32)}

    def restore(
        self, environment: FittedLight | None, shading: Shading, state: Mapping[str, np.ndarray]
    ) -> None:
        """Continue from a checkpoint; a gradient of other levels, as in a trial, is left out."""
        if (gathered := state.get(GATHERED)) is None or environment is None:
            return
        self.light(environment, shading)
        if self._leaf is not None and dr.width(self._leaf) == len(gathered):
            dr.set_grad(self._leaf, upload(gathered))
