"""State of a fit: everything that its steps change, and its form in a checkpoint.

A checkpoint contains named arrays (`runs.checkpoint` reads, checks and writes the files):

    params/NAME  optimiser/NAME/PART       parameters, and Adam's moments and counters of each
    error_sum                              per surfel, with the prefix "surroundings/" for the background
    mesh/PART                              the occluder, if there is one
    photographed/PART                      the background as the object's light, if it was rendered
    iteration  seconds  held_until  decisions  region  light_gradient"""

import json
import sys
from collections.abc import Mapping, MutableMapping
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.data.region import Region
from mi_refgs.errors import InputError
from mi_refgs.fitting.initial import initial_parameters
from mi_refgs.fitting.optim import Adam
from mi_refgs.fitting.photographed_light import PhotographedLight
from mi_refgs.fitting.schedule import FitSetup, SharedPrefilter
from mi_refgs.kernels.device import upload
from mi_refgs.methods.method import AROUND, TURNTABLE, Stage
from mi_refgs.occlusion.mesh import Mesh
from mi_refgs.occlusion.surface_materials import VertexColours, VertexSurfels
from mi_refgs.occlusion.visibility import Occluder
from mi_refgs.render.pipeline import SurfelScene
from mi_refgs.render.surroundings import Surroundings
from mi_refgs.runs import checkpoint
from mi_refgs.runs.checkpoint import MESH, OPTIMISER, PARAMS, PHOTOGRAPHED
from mi_refgs.shade.ambient import update_occluder_caches
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.light.kind import FittedLight, LightKind
from mi_refgs.shade.light.light import Light
from mi_refgs.shade.shading import Shading
from mi_refgs.surfels.attributes import ATTRIBUTES
from mi_refgs.surfels.init import morton_order
from mi_refgs.surfels.table import Surfels
from mi_refgs.types import Bool, Float, TensorXf, UInt32


@dataclass(frozen=True)
class TableEdit:
    """New surfels; row i descends from row parent[i] of the old ones, and is `fresh` if it has no history."""

    surfels: Surfels
    parent: np.ndarray  # (M,) uint32
    fresh: np.ndarray  # (M,) bool


@dataclass(eq=False)
class ParameterTable:
    """One set of surfels as parameters: edits of its rows, which moments and statistics follow."""

    params: MutableMapping[str, TensorXf]  # (N, D) each, also of others; this table's have the prefix
    optimiser: Adam
    prefix: str = ""  # "" of the object, AROUND of the background; of `mi.traverse`, as "refgs."
    max_count: int = sys.maxsize  # most surfels that the method allows
    occluder: Occluder = field(default_factory=Occluder)  # its vertices have surfels of the object by row
    error_sum: Float = None  # (N,) squared error that each is responsible for, since the last densification

    def __post_init__(self) -> None:
        self.clear()

    @property
    def surfels(self) -> Surfels:
        """The surfels, attached to the leaves that the optimiser owns."""
        found = checkpoint.channels_of(self.params, self.prefix)
        return Surfels({name: tensor for name, tensor in found.items() if name in ATTRIBUTES})

    def clear(self) -> None:
        """Set the errors to zero."""
        self.error_sum = dr.opaque(mi.Float, 0, self.surfels.count)

    def observe(self, error: Float) -> None:
        """Add the squared error (N,) of a step, Σ w e² by responsible surfel, to the statistics."""
        self.error_sum += dr.select(dr.isfinite(error), error, 0.0)
        dr.schedule(self.error_sum)

    def apply(self, edit: TableEdit) -> None:
        """Replace the surfels by edited ones in Morton order; moments and statistics follow the rows.
        Raises InputError for an edit whose arrays have other lengths than its surfels, or unknown parents."""
        before, count, parents = self.surfels.count, edit.surfels.count, edit.parent
        known = (parents >= 0) & (parents < before)
        if not len(parents) == len(edit.fresh) == count or not known.all():
            what = f"an edit to {count} surfels with {len(parents)} parents among {before} rows"
            raise InputError(what, "event", remedy="give each new row its old one in `parent` and `fresh`")
        order = morton_order(edit.surfels.raw["position"].numpy())
        parent, fresh = upload(edit.parent[order], mi.UInt32), upload(edit.fresh[order], mi.Bool)
        self._move(edit.surfels.gather(upload(order, mi.UInt32)), parent, fresh)

    def remove(self, rows: np.ndarray) -> None:
        """Remove surfels; raises InputError if none would be left."""
        surfels = self.surfels
        parent = np.delete(np.arange(surfels.count), rows)
        if not len(parent):
            raise InputError("none of them is finite", "surfels", remedy="lower the rates (--set rates.…)")
        index = upload(parent, mi.UInt32)
        self._move(surfels.gather(index), index, dr.zeros(mi.Bool, len(parent)))

    def _move(self, surfels: Surfels, parent: UInt32, fresh: Bool) -> None:
        """Replace the surfels by descendants of the rows `parent`; those that are `fresh` have no history."""
        self.replace(surfels)
        self.optimiser.gather(parent, self._names(surfels), fresh)
        self.error_sum = dr.select(fresh, 0, dr.gather(mi.Float, self.error_sum, parent))
        dr.eval(self.error_sum)
        self.occluder.vertex_surfels = None

    def replace(self, surfels: Surfels, cleared: tuple[str, ...] = ()) -> None:
        """Replace the surfels; the attributes in `cleared` lose their moments."""
        self.params.update({self.prefix + name: tensor for name, tensor in surfels.raw.items()})
        dr.enable_grad([self.params[name] for name in self._names(surfels)])
        for name in cleared:
            if self.prefix + name in self.params:
                self.optimiser.reset(self.prefix + name)

    def _names(self, surfels: Surfels) -> list[str]:
        return [self.prefix + name for name in surfels.raw]


