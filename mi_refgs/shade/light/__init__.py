"""Lights, and their kinds; importing this package registers those that ship."""

from mi_refgs.shade.light.constant import Constant
from mi_refgs.shade.light.kind import LIGHTS
from mi_refgs.shade.light.maps import Known, Learnt

for _kind in (Learnt, Constant, Known):
    LIGHTS.register(_kind)
