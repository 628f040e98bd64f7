"""The loss of one rendered view: the sum of registered losses, with the weights of the method."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi

from mi_refgs.data.dataset import Dataset
from mi_refgs.errors import InputError
from mi_refgs.fitting import losses
from mi_refgs.fitting.photographed_light import PhotographedLight
from mi_refgs.fitting.targets import Target
from mi_refgs.methods.extensions import LOSSES, Loss, register_loss
from mi_refgs.methods.method import LossWeight
from mi_refgs.render.depth_normals import normals_from_depth
from mi_refgs.render.display import displayed
from mi_refgs.render.pipeline import Frame
from mi_refgs.shade.light.light import Light
from mi_refgs.types import Float

MATERIALS = ("roughness", "metallic")  # maps that neighbouring pixels of similar colour share
MIRROR = ("albedo", *MATERIALS)  # maps that say how much of the light a pixel mirrors
MATERIAL_EDGE = 10.0  # steepness of edges that are kept: a step of 0.1 between pixels counts a third


@dataclass(frozen=True)
class LossInputs:
    """What a loss may read of a step: an image of H rows of W pixels, as planes (H·W,) in raster order."""

    frame: Frame
    """With derivatives: linear radiance (premultiplied by alpha), alpha 0 … 1, depth in scene units, blended
    world normals, materials 0 … 1 in `maps`; see `Frame` for where each is defined."""
    image: list[Float]
    """R, G, B with derivatives: display-encoded (sRGB), over the background, clipped where the target is."""
    target: Target
    """The training view, without derivatives: `image` as above, `alpha` 0 … 1 or None, and its `camera`, of
    `width` W and `height` H."""
    light: Light | None
    """With derivatives, linear radiance by world direction: `light.irradiance(normal)` is the cosine-weighted
    mean. None without a light, where a loss on it returns None."""
    log_gain: list[Float] | None = None  # natural log of the exposure of R, G, B, width 1 each; None: 0
    photographed: PhotographedLight | None = None  # what photographs show of the light, if there is any
    terms: dict[str, Float] = field(default_factory=dict)  # losses of this step until now, detached, width 1

    @staticmethod
    def of(
        frame: Frame,
        target: Target,
        data: Dataset,
        light: Light | None = None,
        log_gain: list[Float] | None = None,
        photographed: PhotographedLight | None = None,
    ) -> "LossInputs":
        """Display a frame as its target is, with highlights clipped where those of the target are."""
        gain = None
        if log_gain is not None:  # one per pixel: the sum of its derivatives then needs no kernels of its own
            every = dr.zeros(mi.UInt32, dr.width(frame.alpha))
            gain = [dr.gather(mi.Float, dr.exp(value), every) for value in log_gain]
        image = displayed(frame, data.background, data.is_linear_radiance, gain)
        if target.clipped is not None:
            image = losses.clip_highlights(image, target.image, target.clipped)
        return LossInputs(frame, image, target, light, log_gain, photographed)


def _gain(inputs: LossInputs) -> Float | None:
    squares = [dr.square(value) for value in inputs.log_gain or ()]
    return squares[0] + squares[1] + squares[2] if squares else None


def _normal(inputs: LossInputs, mirrors: bool = False) -> Float | None:
    frame, weight, maps = inputs.frame, inputs.frame.alpha, inputs.frame.maps
    if mirrors:
        if not {*MIRROR} <= {*maps}:
            return None
        weight = weight * dr.mean(maps["albedo"]) * maps["metallic"] * (1 - maps["roughness"]) ** 4
    depth_normal, valid = normals_from_depth(frame.depth, frame.alpha, inputs.target.camera)
    covered = dr.detach(frame.alpha) if frame.background is None else frame.object_alpha
    return losses.normal_consistency(frame.normal, depth_normal, valid, weight, covered)


def _half_metal(inputs: LossInputs) -> Float | None:
    metallic = inputs.frame.maps.get("metallic")
    return None if metallic is None else losses.undecided(metallic, inputs.frame.object_alpha)


def _materials(inputs: LossInputs) -> Float | None:
    frame, target = inputs.frame, inputs.target
    if not {*MATERIALS} <= {*frame.maps}:
        return None
    maps = [dr.detach(frame.object_alpha) * frame.maps[name] for name in MATERIALS]
    return losses.smoothness(maps, target.image, *target.size, MATERIAL_EDGE)


def _photographed(inputs: LossInputs) -> Float | None:
    return inputs.light and inputs.photographed and inputs.photographed.difference(inputs.light)


register_loss(Loss("l1", lambda of: losses.l1(of.image, of.target.image)))
register_loss(Loss("gain", _gain))
register_loss(Loss("ssim", lambda of: losses.d_ssim(of.image, of.target.image, *of.target.size)))
register_loss(Loss("normal", _normal, normals=True))
register_loss(Loss("mirror_normal", lambda of: _normal(of, True), True, True, attributes=MIRROR))
register_loss(
    Loss("smooth", lambda of: losses.smoothness(of.frame.normal, of.target.image, *of.target.size), True)
)
register_loss(Loss("half_opaque", lambda of: losses.undecided(of.frame.alpha, mi.Float(1))))
register_loss(Loss("half_metal", _half_metal, maps=True, attributes=("metallic",)))
register_loss(Loss("materials", _materials, maps=True, attributes=MATERIALS))
register_loss(Loss("light_colour", lambda of: of.light and losses.light_colour(of.light), light=True))
register_loss(Loss("photographed", _photographed, light=True))
register_loss(
    Loss(
        "alpha",
        lambda of: None if of.target.alpha is None else losses.alpha_loss(of.frame.alpha, of.target.alpha),
    )
)


def losses_in_use(weights: Mapping[str, LossWeight]) -> list[Loss[LossInputs]]:
    """The registered losses that a method weighs, in the order in which they are summed."""
    return [loss for loss in LOSSES.values() if loss.name in weights and weights[loss.name].weight]


def objective(inputs: LossInputs, weights: Mapping[str, LossWeight], iteration: int) -> tuple[Float, Float]:
    """Weighted sum of the losses (width 1), and the squared error of each pixel (H*W,), detached."""
    image, target = inputs.image, inputs.target
    dr.eval(image, inputs.frame.radiance)  # once, for all losses and their adjoints
    loss = None
    for registered in losses_in_use(weights):
        name, weight = registered.name, weights[registered.name].at(iteration)
        if weight and (value := registered.value(inputs)) is not None:
            if not dr.is_diff_v(value) or dr.width(value) != 1:
                found = f"{dr.width(value)} of type {type(value).__name__}, from which nothing learns"
                raise InputError(found, f"loss.{name}", remedy="return one mi.Float, as dr.mean does")
            inputs.terms[name] = dr.detach(value)
            # A changing weight is opaque: a literal would be compiled into each step's kernels.
            value = value * (dr.opaque(mi.Float, weight) if weights[name].rise else weight)
            loss = value if loss is None else loss + value
    if loss is None:
        raise InputError(f"none in iteration {iteration}", "loss", remedy="give one a weight, as l1 = 0.8")
    squares = (dr.square(dr.detach(a) - b) for a, b in zip(image, target.image, strict=True))
    return loss, sum(squares, mi.Float(0)) / 3