@dataclass(eq=False)
class FitState:
    """What the steps of a fit change; exactly what a checkpoint contains."""

    params: dict[str, TensorXf]  # raw, by name: surfels, AROUND + surfels, LIGHT, BACKGROUND, GAIN, POSE
    optimiser: Adam
    tables: list[ParameterTable]  # object, and background if there is one
    occluder: Occluder
    prefilter: SharedPrefilter = field(default_factory=SharedPrefilter)
    iteration: int = 0  # steps done
    seconds: float = 0.0  # spent in steps
    held_until: int = 0  # iteration before which opacities do not learn
    decisions: list[dict[str, Any]] = field(default_factory=list)  # about components of the method
    region: Region | None = None  # of interest, once it has followed the object
    photographed: PhotographedLight | None = None  # the background as the object's light
    light_kind: LightKind | None = None  # of the method

    @staticmethod
    def start(setup: FitSetup) -> "FitState":
        """The state before the first step."""
        params = initial_parameters(setup.method, setup.data, setup.rng(0, "start"), setup.open_scene)
        return FitState._assembled(setup, params, Occluder())

    @staticmethod
    def _assembled(setup: FitSetup, params: dict[str, TensorXf], occluder: Occluder) -> "FitState":
        optimiser, method = Adam(params, setup.groups(params)), setup.method
        limits = {"": method.surfels.most}
        if setup.open_scene and method.surroundings is not None:
            limits[""], limits[AROUND] = method.surroundings.limits(limits[""])
        tables = [ParameterTable(params, optimiser, name, most, occluder) for name, most in limits.items()]
        return FitState(params, optimiser, tables, occluder, light_kind=method.light)

    def add(self, setup: FitSetup, name: str, tensor: TensorXf) -> None:
        """Add a parameter without history, or replace the one of this name."""
        self.params[name] = tensor
        self.optimiser.add(name, setup.groups(self.params)[name])

    def observe(self, error: Float) -> None:
        """Add the squared error of a step, by responsible surfel, the object's first, to the statistics."""
        begin = mi.UInt32(0)
        for table in self.tables:
            count = dr.width(table.error_sum)
            one = len(self.tables) == 1
            table.observe(error if one else dr.gather(mi.Float, error, dr.arange(mi.UInt32, count) + begin))
            begin = dr.opaque(mi.UInt32, count)

    @property
    def surfels(self) -> Surfels:
        """The object, attached to the leaves that the optimiser owns."""
        return self.tables[0].surfels

    @property
    def surroundings(self) -> Surroundings | None:
        """The background in images without alpha, also attached."""
        return checkpoint.surroundings_of(self.params)

    @property
    def light(self) -> FittedLight | None:
        """The light, also attached."""
        return checkpoint.light_of(self.light_kind, self.params)

    @property
    def turntable(self) -> TensorXf | None:
        """Axes of the camera with which the light turns."""
        return self.params.get(TURNTABLE)

    def shading(self, stage: Stage) -> Shading:
        """Shading options of a stage with the present occluder."""
        return Shading.resolve(stage.shading, not self.occluder.empty)

    def scene(self, shading: Shading, light: Light | None, surfels: Surfels | None = None) -> SurfelScene:
        """The object, or other `surfels` in its place, with what lights, occludes and surrounds it."""
        near = None if self.photographed is None else self.photographed.near
        given = (light, self.occluder, self.surroundings, near, self.turntable)
        return SurfelScene(surfels or self.surfels, shading, *given)

    def update_missing_caches(self, shading: Shading) -> None:
        """Compute the caches that the shading requires and the occluder lacks."""
        occluder = self.occluder
        if shading.ambient_rays and occluder.ambient is None:
            light = shading.light_of(self.light if self.turntable is None else EnvironmentLight.constant())
            update_occluder_caches(occluder, self.surfels, light, shading)
        if shading.traced_bounces and occluder.vertex_surfels is None:
            occluder.set_materials(self.surfels)

    def arrays(self) -> dict[str, np.ndarray]:
        """The content of a checkpoint."""
        state = {f"{PARAMS}{name}": tensor.numpy() for name, tensor in self.params.items()}
        state |= {f"{OPTIMISER}{name}": value for name, value in self.optimiser.state_dict().items()}
        for table in self.tables:
            state[f"{table.prefix}error_sum"] = table.error_sum.numpy()
        state |= {name: np.array(getattr(self, name)) for name in ("iteration", "seconds", "held_until")}
        state |= self.prefilter.state()
        region = None if self.region is None else self.region.content
        for name, value in {"decisions": self.decisions, "region": region}.items():
            if value:
                state[name] = np.frombuffer(json.dumps(value).encode(), np.uint8)
        if self.photographed is not None:
            state |= {f"{PHOTOGRAPHED}{name}": x for name, x in self.photographed.arrays().items()}
        if (mesh := self.occluder.mesh) is not None:
            state |= {f"{MESH}vertices": mesh.vertices, f"{MESH}faces": mesh.faces}
            state[f"{MESH}voxel"] = np.array(mesh.voxel)
        if self.occluder.vertex_surfels is not None:
            state |= {f"{MESH}{name}": x for name, x in self.occluder.vertex_surfels.arrays().items()}
        if self.occluder.ambient is not None:
            state[f"{MESH}ambient"] = self.occluder.ambient.numpy()
        return state

    @staticmethod
    def from_arrays(setup: FitSetup, state: Mapping[str, np.ndarray]) -> "FitState":
        """Restore the content of a checkpoint of this setup, bit for bit."""
        made = FitState._assembled(setup, checkpoint.tensors(state, PARAMS), _occluder_of(state))
        made.optimiser.load_state_dict(checkpoint.part(state, OPTIMISER))
        for table in made.tables:
            table.error_sum = upload(state[f"{table.prefix}error_sum"])
        made.iteration, made.seconds = int(state["iteration"]), float(state["seconds"])
        made.held_until = int(state["held_until"])
        made.decisions = decisions_of(state)
        if "region" in state:
            made.region = Region.of(json.loads(state["region"].tobytes()), "checkpoint")
        if f"{PHOTOGRAPHED}weight" in state:
            made.photographed = PhotographedLight.restored(checkpoint.part(state, PHOTOGRAPHED))
        _, stage = setup.method.stage_at(max(made.iteration, 1))
        made.prefilter.restore(made.light, made.shading(stage), state)
        return made


def decisions_of(state: Mapping[str, np.ndarray]) -> list[dict[str, Any]]:
    """The decisions about components of the method in a checkpoint."""
    return json.loads(state["decisions"].tobytes()) if "decisions" in state else []


def _occluder_of(state: Mapping[str, np.ndarray]) -> Occluder:
    """The occluder of a checkpoint, with its caches if it has any."""
    occluder = Occluder()
    if f"{MESH}faces" in state:
        mesh = Mesh(state[f"{MESH}vertices"], state[f"{MESH}faces"], float(state[f"{MESH}voxel"]))
        occluder.update(mesh)
        if f"{MESH}surfels" in state:
            count = len(state[f"{PARAMS}position"])
            occluder.vertex_surfels = VertexSurfels(mesh, count, checkpoint.part(state, MESH))
        if f"{MESH}ambient" in state:
            occluder.ambient = VertexColours(mesh, state[f"{MESH}ambient"])
    return occluder
