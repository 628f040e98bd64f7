"""The parameters of a fit by name: two tables, the reflected light, and what lies behind everything."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mi_refgs.methods.method import APART, LIGHT
from mi_refgs.methods.surroundings import AROUND, BACKGROUND
from mi_refgs.render.surroundings import Surroundings
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.surfels.table import Surfels


def channels_of(params: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """The channels of the object's table by name, or with the prefix AROUND those of the surroundings."""
    if prefix:
        return {name.removeprefix(prefix): x for name, x in params.items() if name.startswith(prefix)}
    return {name: x for name, x in params.items() if name not in APART and not name.startswith(AROUND)}


def light_of(params: Mapping[str, Any]) -> EnvironmentLight | None:
    """The environment that the object reflects, if there is one; raises InputError for a wrong shape."""
    return EnvironmentLight(params[LIGHT]) if LIGHT in params else None


def surroundings_of(params: Mapping[str, Any]) -> Surroundings | None:
    """The surroundings, if there are any; raises InputError for wrong shapes."""
    channels = channels_of(params, AROUND)
    if not channels:
        return None
    behind = EnvironmentLight(params[BACKGROUND]) if BACKGROUND in params else None
    return Surroundings(Surfels(channels), behind)
