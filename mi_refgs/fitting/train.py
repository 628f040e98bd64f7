"""The optimisation loop: stages of the method, one view per step, refinement and meshes on their windows.

A step is a pure function of the state and the iteration number (view order and random draws are derived from
the seed and the iteration), so a resumed run repeats a straight one: bit for bit with one thread.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from itertools import tee
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.data.dataset import Dataset
from mi_refgs.data.region import Region
from mi_refgs.data.view import View, evenly_spread
from mi_refgs.fitting import exposure, object_surface, poses
from mi_refgs.fitting.control import AdaptiveControl
from mi_refgs.fitting.health import Health
from mi_refgs.fitting.objective import LossInputs, losses_in_use, objective, require_losses
from mi_refgs.fitting.photographed_light import PhotographedLight
from mi_refgs.fitting.schedule import FitSetup
from mi_refgs.fitting.state import FitState
from mi_refgs.fitting.targets import Targets, require_memory
from mi_refgs.io.images import psnr_of
from mi_refgs.kernels.timing import phase
from mi_refgs.methods.method import GAIN, Method, Refine, Stage
from mi_refgs.occlusion.mesh import Mesh, extract_mesh
from mi_refgs.occlusion.tsdf import bounds_from_points, fuse
from mi_refgs.render.pipeline import Frame, Request, SurfelScene, render, render_depth
from mi_refgs.render.samples import supersampled
from mi_refgs.render.surroundings import Surroundings
from mi_refgs.runs.interrupt import held_interrupts
from mi_refgs.runs.run import Run
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.shading import Shading
from mi_refgs.splat import Camera
from mi_refgs.surfels.table import Surfels
from mi_refgs.types import Float

FUSED_VIEWS = 24
"""Training views that a mesh is fused from, but for the last mesh, which is saved: fused from all. The mirror
rays of a fit need no more: *chair* at 200², 1,000 iterations, two seeds: 32.33 and 32.33 dB from 24 views,
32.24 and 32.34 dB from 88, in 38 instead of 42 s."""


class Trainer:
    """A fit and the loop that advances it.

    `setup` contains the method and the data, `fit` all that the steps change.
    """

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
        """Set up a fit of `data`: from a `state`, the newest checkpoint of `run`, or the start.

        `targets` of another fit are shared if they are of the same data. `tell` is called with decisions
        about exposure and cameras, `warn` with steps that failed.
        """
        self.run, self.tell, self.warn = run, tell, warn
        self.before_step: Callable[[Trainer], None] | None = None  # is called before each step of `train`
        self.release: Callable[[], None] = lambda: None  # raises a pending interrupt, while `train` runs
        self.health = Health()
        self.loss: Float = None  # of the last step, width 1
        self.error: Float = None  # mean squared error of the last step, width 1
        if state is None and run is not None:
            state = run.load_checkpoint()
        self._set_up(FitSetup(method, data), targets)
        if state is None:
            self.fit = FitState.start(self.setup, exposure.initial_gains(self.setup))
        else:
            self.restore(state)

    def _set_up(self, setup: FitSetup, targets: Targets | None) -> None:
        require_losses(setup.method)
        require_memory(setup.method, setup.data)
        if targets is None or not targets.are_of(setup.data, setup.method.data):
            targets = Targets(setup.data, setup.method.data)
        self.setup, self.targets = setup, targets

    def adopt(self, setup: FitSetup, state: dict[str, np.ndarray]) -> None:
        """Continue with another method, data and state, such as those of a `branched` fit.

        Raises InputError if the state is not one of the method.
        """
        self._set_up(setup, self.targets)
        self.restore(state)

    def end_trial(self, decision: dict[str, Any], seconds: float, data: Dataset) -> None:
        """Record a decision about a component, after so many seconds of the fit, and continue with `data`."""
        self.fit.decisions.append(decision)
        if data is not self.data:
            self.adopt(FitSetup(self.method, data), self.state())
        self.fit.seconds = seconds
        self.save()
        if self.run is not None:
            self.run.write_method(self.method)

    def state(self) -> dict[str, np.ndarray]:
        """The content of a checkpoint."""
        return self.fit.arrays()

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Continue from the content of a checkpoint; raises InputError if it is not one of the method."""
        self.setup.require_own(state, None if self.run is None else self.run.path)
        self.fit = FitState.from_arrays(self.setup, state)
        self.health.checked = self.fit.iteration

    # ---------------- the present state ----------------

    @property
    def method(self) -> Method:
        """The method; it may gain components during a fit that selects them."""
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

    @property
    def surroundings(self) -> Surroundings | None:
        """The background in images without alpha, also attached."""
        return self.fit.surroundings

    @property
    def light(self) -> EnvironmentLight | None:
        """The environment map, also attached."""
        return self.fit.light

    def shading(self, iteration: int | None = None) -> Shading:
        """Shading options of the present (or another) iteration."""
        return self.fit.shading(self.method.stage_at(iteration or max(self.iteration, 1))[1])

    def view(self, camera: Camera, aovs: bool = True, object_only: bool = False) -> Frame:
        """Render the present state as its export does, without derivatives; `object_only`: without the
        background."""
        with dr.suspend_grad():
            shading = self.shading().antialiased()
            self.fit.update_missing_caches(shading)
            light, around = shading.light_of(self.light), None if object_only else self.surroundings
            scene = SurfelScene(self.surfels, shading, light, self.fit.occluder, around, self.fit.near)
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

    # ---------------- the loop ----------------

    def train(self, progress: Callable[[Trainer], None] | None = None) -> None:
        """Run to the last iteration; an interrupt ends it after the current step, saved, and is passed on.

        Raises InputError when the run folder cannot be written: a checkpoint interval is lost at most.
        """
        with held_interrupts() as release:
            self.release = release
            while self.iteration < self.method.iterations:
                with self._saved_if_interrupted():
                    if self.before_step is not None:
                        self.before_step(self)
                if self.iteration == self.method.iterations:
                    break  # a trial took the last steps
                begin = time.perf_counter()
                self.step()
                if self.iteration % self.method.log_every == 0:
                    dr.sync_thread()
                self.fit.seconds += time.perf_counter() - begin
                if self.iteration % self.method.log_every == 0:
                    self.check()
                    if self.run is not None:
                        self.run.log(self.statistics())
                if self.iteration % self.method.checkpoint_every == 0:
                    self.save()
                with self._saved_if_interrupted():
                    if progress is not None:
                        progress(self)
                    release()
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
            self.run.save_checkpoint(self.iteration, self.state())

    def check(self) -> None:
        """Remove the surfels that made steps fail since the last check, and warn; see `Health.check`."""
        if (warning := self.health.check(self.setup, self.fit)) is not None:
            self.warn(warning)

    def step(self) -> None:
        """One iteration: enter a stage if it begins, one gradient step, then the edits that are due."""
        iteration, control = self.iteration + 1, AdaptiveControl(self.setup, self.fit)
        name, stage = self.method.stage_at(iteration)
        if iteration > 1 and stage.restart and self.method.stage_at(iteration - 1)[0] != name:
            control.restart(stage.restart, iteration)
        self._gradient_step(iteration, stage, control)
        self.fit.iteration = iteration
        if control.changes_rows(iteration):
            self.check()
        control.refine(iteration)
        self._decide_exposure()
        self._decide_cameras()
        self._follow_object()
        self._photograph_light()
        mesh = self.method.mesh
        if mesh is not None and self.fit.shading(stage).traceable and mesh.extract.due(iteration):
            if self.setup.open_scene:  # what moved since the last densification is the object's, or is not
                self.check()
                assert self.region is not None
                control.exchange(self.region, iteration)
            last = mesh.extract.count(iteration) == mesh.extract.count(self.method.iterations)
            self.extract_mesh(None if last else [self.camera(i) for i in self._few_views()])

    def camera(self, index: int) -> Camera:
        """The camera of a training view, with the correction that was fitted."""
        return poses.camera_of(self.setup, self.fit.params, index)

    def _few_views(self) -> list[int]:
        """Indices of FUSED_VIEWS training views, spread over all of them."""
        return evenly_spread(len(self.data.views), FUSED_VIEWS)

    def extract_mesh(self, cameras: Sequence[Camera] | None = None) -> Mesh:
        """Fuse the rendered depth of all training views, or of `cameras`, into a mesh: the new occluder."""
        self.check()
        options, around = self.method.mesh, self.surroundings
        assert options is not None
        if cameras is None:
            cameras = [self.camera(i) for i in range(len(self.data.views))]
        far = around.surfels.detach() if around is not None and options.unbounded else None
        mesh = surface_of(self.surfels.detach(), cameras, options.resolution, far, self.region)
        self.fit.occluder.update(mesh)
        return mesh

    @contextmanager
    def held_in_stage(self, name: str) -> Iterator[Callable[[], None]]:
        """Keep steps within a stage, for measurements: nothing is refined, extracted, decided or saved.

        Yields a function to call before each step. Steps start near the end of the stage, where every SH
        degree is in use. Every step filters its light, so that all steps are alike. Afterwards the iteration
        is what it was before.
        """
        setup, before = self.setup, self.iteration
        end = setup.method.stage[name].until
        begin = max((x.until for _, x in setup.method.stages() if x.until < end), default=0)
        again = min(begin + 1, end - 1)  # the first iteration of a stage may reset materials
        if not again <= before < end:
            self.fit.iteration = max(again, end - 100)
        light = setup.method.light
        if light is not None:
            light = replace(light, every=1)
        still = replace(setup.method, refine=Refine(), mesh=None, exposure=None, cameras=None, light=light)
        self.setup = FitSetup(still, setup.data)
        self.fit.prefilter.close()

        def prepare() -> None:
            if self.iteration >= end:
                self.fit.iteration = again

        try:
            yield prepare
        finally:
            self.setup, self.fit.iteration = setup, before

    # ---------------- one step ----------------

    def _gradient_step(self, iteration: int, stage: Stage, control: AdaptiveControl) -> None:
        fit, setup, weights = self.fit, self.setup, self.method.loss
        index = setup.view(iteration)
        target = self.targets.at(iteration, index)
        if (part := setup.crop(iteration, target.camera.width, target.camera.height)) is not None:
            target = target.cropped(*part)
        camera = poses.corrected(setup, fit.params, index, target.camera)
        target = replace(target, camera=camera)
        surfels, around = fit.surfels, fit.surroundings

        # Zeros whose gradient is the squared error that each surfel is responsible for: one more feature.
        attribution = None
        if control.observes(iteration):
            rows = surfels.count + (0 if around is None else around.surfels.count)
            attribution = dr.opaque(mi.Float, 0, rows)
            dr.enable_grad(attribution)

        # Render the view, and differentiate its loss.
        shading = self.fit.shading(stage)
        fit.update_missing_caches(shading)
        light = fit.prefilter.light(fit.light, shading)
        scene = SurfelScene(surfels, shading, light, fit.occluder, around, fit.near)
        asked = losses_in_use(weights)
        aovs = ("normal",) if any(loss.normals for loss in asked) else ()
        request = Request(aovs, sh_degree=setup.sh_degree(iteration), attribution=attribution)
        view = partial(render, scene, request=request)
        frame = supersampled(view, camera, stage.samples, details=any(loss.maps for loss in asked))
        gain = exposure.log_gain(fit.params, index)
        inputs = LossInputs.of(frame, target, self.data, light, gain, fit.photographed)
        loss, error = objective(inputs, weights, iteration)
        self.loss, self.error = dr.detach(loss), dr.mean(error)
        if frame.attribution is not None:
            loss += dr.sum(error * frame.attribution)
        phase("loss backward")(dr.backward)(loss)
        if setup.light_learns(iteration):
            fit.prefilter.close()

        # Statistics, the optimiser's step, and the random step of positions.
        if attribution is not None:
            control.observe(dr.grad(attribution))
        if iteration % self.method.log_every == 0:
            dr.schedule(self.loss, self.error)
        fit.optimiser.stage = stage.rates
        fit.optimiser.step(iteration - 1, self.loss)

    def _decide_exposure(self) -> None:
        """Decide about gains, if that is due, and continue with them or without."""
        if not exposure.is_due(self.setup, self.fit, self.setup.exposure, self.fit.exposure):
            return

        def shown(view: View) -> Frame:
            return self.view(self.camera(self.data.views.index(view)), aovs=False)

        decision = exposure.decide(self.setup, self.iteration, shown)
        self.fit.exposure = decision
        self.tell(exposure.sentence(decision))
        if decision["gains"] or GAIN in self.fit.params:
            log = None
            if decision["gains"]:
                log = np.log(
                    [exposure.with_gain(shown(view), view, self.data)[0] for view in self.data.views]
                )
            self.check()
            self.restore(exposure.with_gains(self.state(), log))

    def _decide_cameras(self) -> None:
        """Decide about corrections of the cameras, if that is due, and continue with them or without."""
        if not exposure.is_due(self.setup, self.fit, self.setup.cameras, self.fit.cameras):
            return
        gains = exposure.gains_of(self.fit.params)

        def shown(index: int, view: View) -> np.ndarray:
            frame, gain = self.view(view.camera(), aovs=False), None if gains is None else gains[index]
            return exposure.image_of(exposure.displayed_of(frame, self.data, gain), view)

        decision = poses.decide(self.setup, self.iteration, shown)
        self.fit.cameras = decision
        self.tell(poses.sentence(decision))
        if decision["corrected"]:
            self.check()
            self.restore(poses.with_corrections(self.setup, self.state()))

    def _follow_object(self) -> None:
        """Adapt the region of interest to the object that the surfels show, if that is due."""
        if not object_surface.is_due(self.setup, self.fit):
            return

        def depth_of(view: View) -> tuple[Float, Float]:
            around = self.surroundings
            assert around is not None
            return render_depth(self.surfels.detach(), view.camera(), around.surfels.detach())

        self.check()
        before, found = self.region, object_surface.followed(self.setup, depth_of)
        self.fit.region = found or before
        if found is None:
            self.tell("region of interest: no object is separate from the scene, so it stays")
            return
        centre = ", ".join(f"{x:.3g}" for x in found.centre)
        self.tell(f"region of interest: the object is within {found.radius:.3g} units of ({centre})")
        AdaptiveControl(self.setup, self.fit).exchange(found, self.iteration)

    def _photograph_light(self) -> None:
        """Render the background as the object's light, if that is due."""
        options, around, region = self.method.light, self.surroundings, self.region
        if options is None or options.photographed is None or around is None or region is None:
            return
        if not options.photographed.due(self.iteration):
            return
        self.check()
        posed = [replace(self.data.views[i], to_world=self.camera(i).pose()) for i in self._few_views()]
        self.fit.photographed = PhotographedLight.of(
            self.surfels.detach(), around, region, posed, options.height
        )


def surface_of(
    surfels: Surfels,
    cameras: Sequence[Camera],
    resolution: int,
    around: Surfels | None = None,
    region: Region | None = None,
) -> Mesh:
    """Fuse the depth rendered in all cameras, with `resolution` voxels along the longest side, into a mesh.

    With a `region` and background surfels `around`, in all of space by the region's contraction, with
    `resolution` voxels along its diameter.
    """
    points = surfels.to_numpy()["position"]
    if around is None or region is None:
        around, region, bounds = None, None, bounds_from_points(points)
    else:
        points = np.concatenate([points, around.to_numpy()["position"]])
        low, high = bounds_from_points(region.contract(points[np.isfinite(points).all(axis=1)]))
        bounds = np.maximum(low, -2), np.minimum(high, 2)
    views = tee(render_depth(surfels, camera, around) for camera in cameras)
    volume = fuse(
        (depth for depth, _ in views[0]),
        (alpha for _, alpha in views[1]),
        iter(cameras),
        bounds,
        resolution,
        carve=region is None,
        region=region,
    )
    return extract_mesh(volume)
