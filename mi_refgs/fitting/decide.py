"""Decisions during a fit: it is continued both ways for some steps, and validation views choose.

Only errors and counts decide, never a clock: the same command decides the same on every machine."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, ClassVar

import numpy as np

from mi_refgs import methods
from mi_refgs.errors import InputError
from mi_refgs.fitting.image_error import displayed_image, squared_error
from mi_refgs.fitting.initial import converted, with_columns
from mi_refgs.fitting.train import Trainer
from mi_refgs.io.images import psnr_of
from mi_refgs.methods.extensions import Event, register_event
from mi_refgs.methods.fields import ITERATIONS, at_least
from mi_refgs.methods.method import APART, AROUND, LIGHT, Method
from mi_refgs.runs.checkpoint import MESH, OPTIMISER, PARAMS, part
from mi_refgs.runs.run import DECISIONS, Run

HOLDOUT = 8  # every so many training views validate
SIZES = ("data.downscale", "light.height")  # that a fit chooses where its method says nothing


@dataclass(frozen=True)
class Row:
    """What was decided about one component of a method, tried or not."""

    component: str
    iteration: int
    stays: bool
    reason: str
    psnr_without: float | None = None  # dB, mean over the validation views
    psnr_with: float | None = None


@dataclass(frozen=True)
class Trial:
    """When a component is tried."""

    after: int = field(metadata=ITERATIONS | at_least(0))  # iterations before
    trial: int = field(metadata=ITERATIONS | at_least(1))  # iterations with and without it that are compared


class Decision(Event[Trainer]):
    """An event that decides about components of a method, each once, between two steps."""

    outside: ClassVar[bool] = True
    gain: ClassVar[float]  # dB on validation views from which a component stays

    def components(self) -> Sequence[str]:
        """The components, in the order in which they are decided."""
        return [self.name]

    def trial_of(self, component: str) -> Trial:
        raise NotImplementedError

    def chosen(self, method: Method, component: str) -> Method:
        """The method with a component that stays."""
        raise NotImplementedError

    def pending(self, decisions: Sequence[Mapping[str, Any]]) -> list[str]:
        """The components that are not decided yet."""
        decided = {row["component"] for row in decisions}
        return [name for name in self.components() if name not in decided]

    def begin(self, rival: Trainer) -> str:
        """Prepare the fork of a fit that has a component; returns why there is nothing to try, if so."""
        return ""

    def due(self, trainer: Trainer) -> bool:
        left = self.pending(trainer.fit.decisions)
        waits = trainer.validation is None or trainer.iteration >= trainer.method.iterations
        return bool(left) and not waits and trainer.iteration >= self.trial_of(left[0]).after

    def apply(self, trainer: Trainer) -> None:
        """Decide about the next component by continuing the fit with and without it for some steps."""
        began = time.perf_counter()
        conclude(trainer, self._tried(trainer, self.pending(trainer.fit.decisions)[0]), began)

    def _tried(self, trainer: Trainer, component: str) -> Row:
        begin, steps = trainer.iteration, self.trial_of(component).trial
        if begin + steps > trainer.method.iterations:
            return Row(component, begin, False, "too late in the fit")
        try:
            rival = fork(trainer, self.chosen(trainer.method, component))
            if reason := self.begin(rival):
                return Row(component, begin, False, reason)
            better = validation_psnr(continued(rival, steps, trainer))
        except InputError as error:
            return Row(component, begin, False, f"cannot be tried: {error}")
        plain = continued(fork(trainer, trainer.method), steps, trainer)
        psnr = validation_psnr(plain)
        gained = better - psnr
        chosen = rival if gained >= self.gain else plain
        trainer.take(chosen, chosen.method)
        reason = f"{gained:+.2f} dB on validation views, {self.gain:+.2f} dB required"
        return Row(component, begin, bool(gained >= self.gain), reason, psnr, better)


def waiting(trainer: Trainer) -> dict[str, bool]:
    """The components that are not decided, and whether the fit is long enough to decide them."""
    decisions, last = trainer.method.event.values(), trainer.method.iterations
    return {
        name: decision.trial_of(name).after < last
        for decision in decisions
        if isinstance(decision, Decision)
        for name in decision.pending(trainer.fit.decisions)
    }


def validates(trainer: Trainer) -> bool:
    """Whether some of them can be decided: in time, and with views enough to hold some out."""
    return len(trainer.whole.views) >= HOLDOUT and any(waiting(trainer).values())


def hold_out(trainer: Trainer) -> None:
    """Fit all but the validation views as long as a decision needs them, then all views."""
    held = trainer.validation is not None
    if validates(trainer) != held:
        fitted, trainer.validation = (trainer.whole, None) if held else trainer.whole.held_out(HOLDOUT)
        trainer.use(fitted)


@register_event
@dataclass(frozen=True)
class HoldOut(Event[Trainer]):
    """Begins to hold validation views out, in a new or a resumed fit; the last decision ends it."""

    name: ClassVar[str] = "hold_out"
    always: ClassVar[bool] = True
    outside: ClassVar[bool] = True

    def due(self, trainer: Trainer) -> bool:
        return trainer.validation is None and validates(trainer)

    def apply(self, trainer: Trainer) -> None:
        hold_out(trainer)


def as_decided(method: Method, decisions: Sequence[Mapping[str, Any]]) -> Method:
    """The method with the components that decisions kept; those that it has already change nothing."""
    for row in decisions:
        for event in method.event.values():
            if row["stays"] and isinstance(event, Decision) and row["component"] in event.components():
                method = event.chosen(method, row["component"])
                break
    return method


def differences(run: Run, now: Method) -> dict[str, tuple[Any, Any]]:
    """Keys by which the method of a run differs from another one, with the run's decisions and sizes."""
    found = methods.differences(*(as_decided(method, run.decisions()) for method in (run.method(), now)))
    return {key: pair for key, pair in found.items() if not (key in SIZES and pair[1] is None)}


