"""Methods as data: the TOML files of `variants/`, read strictly and scaled to a preset."""

from mi_refgs.methods.build import plain as plain
from mi_refgs.methods.fields import Window as Window
from mi_refgs.methods.method import LossWeight as LossWeight
from mi_refgs.methods.method import Method as Method
from mi_refgs.methods.read import PRESETS as PRESETS
from mi_refgs.methods.read import assignments as assignments
from mi_refgs.methods.read import differences as differences
from mi_refgs.methods.read import dump as dump
from mi_refgs.methods.read import for_purpose as for_purpose
from mi_refgs.methods.read import load as load
from mi_refgs.methods.read import load_resolved as load_resolved
from mi_refgs.methods.read import names as names
