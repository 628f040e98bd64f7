"""`refgs edit`: a new run with other materials and arrangement."""

from dataclasses import dataclass

from mi_refgs.cli.command import Output, Rendering, Result, RunFolder
from mi_refgs.editing.options import Change, Selection
from mi_refgs.errors import within
from mi_refgs.io.progress import say


@dataclass(frozen=True, kw_only=True)
class Edit:
    """The run stays as it is.

    example:
      refgs edit runs/glossy -o runs/matte --set roughness=0.6 --where "metallic > 0.5"
    """

    run_folder: RunFolder
    output: Output  # new run folder
    selection: Selection = Selection()
    change: Change = Change()
    common: Rendering = Rendering()

    def run(self) -> Result:
        from mi_refgs.editing.change import assignments
        from mi_refgs.editing.selection import parse_condition
        from mi_refgs.reconstruction.reconstruction import load
        from mi_refgs.runs.run import Run

        Run(self.output).require_none()
        options = vars(self.selection) | vars(self.change)
        options["set"] = sum(options["set"], ())
        # Both are checked before the run is read, which takes seconds.
        assignments(options["set"])
        if self.selection.where is not None:
            parse_condition(self.selection.where)
        before = load(self.run_folder, write=False)
        with within(self.run_folder):
            after = before.edit(**options)
        entry = after.provenance.edits[-1]
        for note in entry["notes"]:
            say(f"note: {note}")
        after.save(self.output)
        selected = f"{entry['selected']} of {entry['of']} surfels selected"
        text = f"{self.output}: {selected}; the new run has {entry['surfels']}"
        return Result({"output": str(self.output), **entry}, text)