def fork(trainer: Trainer, method: Method) -> Trainer:
    """Copy a fit to a trainer of another method, at the same iteration, without a run folder. Attributes
    that the method lacks are dropped, SH are cut or filled with zeros, new attributes start as it says."""
    state = trainer.fit.arrays()
    old, rng = part(state, PARAMS), trainer.setup.rng(trainer.iteration, "branch")
    widths = {name: method.surfels.columns(name) for name in method.surfels.names}
    wanted = converted(old, widths, method, rng)
    wanted |= {name: old[name] for name in old if name in APART or name.startswith(AROUND)}
    if method.light is None:
        wanted = {name: values for name, values in wanted.items() if not name.startswith(LIGHT)}
    dropped = (PARAMS, OPTIMISER) if method.has_mesh else (PARAMS, OPTIMISER, MESH)
    new = {name: value for name, value in state.items() if not name.startswith(dropped)}
    for name, values in wanted.items():
        new[f"{PARAMS}{name}"] = np.asarray(values, np.float32)
        for key, kept in part(state, f"{OPTIMISER}{name}/").items():
            if kept.ndim and values.ndim == 2:
                kept = with_columns(kept.reshape(old[name].shape), values.shape[1]).ravel()
            if not kept.ndim or kept.size == values.size:
                new[f"{OPTIMISER}{name}/{key}"] = kept
    made = Trainer(method, trainer.data, state=new, targets=trainer.targets)
    made.whole, made.validation = trainer.whole, trainer.validation
    return made


def continued(trainer: Trainer, steps: int, of: Trainer) -> Trainer:
    """Take some steps in a trial of another fit, between which a pending interrupt is raised."""
    for _ in range(steps):
        trainer.step()
        of.release()
    return trainer


def validation_psnr(trainer: Trainer) -> float:
    """Mean PSNR (dB) of the present state on the validation views; waits for the device."""
    assert trainer.validation is not None
    errors = []
    for view in trainer.validation.views:
        shown = displayed_image(trainer.view(view.camera(), aovs=False), view, trainer.data)
        errors.append(float(squared_error(shown, view).mean()))
    return float(np.mean([psnr_of(error) for error in errors]))


def record(trainer: Trainer, row: Row, verdict: str = "") -> None:
    """Tell a decision, and keep it."""
    verdict = verdict or f"{row.component} {'stays' if row.stays else 'is left out'}"
    trainer.tell(f"{verdict}: {row.reason}")
    trainer.fit.decisions.append(asdict(row))
    if trainer.run is not None:
        trainer.run.write_json(DECISIONS, trainer.fit.decisions)


def conclude(trainer: Trainer, row: Row, began: float, verdict: str = "") -> None:
    """Record a decision, with all the time since `time.perf_counter()` was `began`, and save."""
    record(trainer, row, verdict)
    hold_out(trainer)
    trainer.fit.seconds += time.perf_counter() - began
    trainer.save()
    if trainer.run is not None:
        trainer.run.write_method(trainer.method)
