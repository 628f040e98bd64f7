"""Reflective Gaussian Splatting on Mitsuba 3.

`import mi_refgs` does two things: it makes sure that Dr.Jit runs on a usable LLVM (`mi_refgs.llvm`), and it
registers the Mitsuba plugins (`mi_refgs.plugins`), now if a variant is set and again after every switch. It
may stand before or after `mi.set_variant`; it should stand before `import mitsuba`, so that it can still
choose the LLVM. The names of `__all__` are what a user of Python needs; each module of theirs is imported
when its first name is asked for, so that `import mi_refgs` stays quick.

Without a usable LLVM the import warns (RuntimeWarning) and says what to install, unless there is a CUDA
device. `mi.set_variant` to an LLVM variant then raises ImportError; if one is set already, the import does.
"""

from __future__ import annotations

import importlib
import warnings
from typing import TYPE_CHECKING, Any

from mi_refgs import llvm

if TYPE_CHECKING:
    from mi_refgs.data.dataset import Dataset as Dataset
    from mi_refgs.data.dataset import read_dataset as read_dataset
    from mi_refgs.data.readers import register as register_reader
    from mi_refgs.data.view import View as View
    from mi_refgs.editing.edit import EditOptions as EditOptions
    from mi_refgs.errors import InputError as InputError
    from mi_refgs.evaluation.evaluate import evaluate as evaluate
    from mi_refgs.fitting.progress import Progress as Progress
    from mi_refgs.fitting.train import Trainer as Trainer
    from mi_refgs.methods.method import Method as Method
    from mi_refgs.methods.read import load as load_method
    from mi_refgs.occlusion.mesh import Mesh as Mesh
    from mi_refgs.occlusion.mesh import read_mesh as read_mesh
    from mi_refgs.occlusion.mesh import write_mesh as write_mesh
    from mi_refgs.occlusion.visibility import Occluder as Occluder
    from mi_refgs.reconstruction.fit import fit as fit
    from mi_refgs.reconstruction.importing import import_splats as import_splats
    from mi_refgs.reconstruction.new_light import NewLight as NewLight
    from mi_refgs.reconstruction.reconstruction import Reconstruction as Reconstruction
    from mi_refgs.reconstruction.reconstruction import load as load
    from mi_refgs.relighting.relight import relight as relight
    from mi_refgs.render.pipeline import Frame as Frame
    from mi_refgs.render.pipeline import render as render_frame
    from mi_refgs.runs.relightable import relightable as relightable
    from mi_refgs.runs.run import Run as Run
    from mi_refgs.runs.trained_scene import TrainedScene as TrainedScene
    from mi_refgs.shade.accuracy import Accuracy as Accuracy
    from mi_refgs.shade.light.envmap import EnvironmentLight as EnvironmentLight
    from mi_refgs.shade.reflectance import Reflectance as Reflectance
    from mi_refgs.shade.reflectance import register as register_reflectance
    from mi_refgs.shade.shading import Shading as Shading
    from mi_refgs.splat.camera import Camera as Camera
    from mi_refgs.surfels.attributes import Channel as Channel
    from mi_refgs.surfels.attributes import register as register_channel
    from mi_refgs.surfels.init import from_points as from_points
    from mi_refgs.surfels.ply import read_ply as read_ply
    from mi_refgs.surfels.ply import write_ply as write_ply
    from mi_refgs.surfels.primitives import Primitive as Primitive
    from mi_refgs.surfels.primitives import register as register_primitive
    from mi_refgs.surfels.table import Surfels as Surfels
    from mi_refgs.synthesis.make_dataset import make_dataset as make_dataset

__version__ = "0.1.0"

