"""The `refgs` integrator: Gaussian surfels and deferred shading behind `mi.render`.

Imported or reloaded for each variant: see `mi_refgs.plugins`.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_refgs.errors import InputError
from mi_refgs.kernels.device import require_supported_variant
from mi_refgs.plugins.aovs import aov_values
from mi_refgs.plugins.film import Picture
from mi_refgs.plugins.light import FilteredOnce
from mi_refgs.plugins.properties import read_aovs, read_light, read_shading, read_surfels, read_terms
from mi_refgs.plugins.surroundings import Around
from mi_refgs.plugins.unusable import UnusableValues
from mi_refgs.render.display import composited
from mi_refgs.render.pipeline import Frame, Request, SurfelScene, render
from mi_refgs.shade.ambient import update_occluder_caches
from mi_refgs.shade.points import TERMS
from mi_refgs.splat.camera import Camera
from mi_refgs.surfels.attributes import ATTRIBUTES
from mi_refgs.surfels.primitives import require_known_primitive
from mi_refgs.surfels.table import Surfels


class RefGSIntegrator(mi.SamplingIntegrator):
    r"""
    .. _integrator-refgs:

    Reflective Gaussians (:monosp:`refgs`)
    --------------------------------------

    .. pluginparameters::

     * - filename
       - |string|
       - PLY file with the surfels, or with 3D Gaussians: the properties of 2DGS or 3DGS, and those of the
         other channels below, all raw (before the activation). In Python, channels may be given instead, or
         replaced, by tensors under their names.

     * - light *or any name*
       - |emitter|
       - An ``envmap`` or ``constant`` emitter, copied into the integrator's own light. Without one, the
         scene's own environment emitter of these types lights the surfels. In Python also the raw tensor of
         a ``mi_refgs.shade.light.envmap.EnvironmentLight``.

     * - mesh
       - |string|
       - PLY file of the mesh that occludes mirror reflections. (Default: none)

     * - occlusion
       - |bool|
       - Trace visibility along the mirror direction, and show the surfels' indirect light where it is
         blocked; ``monte_carlo`` traces each of its directions. (Default: whether there is a ``mesh``)

     * - shade_at
       - |string|
       - ``pixel`` (blend attributes, then shade) or ``surfel`` (shade, then blend radiance). (Default:
         ``pixel``; ``surfel`` with ``gaussian_shader`` and ``monte_carlo``, which have no other)

     * - reflectance
       - |string|
       - ``split_sum`` (diffuse and GGX specular), ``radiance`` (the SH colour alone, needs no light; the two
         orders of shading are then the same), ``mirror`` (the SH colour mixed with a perfect mirror by
         ``metallic``, 3DGS-DR), ``gaussian_shader`` (SH colour, diffuse and tinted specular layer) or
         ``monte_carlo`` (light summed over the hemisphere, R3DG). (Default: the first of these whose channels
         the surfels have)

     * - diffuse
       - |string|
       - ``sh`` (view-dependent SH colour) or ``irradiance`` (albedo times the light that the specular term
         leaves). (Default: ``sh`` if there is one)

     * - dominant, multiscatter, antialias
       - |bool|
       - Buy accuracy: look the light up along the GGX lobe's dominant direction; add what bounces between
         facets; widen roughness by how much normals turn within a pixel. (Default: false)

     * - visibility_rays, traced_bounces, ambient_rays
       - |int|
       - Rays of the lobe that visibility is averaged over, 1 is the mirror ray; how often what blocks rays is
         shaded, in place of the surfels' indirect light; and rays from each vertex of the mesh for the share
         of diffuse light that arrives, with ``irradiance``. (Default: 1, 0, 0: all of it)

     * - directions, light_levels
       - |int|
       - Directions that ``monte_carlo`` takes light from; levels of roughness that ``split_sum`` filters the
         light to. Fewer cost less. (Default: 24, 7)

     * - terms
       - |string|
       - Terms in the image, out of ``diffuse,specular,indirect``. (Default: all)

     * - surroundings
       - |string|
       - PLY file with the surfels around the object, splatted with it: geometry and ``radiance_sh``. Also
         tensors, ``surroundings_position`` and so on. (Default: none, the object alone)

     * - background
       - |color| or |string|
       - Linear radiance behind the surfels, or a lat-long map of it (EXR, HDR; in Python also a raw tensor as
         of ``light``); alpha is then 1. (Default: none, transparent)

     * - aovs
       - |string|
       - Comma-separated ``<name>:<type>`` pairs as in the ``aov`` integrator, appended to RGB(A). Types:
         ``albedo``, ``metallic``, ``roughness``, ``tint``, ``normal`` (world, towards the camera), ``depth``,
         ``alpha``, ``visibility``, ``diffuse``, ``specular``, ``indirect``. (Default: none)

     * - position, rotation, scale, opacity, radiance_sh, albedo, metallic, roughness, indirect_sh, tint,
         normal_offset *or any registered channel*
       - |tensor|
       - Raw channels of shape (N, D). They may be replaced by ones with another N, all in one update. A
         ``scale`` of three columns makes the rows 3D Gaussians.
       - |exposed|, |differentiable|

     * - light
       - |tensor|
       - Raw map (h, w, 3) of the integrator's own light, if it has one: radiance =
         ``EnvironmentLight(raw).radiance()``, positive for any raw value. Light of the scene is exposed by
         its emitter instead.
       - |exposed|, |differentiable|

     * - surroundings_position, …, surroundings_radiance_sh, background
       - |tensor|
       - Raw channels of the surroundings, and raw map of the background as of ``light``, if there are any.
       - |exposed|, |differentiable|

    The keys start with the integrator's id, `refgs` unless the scene sets one: ``params['refgs.roughness']``.

    This integrator splats surfels in the view of a `perspective` sensor. It does not see the scene's
    shapes, and shows the environment only as reflections. Without noise, it ignores the seed. A sample
    count n (of ``mi.render``, else of the sensor's sampler, whose default is 4) gives k × k regular samples
    a pixel, k = ⌈√n⌉, box filtered; n = 1 takes pixel centres. `mi.render` differentiates it in both modes
    with respect to the parameters above and to ``data``, ``scale`` or ``radiance.value`` of the scene's
    environment, but not to sensors, background or mesh; `mi_refgs.splat.composite` lists the derivatives that
    are absent.

    A surfel with a value that is NaN or infinite in any channel, or beyond 1e18 in position or harmonics,
    covers no pixel and gets zero gradient; such a value of the light is black. A warning names the channel,
    once.

    .. tabs::
        .. code-tab:: xml

            <integrator type="refgs">
                <string name="filename" value="surfels.ply"/>
                <emitter type="envmap" name="light">
                    <string name="filename" value="envmap.exr"/>
                </emitter>
                <string name="aovs" value="nn:normal,rough:roughness"/>
            </integrator>

        .. code-tab:: python

            'type': 'refgs',
            'filename': 'surfels.ply',
            'light': {'type': 'envmap', 'filename': 'envmap.exr'},
            'aovs': 'nn:normal,rough:roughness',
    """

    def __init__(self, props: Any) -> None:
        require_supported_variant("refgs")
        super().__init__(props)
        self.variant = mi.variant()
        if not props.id():
            self.set_id("refgs")  # an address otherwise, and with it every parameter's key
        self.surfels = read_surfels(props)
        self.light, self.light_rotation = read_light(props)
        self.shading, self.occluder = read_shading(props, self.surfels)
        self.terms = read_terms(props)
        self.around = Around.of(props, self.surfels)
        self.aovs = read_aovs(props)
        self.filtered = FilteredOnce()
        self.caches_valid = False  # occluder materials and ambient ratios are up to date
        self.check()
        self.unusable = UnusableValues(self.around.values(self.surfels, self.light))

    def check(self) -> None:
        """Raise InputError for shapes that do not fit and for channels that are needed but absent."""
        Surfels(self.surfels.raw)  # checks shapes; values are checked where a file is read
        require_known_primitive(self.surfels.raw)
        self.shading.require_inputs(self.surfels.raw)
        for name in (aov.type for aov in self.aovs if aov.type in ATTRIBUTES):
            if not self.surfels.has(name):
                raise InputError(f"refgs: {name}: the surfels have no such channel; add it, or do without it")
        self.around.check(self.surfels, self.light)

    # ---------------- parameters ----------------

    def traverse(self, cb: Any) -> None:
        for name, tensor in self.around.parameters(self.surfels, self.light).items():
            cb.put(name, tensor, mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys: list[str]) -> None:
        self.check()
        self.unusable.changed = True
        self.filtered.forget()
        self.caches_valid = self.caches_valid and not self.shading.ambient_rays
        self.caches_valid = (
            self.caches_valid and {*keys}.isdisjoint(self.surfels.primitive.widths) and bool(keys)
        )

    def aov_names(self) -> list[str]:
        return [channel for aov in self.aovs for channel in aov.channels()]

    # ---------------- rendering ----------------

    def render(
        self,
        scene: Any,
        sensor: Any = 0,
        seed: Any = 0,
        spp: int = 0,
        develop: bool = True,
        evaluate: bool = True,
    ) -> Any:
        """The image (h, w, c) of a sensor; see the class for its channels."""
        self.unusable.look(self.around.values(self.surfels, self.light))
        image = self._picture(scene, sensor, spp, derivatives=False).image()
        if evaluate:
            dr.eval(image)
        return image if develop else mi.TensorXf()

    def render_forward(self, scene: Any, params: Any, sensor: Any = 0, seed: Any = 0, spp: int = 0) -> Any:
        """Tangent of the image for the tangents of the parameters."""
        with dr.resume_grad():
            return self._picture(scene, sensor, spp).tangent()

    def render_backward(
        self, scene: Any, params: Any, grad_in: Any, sensor: Any = 0, seed: Any = 0, spp: int = 0
    ) -> None:
        """Accumulate the adjoints of the parameters for the adjoint of the image."""
        with dr.resume_grad():
            for image, δ in self._picture(scene, sensor, spp).adjoints(grad_in):
                dr.set_grad(image, δ)
                dr.enqueue(dr.ADMode.Backward, image)
                dr.traverse(dr.ADMode.Backward)
                del image, δ  # or the memory of a pass would be held through the next

    def sample(self, *args: Any, **kwargs: Any) -> Any:
        raise InputError("refgs: sample: renders whole images only; do not nest it, use its own `aovs`")

    def _picture(self, scene: Any, sensor: Any, spp: int, derivatives: bool = True) -> Picture:
        """The image through the sensor's film."""
        if mi.variant() != self.variant:
            made = f"made under {self.variant}, not {mi.variant()}"
            raise InputError(f"refgs: variant: {made}; load the scene again")
        sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
        view = partial(self.frame, scene, derivatives, {aov.type for aov in self.aovs}, self.around)
        neighbours, count = self.shading.neighbours, self.around.count(self.surfels)
        return Picture(sensor, spp, view, self._channels, self.aov_names(), neighbours, count)

    def _channels(self, frame: Frame, camera: Camera, alpha: bool) -> list[Any]:
        """R, G, B, (A), W and the AOVs, as the film's blocks have them."""
        rgb, coverage = composited(frame)
        more = [value for aov in self.aovs for value in aov_values(aov.type, frame, camera)]
        return [*rgb, *([coverage] if alpha else []), mi.Float(1), *more]

    def frame(
        self, scene: Any, derivatives: bool, aovs: Collection[str], around: Around, camera: Camera
    ) -> Frame:
        """One sample per pixel of an image with these types of AOVs, `around` the object being that."""
        asked = {*aovs} | {*(self.terms if len(self.terms) < len(TERMS) else ())}
        light = self.filtered.of(self.shading, self.light, self.light_rotation, scene, derivatives)
        if self.occluder is not None and not self.caches_valid:
            update_occluder_caches(self.occluder, self.surfels.detach(), light, self.shading)
            # No one is told when a light of the scene changes.
            self.caches_valid = self.light is not None or not self.shading.ambient_rays
        surfels, surroundings = Surfels(self.surfels.raw, screened=True), around.splatted(self.surfels)
        rendered = SurfelScene(surfels, self.shading, light, self.occluder, surroundings)
        frame = render(rendered, camera, Request(asked, forward_only=not derivatives))
        if len(self.terms) < len(TERMS):  # of the object alone
            radiance = sum((getattr(frame.terms, name) for name in self.terms), start=mi.Color3f(0))
            frame = replace(frame, radiance=radiance)
        return replace(frame.only(aovs), background=around.behind(frame))

    def to_string(self) -> str:
        size = "x".join(str(x) for x in self.light.raw.shape[:2]) if self.light is not None else "the scene's"
        what = f"surfels = {self.surfels.count},\n  channels = {', '.join(self.surfels.raw)}"
        return f"RefGSIntegrator[\n  {what},\n  light = {size},\n  shading = {self.shading}\n]"


mi.register_integrator("refgs", RefGSIntegrator)
