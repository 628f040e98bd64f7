# The public names, each stated once: `mi_refgs.NAME` is imported from where this file says on first use.

import mi_refgs.data.dataset
import mi_refgs.fitting.objective
import mi_refgs.formats.format
import mi_refgs.methods.read
import mi_refgs.render.pipeline
import mi_refgs.shade.reflectance
import mi_refgs.surfels.attributes
import mi_refgs.surfels.primitives
from mi_refgs.data.dataset import Dataset as Dataset
from mi_refgs.data.dataset import read_dataset as read_dataset
from mi_refgs.data.images import Pixels as Pixels
from mi_refgs.data.view import View as View
from mi_refgs.editing.options import EditOptions as EditOptions
from mi_refgs.errors import InputError as InputError
from mi_refgs.evaluation.evaluate import evaluate as evaluate
from mi_refgs.fitting.objective import Loss as Loss
from mi_refgs.fitting.objective import LossInputs as LossInputs
from mi_refgs.fitting.runner import Progress as Progress
from mi_refgs.fitting.train import Trainer as Trainer
from mi_refgs.formats.format import Format as Format
from mi_refgs.methods.method import Method as Method
from mi_refgs.occlusion.mesh import Mesh as Mesh
from mi_refgs.occlusion.mesh import read_mesh as read_mesh
from mi_refgs.occlusion.mesh import write_mesh as write_mesh
from mi_refgs.occlusion.visibility import Occluder as Occluder
from mi_refgs.reconstruction.fit import fit as fit
from mi_refgs.reconstruction.new_light import NewLight as NewLight
from mi_refgs.reconstruction.reconstruction import Reconstruction as Reconstruction
from mi_refgs.reconstruction.reconstruction import import_splats as import_splats
from mi_refgs.reconstruction.reconstruction import load as load
from mi_refgs.reconstruction.relightable_import import import_relightable as import_relightable
from mi_refgs.relighting.relight import relight as relight
from mi_refgs.render.pipeline import Frame as Frame
from mi_refgs.render.pipeline import Request as Request
from mi_refgs.render.pipeline import SurfelScene as SurfelScene
from mi_refgs.runs.relightable import relightable as relightable
from mi_refgs.runs.run import Run as Run
from mi_refgs.runs.trained_scene import TrainedScene as TrainedScene
from mi_refgs.shade.light.envmap import EnvironmentLight as EnvironmentLight
from mi_refgs.shade.options import ShadingOptions as ShadingOptions
from mi_refgs.shade.points import RadianceTerms as RadianceTerms
from mi_refgs.shade.points import ShadingPoints as ShadingPoints
from mi_refgs.shade.reflectance import Reflectance as Reflectance
from mi_refgs.shade.reflectance.model import SurfelView as SurfelView
from mi_refgs.shade.shading import Shading as Shading
from mi_refgs.splat.camera import Camera as Camera
from mi_refgs.surfels.attributes import Attribute as Attribute
from mi_refgs.surfels.attributes import Channel as Channel
from mi_refgs.surfels.init import from_points as from_points
from mi_refgs.surfels.ply import read_ply as read_ply
from mi_refgs.surfels.ply import write_ply as write_ply
from mi_refgs.surfels.primitives import Primitive as Primitive
from mi_refgs.surfels.table import Surfels as Surfels
from mi_refgs.synthesis.make_dataset import make_dataset as make_dataset
from mi_refgs.synthesis.options import DatasetOptions as DatasetOptions

FormatOption = mi_refgs.formats.format.Option
load_method = mi_refgs.methods.read.load
register_attribute = mi_refgs.surfels.attributes.register
register_channel = mi_refgs.surfels.attributes.register
register_format = mi_refgs.formats.format.register
register_loss = mi_refgs.fitting.objective.register
register_primitive = mi_refgs.surfels.primitives.register
register_reader = mi_refgs.data.dataset.register_reader
register_reflectance = mi_refgs.shade.reflectance.register
render_frame = mi_refgs.render.pipeline.render

__all__: list[str]
__version__: str
PUBLIC: dict[str, tuple[str, str]]
