"""The options of a rendered image: their values, and which of these do not go together."""

from typing import Any

from mi_refgs.methods.read import load, names
from mi_refgs.shade.options import DIFFUSE, ShadingOptions
from mi_refgs.shade.reflectance import MODELS
from mi_refgs.surfels.primitives.primitive import PRIMITIVES
from tests.laws.covering import Case, Rule

WIDTH, HEIGHT = 16, 12
FOV, NEAR = 45.0, 0.01
CROPS = {"none": (0, 0, WIDTH, HEIGHT), "inner": (3, 2, 8, 6), "corner": (8, 6, 8, 6)}
"""Offset and size, pixels. 2 × 2 samples of half the size share the kernels of the whole."""
ACCURACY: dict[str, Any] = {"none": None, "dominant": True, "antialias": True, "directions": 7}
"""Options of accuracy, one at a time; those of rays beyond the mirror ray are in `test_routes`."""


def shadings() -> list[str]:
    """Every shading of a method of `variants/`, and every registered model: model, order, diffuse."""
    stages = [stage.shading for method in names() for stage in load(method).stage.values()]
    found = [(stage.reflectance, stage.at, stage.diffuse) for stage in stages]
    used = {reflectance for reflectance, _, _ in found}
    found += [(name, model.shaded_at[0], DIFFUSE[0]) for name, model in MODELS.items() if name not in used]
    every: dict[str, None] = {}
    for name, at, diffuse in found:
        model = MODELS[name]
        split = len({model.required_attributes(ShadingOptions(diffuse=d)) for d in DIFFUSE}) > 1
        order = "surfel" if model.order_independent else at
        every[f"{name}/{order}/{diffuse if split else DIFFUSE[0]}"] = None
    return [*every]


DIMENSIONS: dict[str, list[Any]] = {
    "shading": shadings(),
    "primitive": [*PRIMITIVES],
    "input": ["tensors", "ply", "xml", "run"],
    "accuracy": [*ACCURACY],
    "occlusion": [False, True],
    "emitter": ["tensor", "nested", "scene"],
    "map": ["8 rows", "12 rows", "9 x 14", "constant"],
    "rotated": [False, True],
    "background": ["none", "constant", "map"],
    "surroundings": ["", *PRIMITIVES],
    "colour": ["rgb", "luminance", "xyz"],
    "alpha": [False, True],
    "component_format": ["float32", "float16", "uint32"],
    "rfilter": ["box", "tent", "gaussian", "lanczos"],
    "crop": [*CROPS],
    "samples": [1, 4, 5, 9],
    "aovs": ["none", "some", "all"],
    "threads": [1, 2],
    "derivative": ["none", "forward", "reverse", "reverse with a prior"],
}


def _model(shading: str) -> Any:
    return MODELS[shading.partition("/")[0]]


def _traceable(shading: str) -> bool:
    visibility = _model(shading).visibility
    return visibility == "own" or (visibility == "mirror" and "/pixel" in shading)


def _blurs_surfels(shading: str, accuracy: str) -> bool:
    return accuracy == "antialias" and "/pixel" not in shading


RULES = [
    # What is refused.
    Rule(("shading", "occlusion"), lambda shading, occlusion: occlusion and not _traceable(shading),
         "shading: occlusion: needs shading at pixel and reflectance = split_sum"),
    Rule(("shading", "accuracy"), _blurs_surfels, "shading: antialias: needs shading at pixel"),
    Rule(("shading", "accuracy"),
         lambda shading, accuracy: (accuracy not in ("none", *_model(shading).honoured)
                                    and not _blurs_surfels(shading, accuracy)),
         "shading: [a-z_]+: needs reflectance = "),
    Rule(("emitter", "map"), lambda emitter, map_: emitter == "tensor" and map_ == "9 x 14",
         "EnvironmentLight: raw: shape"),
    # What no input can say: an emitter of a model without light, which warns; an emitter's rotation, tensors
    # in a file, options that runs do not have.
    Rule(("emitter", "shading"), lambda emitter, model: emitter == "scene" and _model(model).light == "none"),
    Rule(("emitter", "rotated"), lambda emitter, rotated: emitter == "tensor" and rotated),
    Rule(("map", "rotated"), lambda map_, rotated: map_ == "constant" and rotated),
    Rule(("input", "emitter"), lambda input_, emitter: input_ == "xml" and emitter == "tensor"),
    Rule(("input", "emitter"), lambda input_, emitter: input_ == "run" and emitter != "tensor"),
    Rule(("input", "map"), lambda input_, map_: input_ == "run" and map_ == "9 x 14"),
    Rule(("input", "background"), lambda input_, background: input_ == "run" and background == "constant"),
    Rule(("input", "background", "surroundings"),
         lambda input_, background, around: input_ == "run" and background == "map" and not around),
]  # fmt: skip


FORMATS = {"rgb": "rgba", "luminance": "luminance_alpha", "xyz": "xyza"}  # with alpha, by the one without


def spec(case: Case) -> str:
    return ", ".join(f"{name}={value}" for name, value in case.items())
