"""Component selection: optional components of a method are tried during a fit, and kept if they improve it.

At a trial, the fit continues for a while both with and without the component; validation views decide. The
better one is continued, so a trial costs what the other one took. A component that is not in use is absent
from the attributes, the G-buffer, the kernels and the optimiser.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Any

import drjit as dr
import numpy as np

from mi_refgs import methods
from mi_refgs.data.dataset import Dataset
from mi_refgs.errors import InputError
from mi_refgs.fitting.control import AdaptiveControl
from mi_refgs.fitting.exposure import displayed_of, image_of, psnr
from mi_refgs.fitting.initial import converted, first_light, with_columns
from mi_refgs.fitting.optim import Adam
from mi_refgs.fitting.schedule import FitSetup
from mi_refgs.fitting.train import Trainer
from mi_refgs.methods.method import AROUND, BACKGROUND, LIGHT, Method, Selection
from mi_refgs.runs.checkpoint import MESH, OPTIMISER, PARAMS, part
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.light.lobe_matrices import resample


def branched(trainer: Trainer, method: Method) -> Trainer:
    """Copy a fit to a trainer of another method, at the same iteration, without a run folder.

    Parameters of both methods are kept, others start as `method` says. SH of another degree are cut or filled
    with zeros, a light of another size is resampled; entries that are kept have their history. If the method
    allows more surfels, those with the largest error are split at once.
    """
    state = trainer.state()
    old, rng = part(state, PARAMS), trainer.setup.rng(trainer.iteration, "branch")
    widths = {name: method.surfels.columns(name) for name in method.surfels.names}
    wanted = converted(old, widths, method, rng)
    wanted |= {name: old[name] for name in old if name == BACKGROUND or name.startswith(AROUND)}
    if method.light is not None:
        height = method.light.height
        if LIGHT not in old:
            wanted[LIGHT] = first_light(method.light).raw.numpy()
        elif len(old[LIGHT]) == height:
            wanted[LIGHT] = old[LIGHT]
        else:
            radiance = EnvironmentLight(trainer.fit.params[LIGHT]).radiance().numpy()
            wanted[LIGHT] = EnvironmentLight.from_radiance(resample(radiance, height)).raw.numpy()
    dropped = (PARAMS, OPTIMISER) if method.mesh is not None else (PARAMS, OPTIMISER, MESH)
    new = {name: value for name, value in state.items() if not name.startswith(dropped)}
    for name, values in wanted.items():
        new[f"{PARAMS}{name}"] = np.asarray(values, np.float32)
        new |= {f"{OPTIMISER}{key}": value for key, value in _history(state, old, name, values).items()}
    made = Trainer(method, trainer.data, state=new, targets=trainer.targets)
    if method.surfels.most > trainer.method.surfels.most:
        AdaptiveControl(made.setup, made.fit).fill()
    if method.mesh is not None and made.fit.occluder.empty and made.shading().traceable:
        made.extract_mesh()
    return made


def _history(
    state: dict[str, np.ndarray], old: dict[str, np.ndarray], name: str, values: np.ndarray
) -> dict[str, np.ndarray]:
    """Adam's moments of one tensor, with the names of `Adam.state_dict`."""
    found = Adam.fresh_state(name, values.size)
    for key, fresh in found.items():
        kept = state.get(f"{OPTIMISER}{key}", fresh)
        if kept.ndim and name in old and values.ndim == 2:
            kept = with_columns(kept.reshape(old[name].shape), values.shape[1]).ravel()
        if kept.size == fresh.size:
            found[key] = kept
    return found


MOMENTS = 3  # arrays of float32 that a parameter needs: itself, and Adam's first and second moment

TIME_NOISE = 0.05  # relative difference of two measurements of a step's time by chance

DECISIONS = "decisions.json"  # file of a run


@dataclass(frozen=True)
class ComponentTrial:
    """Result of a method in a trial."""

    psnr: float  # dB, mean over the validation views
    ms: float  # CPU time per step, median: wall time depends on the load of the machine
    mb: float  # parameters and their moments


@dataclass(frozen=True)
class Decision:
    """Decision about one component, tried or not."""

    component: str
    iteration: int
    stays: bool
    reason: str
    without: ComponentTrial | None = None
    with_it: ComponentTrial | None = None


def install_trials(trainer: Trainer, tell: Callable[[str], None] = lambda _: None) -> None:
    """Restrict a trainer to the views that do not validate, and let it try each component before the step at
    which that is due; it gets all views back with the last decision.

    Changes nothing if its method selects nothing. `tell` is called with a sentence for every decision.
    """
    select = trainer.method.select
    if select is None:
        return
    whole = trainer.data
    fitted, judges = whole.held_out(select.holdout)
    if _undecided(trainer, select):
        trainer.adopt(FitSetup(trainer.method, fitted), trainer.state())

    def before_step(trainer: Trainer) -> None:
        while names := _undecided(trainer, select):
            component = select.component[names[0]]
            lacks = {*component.needs} & {
                row["component"] for row in trainer.fit.decisions if not row["stays"]
            }
            if trainer.iteration < component.after and not lacks:
                return
            seconds, begin = trainer.fit.seconds, time.perf_counter()
            decision = _try(trainer, names[0], select, judges)
            tell(sentence(decision))
            # All that a trial took counts: the loser's steps and the validation images.
            seconds += time.perf_counter() - begin
            trainer.end_trial(asdict(decision), seconds, whole if len(names) == 1 else trainer.data)

    trainer.before_step = before_step


