"""The optimisation loop: stages from the method, one view a step, refinement and meshes on their windows.

A step is a pure function of the state and the iteration number (view order and random draws are derived from
the seed and the iteration), so a resumed run repeats a straight one: bit for bit with one thread.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from itertools import tee
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.data.dataset import Dataset
from mi_refgs.device import upload
from mi_refgs.errors import InputError
from mi_refgs.fit import health, refine
from mi_refgs.fit.initial import initial_surfels
from mi_refgs.fit.objective import Target, objective
from mi_refgs.fit.optim import Adam, Group
from mi_refgs.fit.schedule import Schedule
from mi_refgs.methods.method import LightOptions, Method, Stage
from mi_refgs.occlusion.mesh import Mesh, extract_mesh
from mi_refgs.occlusion.tsdf import bounds_from_points, fuse
from mi_refgs.occlusion.visibility import Occluder
from mi_refgs.render.pipeline import Frame, render, render_depth
from mi_refgs.runs.checkpoint import LIGHT, OPTIMISER, PARAMS, part, tensors
from mi_refgs.runs.interrupt import held_interrupts
from mi_refgs.runs.run import Run
from mi_refgs.shade.envmap import EnvironmentLight
from mi_refgs.shade.shading import Shading
from mi_refgs.splat import Camera
from mi_refgs.surfels.table import Surfels
from mi_refgs.timing import phase


def _shapes(method: Method) -> dict[str, tuple[int, ...]]:
    """The shape of every parameter of a method, without the first axis."""
    shapes: dict[str, tuple[int, ...]] = {
        name: (method.surfels.columns(name),) for name in method.surfels.names
    }
    return shapes if method.light is None else shapes | {LIGHT: (2 * method.light.height, 3)}


def first_light(options: LightOptions) -> EnvironmentLight:
    """The environment that a fit starts with: one radiance everywhere."""
    return EnvironmentLight.constant(options.radiance, options.height)


class Trainer:
    """The state of a fit and the step that advances it."""

    def __init__(
        self,
        method: Method,
        data: Dataset,
        run: Run | None = None,
        state: dict[str, np.ndarray] | None = None,
    ) -> None:
        """Set up a fit of `data`, from a `state`, or the newest checkpoint of `run` if it has one."""
        self.method, self.data, self.run = method, data, run
        self.extent = data.scene_extent
        self.schedule = Schedule(method, len(data.views))
        self.targets = [Target.of(view, data.background) for view in data.views]
        self.occluder = Occluder()
        self.iteration, self.seconds = 0, 0.0
        self.held_until = 0  # iteration before which opacities do not learn
        self.skipped = 0  # steps that changed nothing, since their loss or gradient was not finite
        self.notices: list[str] = []  # messages for people; who shows one removes it
        self._checked, self._failed = 0, 0  # iteration of the last check; failed steps in a row
        self.params: dict[str, Any] = {}
        self.gradient_sum: Any = None  # of each surfel since it was densified last, and of how many views
        self.gradient_count: Any = None
        if state is None and run is not None:
            state = run.load_checkpoint()
        if state is None:
            self.params |= initial_surfels(method, data, self.schedule.rng(0)).raw
            if method.light is not None:
                self.params[LIGHT] = first_light(method.light).raw
            self.optimiser = Adam(self.params, self._groups())
            self._clear_statistics()
        else:
            self._restore(state)
        self.loss: Any = None
        self.error: Any = None

    # ---------------- what others look at ----------------

    @property
    def surfels(self) -> Surfels:
        """The table, attached to the leaves that the optimiser owns."""
        return Surfels({name: tensor for name, tensor in self.params.items() if name != LIGHT})

    @property
    def light(self) -> EnvironmentLight | None:
        """The environment, attached likewise."""
        return EnvironmentLight(self.params[LIGHT]) if LIGHT in self.params else None

    def shading(self, iteration: int | None = None) -> Shading:
        """How the present (or another) iteration shades."""
        _, stage = self.method.stage_at(iteration or max(self.iteration, 1))
        return self._shading(stage)

    def view(self, camera: Camera, aovs: bool = True) -> Frame:
        """Render a view of the present state, without derivatives."""
        with dr.suspend_grad():
            shading = self.shading()
            return render(
                self.surfels,
                camera,
                shading,
                shading.light_of(self.light),
                self.occluder,
                sh_degree=self.schedule.sh_degree(self.iteration),
                aovs=aovs,
            )

    # ---------------- the loop ----------------

    def train(self, progress: Callable[[Trainer], None] | None = None) -> None:
        """Run to the last iteration; an interrupt ends it after the step in hand, saved, and is passed on.

        Raises InputError when the run folder cannot be written: a checkpoint interval is lost at most.
        """
        with held_interrupts() as release:
            while self.iteration < self.method.iterations:
                begin = time.perf_counter()
                self.step()
                if self.iteration % self.method.log_every == 0:
                    dr.sync_thread()
                self.seconds += time.perf_counter() - begin
                self._record()
                try:
                    if progress is not None:
                        progress(self)
                    release()
                except KeyboardInterrupt:
                    self._save()
                    raise
            self.check()

    def _record(self) -> None:
        if self.iteration % self.method.log_every == 0:
            self.check()
            if self.run is not None:
                self.run.log(self.statistics())
        if self.iteration % self.method.checkpoint_every == 0:
            self._save()

    def _save(self) -> None:
        self.check()
        if self.run is not None:
            self.run.save_checkpoint(self.iteration, self.state())

    def check(self) -> None:
        """Remove the surfels that made steps fail since the last check, and leave a notice of it.

        Raises InputError if the light is not finite, if no surfel is left, or if nothing helps. Waits for the
        device, and so is called on intervals only.
        """
        skipped, steps = self.optimiser.report(), self.iteration - self._checked
        self._checked, self.skipped = self.iteration, self.skipped + skipped.count
        self._failed = self._failed + steps if skipped.count >= steps else 0
        health.check_light(self.light)
        rows = health.culprits(self.surfels, skipped)
        if not rows and not skipped.count:
            return
        view = self.data.views[self.schedule.view(skipped.iteration + 1)].name if skipped.count else ""
        said = health.sentence(rows, skipped, view)
        self.notices.append(said)
        if self._failed >= health.PATIENCE * self.method.log_every:
            raise health.gave_up(said, self._failed)
        if rows:
            self._remove(health.together(rows))

    def step(self) -> None:
        """One iteration: enter a stage if it begins, one gradient step, then what falls due."""
        iteration = self.iteration + 1
        name, stage = self.method.stage_at(iteration)
        if iteration > 1 and stage.restart and self.method.stage_at(iteration - 1)[0] != name:
            self._restart(stage.restart, iteration)
        self._gradient_step(iteration, stage)
        self.iteration = iteration
        self._refine(iteration)
        mesh = self.method.mesh
        if mesh is not None and self._shading(stage).at == "pixel" and mesh.extract.due(iteration):
            self.extract_mesh()

    def statistics(self) -> dict[str, Any]:
        """One line of the log; waits for the device."""
        mse = float(self.error[0])
        return {
            "iteration": self.iteration,
            "seconds": round(self.seconds, 3),
            "stage": self.method.stage_at(self.iteration)[0],
            "loss": float(self.loss[0]),
            "psnr": round(-10 * float(np.log10(max(mse, 1e-10))), 3),
            "surfels": self.surfels.count,
            "skipped_steps": self.skipped,
        }

    def extract_mesh(self) -> Mesh:
        """Fuse the rendered depth of all training views into a mesh and make it the occluder."""
        self.check()
        surfels = self.surfels.detach()
        views = tee(render_depth(surfels, target.camera) for target in self.targets)
        assert self.method.mesh is not None
        volume = fuse(
            (depth for depth, _ in views[0]),
            (alpha for _, alpha in views[1]),
            (target.camera for target in self.targets),
            bounds_from_points(surfels.to_numpy()["position"]),
            self.method.mesh.resolution,
        )
        mesh = extract_mesh(volume)
        self.occluder.update(mesh)
        return mesh

    # ---------------- one step ----------------

    def _gradient_step(self, iteration: int, stage: Stage) -> None:
        target = self.targets[self.schedule.view(iteration)]
        camera, surfels = target.camera, self.surfels
        shift = mi.Point2f(dr.opaque(mi.Float, 0, surfels.count), dr.opaque(mi.Float, 0, surfels.count))
        dr.enable_grad(shift)
        shading = self._shading(stage)
        frame = render(
            surfels,
            camera,
            shading,
            shading.light_of(self.light),
            self.occluder,
            sh_degree=self.schedule.sh_degree(iteration),
            shift=shift,
        )
        loss, self.error = objective(frame, target, self.data, self.method.loss, iteration)
        self.loss = dr.detach(loss)
        phase("loss backward")(dr.backward)(loss)

        if self.method.refine.densify is not None and iteration <= self.method.refine.densify.until:
            length = dr.norm(dr.grad(shift) * mi.Vector2f(0.5 * camera.width, 0.5 * camera.height))
            seen = (length > 0) & dr.isfinite(length)
            self.gradient_sum += dr.select(seen, length, 0.0)
            self.gradient_count += dr.select(seen, mi.Float(1), 0)
            dr.schedule(self.gradient_sum, self.gradient_count)
        if iteration % self.method.log_every == 0:
            dr.schedule(self.loss, self.error)
        self.optimiser.step(iteration - 1, self.loss)

    def _refine(self, iteration: int) -> None:
        options, surfels = self.method.refine, self.method.surfels
        if options.densify is not None and options.densify.due(iteration):
            self.check()
            since_reset = options.reset.since(iteration) if options.reset is not None else None
            grown_back = since_reset is None or since_reset >= refine.prune_wait(
                options, self.method.rates.of("opacity")
            )
            mean = self.gradient_sum.numpy() / np.maximum(self.gradient_count.numpy(), 1)
            edited = refine.densify_and_prune(
                self.surfels,
                mean,
                self.extent,
                options,
                surfels.max_count,
                self.schedule.rng(iteration),
                prune_transparent=grown_back,
            ).ordered()
            self._replace(edited.surfels)
            names = list(edited.surfels.raw)
            self.optimiser.gather(mi.UInt32(edited.parent), names, mi.Bool(edited.fresh))
            self._clear_statistics()
        if options.reset is not None and options.reset.due(iteration):
            floors = {name: surfels.start(name) for name in options.reset_raise}
            self._replace(refine.reset_opacity(self.surfels, options, floors), cleared=("opacity", *floors))
        elif options.propagate is not None and options.propagate.when.due(iteration):
            rng = self.schedule.rng(iteration)
            colour = ("radiance_sh",) if options.propagate.noise else ()
            self._replace(
                refine.propagate_normals(self.surfels, options.propagate, rng),
                cleared=("opacity", *self.surfels.primitive.sizes, *colour),
            )
            self.optimiser.set_factor("opacity", 0.0)
            self.held_until = iteration + options.propagate.hold
        if iteration >= self.held_until:
            self.optimiser.set_factor("opacity", 1.0)

    def _remove(self, rows: np.ndarray) -> None:
        """Take surfels out of the table."""
        parent = np.delete(np.arange(self.surfels.count), rows)
        if not len(parent):
            raise InputError("surfels: none of them is finite; lower the rates (--set rates.…)")
        index = upload(parent, mi.UInt32)
        self._replace(self.surfels.gather(index))
        self.optimiser.gather(index, list(self.surfels.raw))
        self.gradient_sum = dr.gather(mi.Float, self.gradient_sum, index)
        self.gradient_count = dr.gather(mi.Float, self.gradient_count, index)

    def _restart(self, names: tuple[str, ...], iteration: int) -> None:
        """Channels and the light back to their initial values, without history."""
        options = self.method.surfels
        starts = {name: options.start(name) for name in names if name != LIGHT}
        edited = refine.restart(self.surfels, starts, self.schedule.rng(iteration))
        self._replace(edited, cleared=tuple(starts))
        if LIGHT in names and self.method.light is not None:
            self.params[LIGHT] = first_light(self.method.light).raw
            self.optimiser.reset(LIGHT)

    def _replace(self, surfels: Surfels, cleared: tuple[str, ...] = ()) -> None:
        self.params.update(surfels.raw)
        for name in surfels.raw:
            dr.enable_grad(self.params[name])
        for name in cleared:
            if name in self.params:
                self.optimiser.reset(name)

    def _shading(self, stage: Stage) -> Shading:
        return Shading.of(stage, not self.occluder.empty)

    def _groups(self) -> dict[str, Group]:
        return self.schedule.groups(self.extent)

    # ---------------- state ----------------

    def _clear_statistics(self) -> None:
        count = self.surfels.count
        self.gradient_sum = dr.opaque(mi.Float, 0, count)
        self.gradient_count = dr.opaque(mi.Float, 0, count)

    def state(self) -> dict[str, np.ndarray]:
        """Everything that a checkpoint holds."""
        mesh = self.occluder.mesh()
        state = {f"{PARAMS}{name}": tensor.numpy() for name, tensor in self.params.items()}
        state |= {f"{OPTIMISER}{name}": value for name, value in self.optimiser.state_dict().items()}
        state |= {"gradient_sum": self.gradient_sum.numpy(), "gradient_count": self.gradient_count.numpy()}
        state |= {"iteration": np.array(self.iteration), "seconds": np.array(self.seconds)}
        state["held_until"] = np.array(self.held_until)
        if mesh is not None:
            state |= {
                "mesh/vertices": mesh.vertices,
                "mesh/faces": mesh.faces,
                "mesh/voxel": np.array(mesh.voxel),
            }
        return state

    def _restore(self, state: dict[str, np.ndarray]) -> None:
        """Go on from a checkpoint; raises InputError if the method has changed since it was written."""
        expected = _shapes(self.method)
        found = {name: value.shape[1:] for name, value in part(state, PARAMS).items()}
        for name in expected.keys() | found.keys():
            if found.get(name) != expected.get(name):
                raise InputError(
                    f"config.toml: {name}: the checkpoint has {found.get(name, 'none')}, the method "
                    f"{expected.get(name, 'none')}; undo the change, or start another run"
                )
        self.iteration, self.seconds = int(state["iteration"]), float(state["seconds"])
        self._checked = self.iteration
        self.params |= tensors(state, PARAMS)
        self.optimiser = Adam(self.params, self._groups())
        self.optimiser.load_state_dict(part(state, OPTIMISER))
        self.gradient_sum = upload(state["gradient_sum"])
        self.gradient_count = upload(state["gradient_count"])
        self.held_until = int(state["held_until"])
        if "mesh/faces" in state:
            self.occluder.update(
                Mesh(state["mesh/vertices"], state["mesh/faces"], float(state["mesh/voxel"]))
            )
