"""`refgs profile`: where the time of a training step goes."""

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import arg

from mi_refgs.cli.command import OtherData, Rendering, Result, RunFolder
from mi_refgs.errors import InputError, require_between


@dataclass(frozen=True, kw_only=True)
class Profile:
    """A run is measured at its newest checkpoint; nothing is written.

    example:
      refgs profile runs/glossy"""

    run_folder: RunFolder
    steps: Annotated[int, arg(metavar="N")] = 15  # steps to measure
    data: OtherData = None
    common: Rendering = Rendering()

    def run(self) -> Result:
        from mi_refgs.evaluation.profile import phases_of, stepper
        from mi_refgs.fitting.train import Trainer
        from mi_refgs.runs.run import Run
        from mi_refgs.runs.views import views_of_run

        require_between(self.steps, "--steps", 1)
        folder = Run(self.run_folder)
        method = folder.method()
        if not folder.checkpoints():
            raise InputError("none", folder.path, "checkpoints", "measure the run that was fitted")
        trainer = Trainer(method, views_of_run(folder, method, "train", self.data), folder)
        rows = phases_of(stepper(trainer, trainer.method.stage_at(max(trainer.iteration, 1))[0]), self.steps)
        lines = [f"{'phase':<20}{'ms':>10}{'launches':>10}{'share':>8}"]
        lines += ["{phase:<20}{ms:>10.2f}{launches:>10}{share:>8.0%}".format(**row) for row in rows]
        ms, launches = (sum(row[name] for row in rows) for name in ("ms", "launches"))
        lines.append(f"{'sum':<20}{ms:>10.2f}{launches:>10}")
        return Result({"phases": rows}, "\n".join(lines))