def _undecided(trainer: Trainer, select: Selection) -> list[str]:
    """Components that are not decided yet, in the order in which they are tried."""
    decided = {row["component"] for row in trainer.fit.decisions}
    return [name for name in select.order if name not in decided]


def _try(trainer: Trainer, name: str, select: Selection, judges: Dataset) -> Decision:
    component, method, iteration = select.component[name], trainer.method, trainer.iteration
    if missing := [needed for needed in component.needs if needed not in method.components]:
        return Decision(name, iteration, False, f"needs {missing[0]}")
    if present := [other for other in component.unless if other in method.components]:
        return Decision(name, iteration, False, f"nothing to do beside {present[0]}")
    if iteration + component.trial > method.iterations:
        return Decision(name, iteration, False, "too late in the fit")
    try:
        candidate = methods.with_components(method, (*method.components, name))
        rival = branched(trainer, candidate)
        if candidate.surfels.most > method.surfels.most and rival.surfels.count <= trainer.surfels.count:
            return Decision(name, iteration, False, "no surfels to split: densification has ended")
        with_it = _run(rival, component.trial, judges, trainer.release)
    except InputError as error:
        return Decision(name, iteration, False, f"its fit failed: {error}")
    # A copy, so that an interrupt leaves the fit as it was before the trial.
    plain = Trainer(method, trainer.data, state=trainer.state(), targets=trainer.targets)
    without = _run(plain, component.trial, judges, trainer.release)
    gain, wanted = with_it.psnr - without.psnr, required_gain(without, with_it, select)
    stays = gain >= wanted
    chosen = rival if stays else plain
    trainer.adopt(FitSetup(chosen.method, trainer.data), chosen.state())
    cost = f"{with_it.ms / without.ms:.2f} times the time per step and {with_it.mb - without.mb:+.1f} MB"
    reason = f"{gain:+.2f} dB on validation views, {wanted:+.2f} dB required for {cost}"
    return Decision(name, iteration, stays, reason, without, with_it)


def required_gain(without: ComponentTrial, with_it: ComponentTrial, select: Selection) -> float:
    """PSNR gain (dB) that a component has to reach for its cost; negative if it saves cost."""
    time_price = select.gain_per_doubling * math.log2(with_it.ms / without.ms)
    price = time_price + select.gain_per_mb * (with_it.mb - without.mb)
    costs = with_it.mb > without.mb or with_it.ms > (1 + TIME_NOISE) * without.ms
    return price + (select.gain if costs else 0)


def _run(trainer: Trainer, steps: int, judges: Dataset, release: Callable[[], None]) -> ComponentTrial:
    """Run some steps and measure the result; `release` raises a pending interrupt between two of them."""
    seconds = []
    for _ in range(steps):
        begin = time.process_time()
        trainer.step()
        dr.sync_thread()
        seconds.append(time.process_time() - begin)
        release()
    entries = sum(int(np.prod(tensor.shape)) for tensor in trainer.fit.params.values())
    # The first half may compile kernels.
    return ComponentTrial(
        validation_psnr(trainer, judges),
        1e3 * float(np.median(seconds[steps // 2 :])),
        MOMENTS * 4 * entries / 1e6,
    )


def validation_psnr(trainer: Trainer, judges: Dataset) -> float:
    """Mean PSNR (dB) of the present state on validation views; waits for the device."""
    shown = [(trainer.view(view.camera(), aovs=False), view) for view in judges.views]
    return float(np.mean([psnr(image_of(displayed_of(frame, judges), view), view) for frame, view in shown]))


def _changes(row: dict[str, Any]) -> list[str]:
    """What a component changed in its trial: PSNR, time per step and memory; empty if it was not tried."""
    units = ("psnr", ".2f", "dB"), ("ms", ".1f", "ms"), ("mb", ".1f", "MB")
    if row["with_it"] is None:
        return []
    return [f"{row['with_it'][key] - row['without'][key]:+{form}} {unit}" for key, form, unit in units]


def sentence(decision: Decision) -> str:
    """The decision as one sentence."""
    return f"{decision.component} {'stays' if decision.stays else 'is left out'}: {decision.reason}"


def table(decisions: list[dict[str, Any]]) -> str:
    """Format the decisions of a fit as a text table."""
    rows = [("component", "iteration", "gain", "time", "memory", "verdict")]
    for row in decisions:
        changes = _changes(row)
        why = "" if changes else f" ({row['reason']})"
        verdict = ("stays" if row["stays"] else "left out") + why
        cells = changes or [""] * 3
        rows.append((row["component"], str(row["iteration"]), *cells, verdict))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    padded = [[cell.ljust(width) for cell, width in zip(row, widths, strict=True)] for row in rows]
    return "\n".join("  ".join(row).rstrip() for row in padded)


def with_components(method: Method, decisions: list[dict[str, Any]]) -> Method:
    """The method with the components that the decisions kept."""
    known = () if method.select is None else method.select.component
    return methods.with_components(
        method, [row["component"] for row in decisions if row["stays"] and row["component"] in known]
    )


def as_decided(method: Method, made: Method) -> Method:
    """The method with what has been decided for a run of it, which was `made`: its components, those that it
    tries, its image size."""
    select = method.select
    if made.select is None:  # too few views to try any
        method = replace(method, select=None)
    elif select is not None:
        if {*made.components} <= {*select.component}:
            method = methods.with_components(method, made.components)
        tried = {name: one for name, one in select.component.items() if name in made.select.component}
        method = replace(method, select=replace(select, component=tried))
    return method if method.data.downscale is not None else method.downscaled(made.data.downscale)
