"""How light becomes radiance, as data: the one declaration of every shading option, for method files, plugin,
`scene.xml` and `model.json`. Name a new field in `Reflectance.honoured` of models that honour it."""

from dataclasses import dataclass, field, fields
from typing import Any, Literal, get_args, get_type_hints

from mi_refgs.errors import InputError, abbreviated

ShadedAt = Literal["pixel", "surfel"]
Diffuse = Literal["sh", "irradiance"]
DIFFUSE: tuple[Diffuse, ...] = get_args(Diffuse)

MAX_RAYS = 4096  # rays per lobe, and bounces, which are unrolled in the kernel
MAX_DIRECTIONS = 64  # per hemisphere: their visibility is one bit each of a 64-bit word
NOT_A_SETTING = {"setting": False}  # metadata of a field that method files do not contain: it follows


def number(default: int, least: int, most: int) -> Any:
    """A field for an integer from `least` to `most`."""
    return field(default=default, metadata={"range": (least, most)})


@dataclass(frozen=True)
class ShadingOptions:
    """How light becomes radiance; what costs extra is off by default. Wrong types and ranges: InputError."""

    at: ShadedAt = "pixel"  # deferred shading per pixel or forward shading per surfel
    reflectance: str = "split_sum"  # a name in `reflectance.MODELS`
    diffuse: Diffuse = "sh"  # fitted SH radiance, or albedo times the irradiance of the light
    occlusion: bool = field(default=False, metadata=NOT_A_SETTING)  # trace visibility; follows from a mesh
    dominant: bool = False  # look the light up along the lobe's dominant direction, not the mirror direction
    visibility_rays: int = number(1, 1, MAX_RAYS)  # specular-lobe samples per pixel; 1: the mirror ray
    traced_bounces: int = number(0, 0, MAX_RAYS)  # of blocked rays, not indirect_sh; and residual_sh
    ambient_rays: int = number(0, 0, MAX_RAYS)  # per mesh vertex, for the ambient visibility; 0: unoccluded
    directions: int = number(24, 1, MAX_DIRECTIONS)  # per hemisphere; R3DG uses 64, which takes twice as long
    antialias: bool = False  # average the reflection over each pixel, at interpolated normals

    def __post_init__(self) -> None:
        for option in fields(ShadingOptions):
            value, kind = getattr(self, option.name), TYPES[option.name]
            least, most = option.metadata.get("range", (0, 0))
            if allowed := get_args(kind):
                fits, wanted = value in allowed, " or ".join(allowed)
            else:
                fits = type(value) is kind and (kind is not int or least <= value <= most)
                wanted = {int: f"a whole number {least} … {most}", bool: "True or False"}.get(kind, "a name")
            if not fits:
                what = f"{abbreviated(value)} is not allowed"
                raise InputError(what, "shading", option.name, f"use {wanted}")

    def chosen(self) -> list[str]:
        """Names of the QUALITY options that differ from their defaults."""
        return [name for name in QUALITY if getattr(self, name) != getattr(ShadingOptions, name)]


TYPES = get_type_hints(ShadingOptions)
QUALITY = tuple(name for name in TYPES if name not in ("at", "reflectance", "diffuse", "occlusion"))
"""Names of the options that trade time for a smaller error."""
TRACED = ("visibility_rays", "traced_bounces", "ambient_rays")  # no effect without occlusion
