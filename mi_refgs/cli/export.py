"""`refgs export`: the files of a run, its own and those of other programs."""

from dataclasses import dataclass, field, make_dataclass
from typing import Annotated, Any

from mi_refgs.cli.command import OptionalOutput, OtherData, Rendering, Result, RunFolder, optional, separated
from mi_refgs.errors import InputError
from mi_refgs.io.progress import say

MOST_LISTED = 12  # files that are named one by one; the default export writes 10


@dataclass(frozen=True, kw_only=True)
class Export:
    """Without --to: surfels.ply, envmap.exr, mesh.ply and scene.xml of the newest checkpoint."""

    run_folder: RunFolder
    output: OptionalOutput = None
    """folder (default: RUN itself); with --to the file, or the folder of several"""
    to: tuple[str, ...] = ()
    data: OtherData = None
    format: Any = None
    common: Rendering = Rendering()

    def run(self) -> Result:
        from mi_refgs.formats import write
        from mi_refgs.io.ownership import own_folder
        from mi_refgs.reconstruction.provenance import Provenance
        from mi_refgs.runs.export import export, newest
        from mi_refgs.runs.run import Run
        from mi_refgs.runs.trained_scene import TrainedScene

        names = separated(self.to)
        given = vars(self.format).items()
        options = {name: value for name, value in given if value is not None and value is not False}
        if options and not names:
            option = f"--{next(iter(options)).replace('_', '-')}"
            raise InputError("belongs to a format", option, remedy="name it with --to")
        if names and self.output is None:
            raise InputError("names no file", "--to", remedy="say with -o which file or folder to write")
        folder = Run(self.run_folder)
        method = folder.method()
        state, saved = folder.load_checkpoint(), folder.checkpoints()
        if state is None or int(state["iteration"]) < int(saved[-1].stem):  # damaged: of the artefacts, too
            fitted = newest(folder, method)
        else:
            fitted = TrainedScene.from_state(method, state)
        source = Provenance.of(folder).with_data(self.data)
        if source.data is not None and not source.has_data:
            say(f"note: {source.data} is gone; cameras are around the object, or give --data")
        shots = source.shots(fitted, "test", "train")
        target = self.output or folder.path
        if names:
            say(f"{target}: writing {', '.join(names)}")
            written = write(fitted, names, target, shots, options, folder.path)
            files = [str(path) for paths in written.values() for path in paths]
        else:
            if target.resolve() != folder.path.resolve():
                own_folder(target, f"export of {folder.path.resolve()}")
            files = [str(path) for path in export(fitted, target, shots[0].camera)]
        data = {"files": files, "iteration": fitted.iteration, "surfels": fitted.surfels.count}
        listed = files if len(files) <= MOST_LISTED else [f"{target}: {len(files)} files"]
        return Result(data, "\n".join(listed))


def command() -> type[Export]:
    """Return the class of the command, with the options of all registered formats."""
    from mi_refgs.formats.format import FORMATS, options_of

    fields: list[Any] = []
    for option in options_of(FORMATS).values():
        users = ", ".join(name for name, made in FORMATS.items() if option in made.options)
        switch = option.default is False
        text = f"{option.help} ({users}{'' if switch else f'; default: {option.default}'})"
        declared = optional(None if switch else option.name[0].upper(), help=text)
        kind = bool if switch else type(option.default) | None
        fields.append((option.name, Annotated[kind, declared], False if switch else None))
    options = make_dataclass("FormatOptions", fields, frozen=True, kw_only=True)
    listed = f"formats of other programs: {', '.join(FORMATS)}"
    formats = Annotated[tuple[str, ...], optional("NAME …", help=listed)]
    lines = [f"  {made.name:<14}{made.summary}" for made in FORMATS.values()]
    export = make_dataclass(
        "Export",
        [("to", formats, ()), ("format", options, field(default=options()))],
        bases=(Export,),
        frozen=True,
        kw_only=True,
    )
    example = ["example:", "  refgs export runs/glossy --to 3dgs-ply cameras -o out"]
    export.__doc__ = "\n".join([Export.__doc__ or "", "", "formats:", *lines, "", *example])
    return export