_PUBLIC = {
    "Accuracy": ("shade.accuracy", "Accuracy"),
    "Camera": ("splat.camera", "Camera"),
    "Channel": ("surfels.attributes", "Channel"),
    "Dataset": ("data.dataset", "Dataset"),
    "EditOptions": ("editing.edit", "EditOptions"),
    "EnvironmentLight": ("shade.light.envmap", "EnvironmentLight"),
    "Frame": ("render.pipeline", "Frame"),
    "InputError": ("errors", "InputError"),
    "Mesh": ("occlusion.mesh", "Mesh"),
    "Method": ("methods.method", "Method"),
    "NewLight": ("reconstruction.new_light", "NewLight"),
    "Occluder": ("occlusion.visibility", "Occluder"),
    "Primitive": ("surfels.primitives", "Primitive"),
    "Progress": ("fitting.progress", "Progress"),
    "Reconstruction": ("reconstruction.reconstruction", "Reconstruction"),
    "Reflectance": ("shade.reflectance", "Reflectance"),
    "Run": ("runs.run", "Run"),
    "Shading": ("shade.shading", "Shading"),
    "Surfels": ("surfels.table", "Surfels"),
    "TrainedScene": ("runs.trained_scene", "TrainedScene"),
    "Trainer": ("fitting.train", "Trainer"),
    "View": ("data.view", "View"),
    "evaluate": ("evaluation.evaluate", "evaluate"),
    "fit": ("reconstruction.fit", "fit"),
    "from_points": ("surfels.init", "from_points"),
    "import_splats": ("reconstruction.importing", "import_splats"),
    "load": ("reconstruction.reconstruction", "load"),
    "load_method": ("methods.read", "load"),
    "make_dataset": ("synthesis.make_dataset", "make_dataset"),
    "read_dataset": ("data.dataset", "read_dataset"),
    "read_mesh": ("occlusion.mesh", "read_mesh"),
    "read_ply": ("surfels.ply", "read_ply"),
    "register_channel": ("surfels.attributes", "register"),
    "register_primitive": ("surfels.primitives", "register"),
    "register_reader": ("data.readers", "register"),
    "register_reflectance": ("shade.reflectance", "register"),
    "relight": ("relighting.relight", "relight"),
    "relightable": ("runs.relightable", "relightable"),
    "render_frame": ("render.pipeline", "render"),
    "write_mesh": ("occlusion.mesh", "write_mesh"),
    "write_ply": ("surfels.ply", "write_ply"),
}
"""Public name → the module that defines it, and its name there."""

__all__ = [
    "Accuracy",
    "Camera",
    "Channel",
    "Dataset",
    "EditOptions",
    "EnvironmentLight",
    "Frame",
    "InputError",
    "Mesh",
    "Method",
    "NewLight",
    "Occluder",
    "Primitive",
    "Progress",
    "Reconstruction",
    "Reflectance",
    "Run",
    "Shading",
    "Surfels",
    "TrainedScene",
    "Trainer",
    "View",
    "evaluate",
    "fit",
    "from_points",
    "import_splats",
    "load",
    "load_method",
    "make_dataset",
    "read_dataset",
    "read_mesh",
    "read_ply",
    "register_channel",
    "register_primitive",
    "register_reader",
    "register_reflectance",
    "relight",
    "relightable",
    "render_frame",
    "write_mesh",
    "write_ply",
]


def __dir__() -> list[str]:
    return [*globals(), *__all__]


if not TYPE_CHECKING:  # a type checker reads the imports above

    def __getattr__(name: str) -> Any:
        """Import a public name when it is asked for first. [PEP 562]"""
        if name not in _PUBLIC:
            raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
        module, inner = _PUBLIC[name]
        value = globals()[name] = getattr(importlib.import_module(f"{__name__}.{module}"), inner)
        return value


llvm.select()
_llvm_problem = llvm.problem()

import drjit as dr  # noqa: E402  (only now is the library named that this loads)
import mitsuba as mi  # noqa: E402

from mi_refgs import plugins  # noqa: E402

# A warning, not an error: `refgs doctor` must start, and it too begins with this import.
if _llvm_problem and not dr.has_backend(dr.JitBackend.CUDA):
    warnings.warn(str(_llvm_problem), RuntimeWarning, stacklevel=2)


def _on_variant(old: str | None, new: str) -> None:
    """Refuse an LLVM variant that would abort the process at its first kernel, else register the plugins."""
    if _llvm_problem and new.startswith("llvm"):
        raise ImportError(str(_llvm_problem))
    plugins.load()


mi.detail.add_variant_callback(_on_variant)
if (_variant := mi.variant()) is not None:
    _on_variant(None, _variant)
