"""Methods as data: the TOML files of `variants/`, read strictly and scaled to a preset."""

from mi_refgs.methods.build import plain as plain
from mi_refgs.methods.fields import Window as Window
from mi_refgs.methods.method import LossWeight as LossWeight, Method as Method
from mi_refgs.methods.read import (
    PRESETS as PRESETS,
    assignments as assignments,
    differences as differences,
    dump as dump,
    for_purpose as for_purpose,
    load as load,
    load_resolved as load_resolved,
    names as names,
)
