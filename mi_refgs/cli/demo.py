"""`refgs demo`: data set, fit and evaluation of a small scene of the package."""

from dataclasses import dataclass
from typing import Any

from mi_refgs.cli.command import Output, Preset, Rendering, Result, Settings
from mi_refgs.cli.evaluate import table
from mi_refgs.io.files import resource_dir
from mi_refgs.io.progress import command_line, say
from mi_refgs.registry import plugin_options

SCENE = "glossy_demo.xml"
VIEWS, TEST_VIEWS, SIZE, SAMPLES = 60, 8, 112, 64  # chosen for less than 8 minutes on two cores


@dataclass(frozen=True, kw_only=True)
class Demo:
    """An interrupted demo is continued by the same command.

    example:
      refgs demo -o runs/demo"""

    output: Output  # folder of the data set and the run
    preset: Preset = "quick"
    set: Settings = ()
    common: Rendering = Rendering()

    def run(self) -> Result:
        from mi_refgs.evaluation.evaluate import SHEET, read_metrics
        from mi_refgs.io.ownership import own_folder
        from mi_refgs.reconstruction.fit import fit
        from mi_refgs.runs.run import Run
        from mi_refgs.synthesis.make_dataset import make_dataset

        # Refuse a folder with a foreign or unreadable run before the data set is traced.
        own_folder(self.output, "demo")
        data, output = self.output / "data", self.output / (self.preset or "quick")
        run = Run(output)
        if run.exists():
            run.method()
        else:
            run.require_none()
        say(f"1 of 3: tracing {VIEWS + TEST_VIEWS} views of {SCENE} into {data}")
        images: dict[str, Any] = {"views": VIEWS, "test_views": TEST_VIEWS, "size": SIZE, "spp": SAMPLES}
        make_dataset(resource_dir("scenes") / SCENE, data, environment_height=64, **images)
        say(f"2 of 3: fitting into {output}")
        found = fit(data, preset=self.preset, settings=sum(self.set, ()), output=output, resume=run.exists())
        say("3 of 3: evaluating")
        result, sheet = read_metrics(run), output / SHEET
        if result is None or result.get("iterations") != found.trained.iteration or not sheet.is_file():
            result = found.evaluate(progress=True)
        then = command_line("view", output) + plugin_options()
        text = f"{table(result)}\ncontact sheet: {sheet}; next: {then}"
        paths = {"contact_sheet": str(sheet), "run": str(output), "data": str(data)}
        return Result({**paths, "metrics": result}, text)
