"""The public names: `mi_refgs.NAME` is NAME of this module, which is imported at the first use of one."""

from mi_refgs.data.dataset import (
    Dataset as Dataset,
    read_dataset as read_dataset,
    register_reader as register_reader,
)
from mi_refgs.data.images import Pixels as Pixels
from mi_refgs.data.view import View as View
from mi_refgs.editing.options import EditOptions as EditOptions
from mi_refgs.errors import InputError as InputError
from mi_refgs.evaluation.evaluate import evaluate as evaluate
from mi_refgs.fitting.events.densify import densify_and_prune as densify_and_prune
from mi_refgs.fitting.events.mesh import surface_of as extract_mesh
from mi_refgs.fitting.losses import (
    alpha_loss as alpha_loss,
    d_ssim as d_ssim,
    l1 as l1,
    light_colour as light_colour,
    normal_consistency as normal_consistency,
    planes as image_planes,
    smoothness as smoothness,
    undecided as undecided,
)
from mi_refgs.fitting.objective import LossInputs as LossInputs
from mi_refgs.fitting.optim import Adam as Adam, LearningRate as LearningRate
from mi_refgs.fitting.runner import Progress as Progress
from mi_refgs.fitting.schedule import learning_rates as learning_rates
from mi_refgs.fitting.state import ParameterTable as ParameterTable, TableEdit as TableEdit
from mi_refgs.fitting.train import Trainer as Trainer
from mi_refgs.formats.format import Format as Format, Option as FormatOption, register as register_format
from mi_refgs.methods.extensions import (
    Event as Event,
    Initialiser as Initialiser,
    Loss as Loss,
    Start as Start,
    Wanted as Wanted,
    register_event as register_event,
    register_initialiser as register_initialiser,
    register_loss as register_loss,
)
from mi_refgs.methods.fields import Window as Window
from mi_refgs.methods.method import Method as Method
from mi_refgs.methods.read import load as load_method
from mi_refgs.occlusion.mesh import Mesh as Mesh, read_mesh as read_mesh, write_mesh as write_mesh
from mi_refgs.occlusion.visibility import Occluder as Occluder
from mi_refgs.reconstruction.fit import fit as fit
from mi_refgs.reconstruction.new_light import NewLight as NewLight
from mi_refgs.reconstruction.reconstruction import (
    Reconstruction as Reconstruction,
    import_splats as import_splats,
    load as load,
)
from mi_refgs.reconstruction.relight import relight as relight
from mi_refgs.reconstruction.relightable_import import import_relightable as import_relightable
from mi_refgs.registry import load_plugins as load_plugins
from mi_refgs.render.pipeline import (
    Frame as Frame,
    Request as Request,
    SurfelScene as SurfelScene,
    render as render_frame,
)
from mi_refgs.runs.relightable import relightable as relightable
from mi_refgs.runs.run import Run as Run
from mi_refgs.runs.trained_scene import TrainedScene as TrainedScene
from mi_refgs.shade.light.envmap import EnvironmentLight as EnvironmentLight
from mi_refgs.shade.light.kind import (
    FittedLight as FittedLight,
    LightKind as LightKind,
    register as register_light,
)
from mi_refgs.shade.options import ShadingOptions as ShadingOptions
from mi_refgs.shade.points import RadianceTerms as RadianceTerms, ShadingPoints as ShadingPoints
from mi_refgs.shade.reflectance import Reflectance as Reflectance, register as register_reflectance
from mi_refgs.shade.reflectance.model import SurfelView as SurfelView
from mi_refgs.shade.shading import Shading as Shading
from mi_refgs.splat.camera import Camera as Camera
from mi_refgs.surfels.attributes import Attribute as Attribute, register as register_attribute
from mi_refgs.surfels.init import from_points as from_points
from mi_refgs.surfels.ply import read_ply as read_ply, write_ply as write_ply
from mi_refgs.surfels.primitives.primitive import Primitive as Primitive, register as register_primitive
from mi_refgs.surfels.table import Surfels as Surfels
from mi_refgs.synthesis.make_dataset import make_dataset as make_dataset
from mi_refgs.synthesis.mesh_surfels import surfels_from_mesh as surfels_from_mesh
from mi_refgs.synthesis.options import DatasetOptions as DatasetOptions

load_plugins()  # those of installed packages
