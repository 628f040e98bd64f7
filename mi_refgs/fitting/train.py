"""The optimisation loop: stages from the method, one view a step, refinement and meshes on their windows.

A step is a pure function of the state and the iteration number (view order and random draws are derived from
the seed and the iteration), so a resumed run repeats a straight one: bit for bit with one thread.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.data.dataset import Dataset
from mi_refgs.fitting import health
from mi_refgs.fitting.control import AdaptiveControl
from mi_refgs.fitting.exposure import Exposure
from mi_refgs.fitting.initial import initial_parameters, is_open
from mi_refgs.fitting.objective import objective
from mi_refgs.fitting.optim import Adam, Group
from mi_refgs.fitting.schedule import LightWindow, Schedule
from mi_refgs.fitting.state import decisions_of, occluder_of, packed, require_fit
from mi_refgs.fitting.surface import surface_of, update_missing_caches
from mi_refgs.fitting.targets import Targets, require_memory
from mi_refgs.io.images import psnr_of
from mi_refgs.kernels.timing import phase
from mi_refgs.methods.method import GAIN, Method, Stage
from mi_refgs.occlusion.mesh import Mesh
from mi_refgs.occlusion.visibility import Occluder
from mi_refgs.render.pipeline import Frame, Request, SurfelScene, render
from mi_refgs.render.samples import samples_per_axis, supersampled
from mi_refgs.render.surroundings import Surroundings
from mi_refgs.runs.checkpoint import OPTIMISER, PARAMS, channels_of, light_of, part, surroundings_of, tensors
from mi_refgs.runs.interrupt import held_interrupts
from mi_refgs.runs.run import Run
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.shading import Shading
from mi_refgs.splat import Camera
from mi_refgs.surfels.table import Surfels


class Trainer:
    """The state of a fit and the step that advances it."""

    def __init__(
        self,
        method: Method,
        data: Dataset,
        run: Run | None = None,
        state: dict[str, np.ndarray] | None = None,
    ) -> None:
        """Set up a fit of `data`: from a `state`, the newest checkpoint of `run`, or the start."""
        self.run = run
        self.notices: list[str] = []  # messages for people; who shows one removes it
        self.decisions: list[dict[str, Any]] = []  # about terms of the method
        self.between: Callable[[Trainer], None] | None = None  # called ahead of each step of `train`
        self.release: Callable[[], None] = lambda: None  # lets an interrupt through, while `train` runs
        self.occluder = Occluder()
        self.iteration, self.seconds = 0, 0.0
        self.skipped = 0  # steps that changed nothing, since their loss or gradient was not finite
        self.checked, self.failed = 0, 0  # iteration of the last check; failed steps in a row
        self.params: dict[str, Any] = {}
        self.control = AdaptiveControl(self)
        self.window = LightWindow()
        self.exposure = Exposure(self)
        self.loss: Any = None
        self.error: Any = None
        if state is None and run is not None:
            state = run.load_checkpoint()
        self._set(method, data)
        if state is not None:
            self.restore(state)
            return
        self.params |= initial_parameters(method, data, self.schedule.rng(0, "start"), self.open)
        self.params |= self.exposure.start()
        self.optimiser = Adam(self.params, self._groups())
        self.optimiser.set_factor(GAIN, 0.0)  # until it is decided
        self.control.clear()

    def adopt(self, method: Method, data: Dataset, state: dict[str, np.ndarray]) -> None:
        """Go on with another method, data and state, such as those of a `branched` fit.

        Raises InputError if the state is not one of the method.
        """
        self._set(method, data)
        decisions = self.decisions
        self.restore(state)
        self.decisions = decisions

    def _set(self, method: Method, data: Dataset) -> None:
        self.method, self.data = method, data
        self.extent, self.open = data.scene_extent, is_open(method, data)
        self.schedule = Schedule(method, len(data.views))
        require_memory(method, data)
        self.targets = Targets(data, method.data)

    def _groups(self) -> dict[str, Group]:
        return self.schedule.groups(self.extent, self.open) | self.exposure.groups()

    # ---------------- what others look at ----------------

    @property
    def surfels(self) -> Surfels:
        """The object's table, attached to the leaves that the optimiser owns."""
        return Surfels(channels_of(self.params))

    @property
    def surroundings(self) -> Surroundings | None:
        """What is around the object in pictures without alpha, attached likewise."""
        return surroundings_of(self.params)

    @property
    def light(self) -> EnvironmentLight | None:
        """The environment, attached likewise."""
        return light_of(self.params)

    def shading(self, iteration: int | None = None) -> Shading:
        """How the present (or another) iteration shades."""
        _, stage = self.method.stage_at(iteration or max(self.iteration, 1))
        return self._shading(stage)

    def view(self, camera: Camera, aovs: bool = True, alone: bool = False) -> Frame:
        """Render a view of the present state, without derivatives; `alone`: without the surroundings."""
        with dr.suspend_grad():
            shading = self.shading()
            update_missing_caches(self.occluder, self.surfels, self.light, shading)
            light, surroundings = shading.light_of(self.light), None if alone else self.surroundings
            scene = SurfelScene(self.surfels, shading, light, self.occluder, surroundings)
            asked = scene.all_aovs if aovs else ()
            return render(scene, camera, Request(asked, sh_degree=self.schedule.sh_degree(self.iteration)))

    # ---------------- the loop ----------------

    def train(self, progress: Callable[[Trainer], None] | None = None) -> None:
        """Run to the last iteration; an interrupt ends it after the step in hand, saved, and is passed on.

        Raises InputError when the run folder cannot be written: a checkpoint interval is lost at most.
        """
        with held_interrupts() as release:
            self.release = release
            while self.iteration < self.method.iterations:
                try:
                    if self.between is not None:
                        self.between(self)
                except KeyboardInterrupt:
                    self.save()
                    raise
                if self.iteration == self.method.iterations:
                    break
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
                    self.save()
                    raise
            self.check()

    def _record(self) -> None:
        if self.iteration % self.method.log_every == 0:
            self.check()
            if self.run is not None:
                self.run.log(self.statistics())
        if self.iteration % self.method.checkpoint_every == 0:
            self.save()

    def save(self) -> None:
        """Write a checkpoint, if there is a run to write it into."""
        self.check()
        if self.run is not None:
            self.run.save_checkpoint(self.iteration, self.state())

    def check(self) -> None:
        """Remove the surfels that made steps fail since the last check, and leave a notice of it.

        Raises InputError if the light is not finite, if no surfel is left, or if nothing helps. Waits for the
        device, and so is called on intervals only.
        """
        health.check(self)

    def step(self) -> None:
        """One iteration: enter a stage if it begins, one gradient step, then what falls due."""
        iteration = self.iteration + 1
        name, stage = self.method.stage_at(iteration)
        if iteration > 1 and stage.restart and self.method.stage_at(iteration - 1)[0] != name:
            self.control.restart(stage.restart, iteration)
        self._gradient_step(iteration, stage)
        self.iteration = iteration
        self.control.refine(iteration)
        self.exposure.decide(iteration)
        mesh = self.method.mesh
        if mesh is not None and self._shading(stage).traceable and mesh.extract.due(iteration):
            self.extract_mesh()

    def statistics(self) -> dict[str, Any]:
        """One line of the log; waits for the device."""
        return {
            "iteration": self.iteration,
            "seconds": round(self.seconds, 3),
            "stage": self.method.stage_at(self.iteration)[0],
            "loss": float(self.loss[0]),
            "psnr": round(psnr_of(float(self.error[0])), 3),
            "surfels": sum(table.surfels.count for table in self.control.tables),
            "skipped_steps": self.skipped,
        }

    def extract_mesh(self) -> Mesh:
        """Fuse the rendered depth of all training views into a mesh and make it the occluder."""
        self.check()
        assert self.method.mesh is not None
        cameras = [view.camera() for view in self.data.views]
        options, around = self.method.mesh, self.surroundings
        far = around.surfels.detach() if around is not None and options.unbounded else None
        mesh = surface_of(self.surfels.detach(), cameras, options.resolution, far, self.data.region)
        self.occluder.update(mesh)
        return mesh

    # ---------------- one step ----------------

    def _gradient_step(self, iteration: int, stage: Stage) -> None:
        index = self.schedule.view(iteration)
        target = self.targets.at(iteration, index)
        camera, surfels, around = target.camera, self.surfels, self.surroundings
        rows = surfels.count + (0 if around is None else around.surfels.count)
        offset = mi.Point2f(dr.opaque(mi.Float, 0, rows), dr.opaque(mi.Float, 0, rows))
        dr.enable_grad(offset)
        shading = self._shading(stage)
        update_missing_caches(self.occluder, self.surfels, self.light, shading)
        light = self.window.light(self.light, shading)
        scene = SurfelScene(surfels, shading, light, self.occluder, around)
        request = Request(
            ("normal",) if self.method.loss.uses_normals else (),
            sh_degree=self.schedule.sh_degree(iteration),
            screen_offset=offset,
        )
        view = partial(render, scene, request=request)
        frame = supersampled(view, camera, stage.samples, details=self.method.loss.uses_maps)
        gain = self.exposure.log_gain(index)
        loss, self.error = objective(frame, target, self.data, self.method.loss, iteration, light, gain)
        self.loss = dr.detach(loss)
        phase("loss backward")(dr.backward)(loss)
        if self.schedule.light_learns(iteration):
            self.window.close()

        fine = camera.supersampled(samples_per_axis(stage.samples))  # whose pixels the offset is in
        self.control.observe(dr.grad(offset), fine, iteration)
        if iteration % self.method.log_every == 0:
            dr.schedule(self.loss, self.error)
        self.optimiser.stage = stage.rates
        self.optimiser.step(iteration - 1, self.loss)
        self.control.wander(iteration)

    def _shading(self, stage: Stage) -> Shading:
        return Shading.resolve(stage.shading, not self.occluder.empty)

    # ---------------- state ----------------

    def state(self) -> dict[str, np.ndarray]:
        """Everything that a checkpoint holds."""
        return packed(self)

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Go on from the state of a checkpoint; raises InputError if it is not one of the method."""
        require_fit(self.method, state, self.open)
        self.exposure.restore(state)
        self.iteration, self.seconds = int(state["iteration"]), float(state["seconds"])
        self.checked = self.iteration
        self.params = tensors(state, PARAMS)
        self.optimiser = Adam(self.params, self._groups())
        self.optimiser.load_state_dict(part(state, OPTIMISER))
        for table in self.control.tables:
            table.restore(state)
        self.control.held_until = int(state["held_until"])
        self.decisions = decisions_of(state)
        self.occluder = occluder_of(state)
        self.window.restore(self.light, self.shading(), state)
