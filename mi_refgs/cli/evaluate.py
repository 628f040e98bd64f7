"""`refgs eval`: metrics of a run on its test views."""

from dataclasses import dataclass
from typing import Any

from mi_refgs.cli.command import OtherData, Rendering, Result, RunFolder, Samples
from mi_refgs.evaluation.scores import PIXEL_CLASSES, SCORES, caption_lines


@dataclass(frozen=True, kw_only=True)
class Eval:
    """Writes metrics.json, renders, and a contact sheet with the ground truth to the run folder.

    example:
      refgs eval runs/glossy --json"""

    run_folder: RunFolder
    data: OtherData = None
    samples: Samples = 1
    common: Rendering = Rendering()

    def run(self) -> Result:
        from mi_refgs.evaluation.evaluate import SHEET, evaluate
        from mi_refgs.runs.run import Run

        result = evaluate(Run(self.run_folder), self.data, progress=True, samples=self.samples)
        return Result(result, f"{table(result)}\nsheet: {self.run_folder / SHEET}")


def table(result: dict[str, Any]) -> str:
    """Return the numbers of metrics.json as text."""
    lines, absent = caption_lines(result["caption"]), dict[str, list[str]]()
    for score in SCORES:
        if (value := result[score.key]) is not None:
            form = score.form + score.unit
            concave = result[f"{score.key}_concave"] if score.concave else None
            suffix = "" if concave is None else f"  (concave: {form.format(concave)})"
            lines.append(f"{score.title:<27}{form.format(value)}{suffix}")
        elif score.reason:
            absent.setdefault(result[f"{score.reason}_reason"], []).append(score.title)
    lines += [f"not measured: {'; '.join(titles)} ({reason})" for reason, titles in absent.items()]
    if budget := result["error_budget"]:
        lines.append(f"{'error budget':<30}{'pixels':>8}{'squared error':>16}{'normal error':>15}")
    for name, row in (budget or {}).items():
        angle = "" if row["normal_mae_deg"] is None else f"{row['normal_mae_deg']:>14.1f}°"
        lines.append(f"  {PIXEL_CLASSES[name]:<28}{row['pixels']:>8.1%}{row['squared_error']:>16.1%}{angle}")
    return "\n".join(lines)
