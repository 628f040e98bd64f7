"""The optimisation loop: stages of the method, one view per step, and events.

A step is a pure function of the state and the iteration number (view order and random draws are derived from
the seed and the iteration), so a resumed run repeats a straight one: bit for bit with one thread."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.data.dataset import Dataset
from mi_refgs.data.region import Region
from mi_refgs.data.view import View
from mi_refgs.fitting import per_view
from mi_refgs.fitting.health import Health
from mi_refgs.fitting.objective import LossInputs, losses_in_use, objective
from mi_refgs.fitting.schedule import FitSetup
from mi_refgs.fitting.state import FitState
from mi_refgs.fitting.targets import Targets, require_memory
from mi_refgs.io.images import psnr_of
from mi_refgs.kernels.timing import phase
from mi_refgs.methods.method import POSE, Method
from mi_refgs.render.pipeline import Frame, Request, render
from mi_refgs.runs.interrupt import held_interrupts
from mi_refgs.runs.run import Run
from mi_refgs.shade.light.maps import Map
from mi_refgs.shade.shading import Shading
from mi_refgs.splat import Camera
from mi_refgs.surfels.table import Surfels
from mi_refgs.types import Float

FEW_VIEWS = 24  # training views that events render which need only some of them


class Trainer:
    """A fit and the loop: `setup` has the method and the data, `fit` all that steps and events change."""

    def __init__(
        self,
        method: Method,
        data: Dataset,
        run: Run | None = None,
        state: dict[str, np.ndarray] | None = None,
        *,
        targets: Targets | None = None,
        tell: Callable[[str], None] = lambda _: None,
        warn: Callable[[str], None] = lambda _: None,
    ) -> None:
        """Set up a fit of `data`: from a `state`, the newest checkpoint of `run`, or the start. `targets` of
        another fit are shared if they are of the same data. Raises InputError for another method's state."""
        method.require_registered()
        require_memory(method, data)
        self.run, self.tell, self.warn = run, tell, warn
        self.release: Callable[[], None] = lambda: None  # raises a pending interrupt, while `train` runs
        self.health = Health()
        self.loss: Float = None  # of the last step, width 1
        self.terms: dict[str, Float] = {}  # losses of the last step by name, width 1
        self.error: Float = None  # mean squared error of the last step, width 1
        if method.light is not None:
            light = method.light.sized(max(view.width * view.height for view in data.views))
            if light != method.light and isinstance(light, Map):
                tell(f"{data.path}: the environment map has {light.rows} rows; `light.height` sets others")
            method = replace(method, light=light)
        self.setup = FitSetup(method, data)
        shared = targets is not None and targets.data is data and targets.options == method.data
        self.targets = targets if shared and targets is not None else Targets(data, method.data)
        self.whole = data
        self.validation: Dataset | None = None  # views that are held out as long as decisions need them
        if state is None and run is not None:
            state = run.load_checkpoint()
        if state is None:
            self.fit = FitState.start(self.setup)
            self.happen()
        else:
            self.setup.require_own(state, None if run is None else run.path)
            self.fit = FitState.from_arrays(self.setup, state)
            self.health.checked = self.fit.iteration

    def use(self, data: Dataset) -> None:
        """Continue with other views."""
        self.setup = FitSetup(self.method, data)
        self.targets = Targets(data, self.method.data)
        self.fit.optimiser.groups.update(self.setup.groups(self.fit.params))

    def take(self, other: "Trainer", method: Method) -> None:
        """Continue by this method from the state of another fit of the same views, which ends there."""
        self.setup, self.fit, self.targets = FitSetup(method, self.data), other.fit, other.targets
        self.health.checked = self.iteration

    @property
    def method(self) -> Method:
        """The method; decisions may change it."""
        return self.setup.method

    @property
    def data(self) -> Dataset:
        """The training views in use."""
        return self.setup.data

    @property
    def region(self) -> Region | None:
        """The region of interest in use: that of the data until it follows the object."""
        return self.fit.region or self.data.region

    @property
    def iteration(self) -> int:
        """Steps done."""
        return self.fit.iteration

    @property
    def surfels(self) -> Surfels:
        """The object, attached to the leaves that the optimiser owns."""
        return self.fit.surfels

    def shading(self) -> Shading:
        """Shading options of the present iteration."""
        return self.fit.shading(self.method.stage_at(max(self.iteration, 1))[1])

    def camera(self, index: int) -> Camera:
        """The camera of a training view, with the correction that was fitted."""
        with dr.suspend_grad():
            return per_view.corrected(self.setup, self.fit.params, index, self.data.views[index].camera())

    def posed(self, index: int) -> View:
        """A training view, with the correction of its pose that was fitted."""
        view = self.data.views[index]
        return replace(view, to_world=self.camera(index).pose()) if POSE in self.fit.params else view

    def read(self, index: int) -> View:
        """The loaded view that is `posed`, averaged as the iteration averages images, without maps."""
        view = self.posed(index)
        return view.averaged(self.method.data.block_at(max(self.iteration, 1), view.width * view.height))

    def view(self, camera: Camera, aovs: bool = True, surfels: Surfels | None = None) -> Frame:
        """Render the present state, or other `surfels` in it, as its export does, without derivatives."""
        with dr.suspend_grad():
            shading = self.shading().antialiased()
            self.fit.update_missing_caches(shading)
            scene = self.fit.scene(shading, shading.light_of(self.fit.light), surfels)
            degree = self.setup.sh_degree(self.iteration)
            return render(scene, camera, Request(scene.all_aovs if aovs else (), not aovs, sh_degree=degree))

    def statistics(self) -> dict[str, Any]:
        """One line of the log; waits for the device. `loss` and `psnr` are None before the first step."""
        return {
            "iteration": self.iteration,
            "seconds": round(self.fit.seconds, 3),
            "stage": self.method.stage_at(self.iteration)[0],
            "loss": None if self.loss is None else float(self.loss[0]),
            "psnr": None if self.error is None else round(psnr_of(float(self.error[0])), 3),
            "surfels": sum(table.surfels.count for table in self.fit.tables),
            "skipped_steps": self.health.skipped,
        }

    def train(self, progress: "Callable[[Trainer], None] | None" = None) -> None:
        """Run to the last iteration; an interrupt ends it after the current step, saved, and is passed on.
        `progress` is called after each step. Raises InputError when the run folder cannot be written."""
        with held_interrupts() as release:
            self.release = release
            with self._saved_if_interrupted():
                self.happen(outside=True)  # at the start, and what an interrupt left to do
            while self.iteration < self.method.iterations:
                begin = time.perf_counter()
                self.step()
                logs = self.iteration % self.method.log_every == 0
                if logs:
                    dr.sync_thread()
                self.fit.seconds += time.perf_counter() - begin
                if logs:
                    self.check()
                    if self.run is not None:
                        self.run.log(self.statistics())
                with self._saved_if_interrupted():
                    if progress is not None:
                        progress(self)
                    release()
                    if self.iteration % self.method.checkpoint_every == 0:
                        self.save()
                    self.happen(outside=True)
            self.check()

    @contextmanager
    def _saved_if_interrupted(self) -> Iterator[None]:
        """Save before an interrupt is passed on. Not around a step: a second Ctrl-C may end it half done."""
        try:
            yield
        except KeyboardInterrupt:
            self.save()
            raise

    def save(self) -> None:
        """Write a checkpoint, if there is a run to write it into."""
        self.check()
        if self.run is not None:
            self.run.save_checkpoint(self.iteration, self.fit.arrays())

    def check(self) -> None:
        """Remove the surfels that made steps fail since the last check, and warn; see `Health.check`."""
        if (warning := self.health.check(self.setup, self.fit, self.terms)) is not None:
            self.warn(warning)

    def step(self) -> None:
        """One iteration: a gradient step, then the events that are due."""
        self.gradient_step(self.iteration + 1)
        self.fit.iteration += 1
        self.happen()

    def happen(self, outside: bool = False) -> None:
        """Let the events happen that are due, those `outside` of steps or the others."""
        for event in self.setup.events:
            if event.outside == outside and event.due(self):
                event.apply(self)

    def gradient_step(self, iteration: int) -> None:
        """Render the view of a (1-based) iteration, and let all parameters learn from its loss."""
        fit, setup, weights = self.fit, self.setup, self.method.loss
        _, stage = self.method.stage_at(iteration)
        index = setup.view(iteration)
        target = self.targets.at(iteration, index)
        if (part := setup.crop(iteration, target.camera.width, target.camera.height)) is not None:
            target = target.cropped(*part)
        camera = per_view.corrected(setup, fit.params, index, target.camera)
        target = replace(target, camera=camera)

        # Zeros whose gradient is the squared error that each surfel is responsible for: one more feature.
        attribution = None
        if any(event.observes(self) for event in setup.events):
            attribution = dr.opaque(mi.Float, 0, sum(table.surfels.count for table in fit.tables))
            dr.enable_grad(attribution)

        # Render the view, and differentiate its loss.
        shading = fit.shading(stage)
        fit.update_missing_caches(shading)
        light = fit.prefilter.light(fit.light, shading)
        scene = fit.scene(shading, light)
        used = losses_in_use(weights)
        aovs = ["normal"] if any(loss.normals for loss in used) else []
        if shading.shaded_at == "pixel":
            aovs += (name for loss in used if loss.maps for name in loss.attributes)
        request = Request(aovs, sh_degree=setup.sh_degree(iteration), attribution=attribution)
        frame = render(scene, camera, request)
        gain = per_view.log_gain(fit.params, index)
        inputs = LossInputs.of(frame, target, self.data, light, gain, fit.photographed)
        loss, error = objective(inputs, weights, iteration)
        self.loss, self.error, self.terms = dr.detach(loss), dr.mean(error), inputs.terms
        if frame.attribution is not None:
            loss += dr.sum(error * frame.attribution)
        phase("loss backward")(dr.backward)(loss)
        if setup.light_learns(iteration):
            fit.prefilter.close()

        # Statistics, and the optimiser's step.
        if attribution is not None:
            fit.observe(dr.grad(attribution))
        if iteration % self.method.log_every == 0:
            dr.schedule(self.loss, self.error)
        fit.optimiser.stage = stage.rates
        fit.optimiser.step(iteration - 1, self.loss)
