"""The `refgs` integrator: Gaussian surfels and deferred shading for `mi.render`."""

import time
import warnings
from dataclasses import replace
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_refgs.constants import RAW_LIMIT
from mi_refgs.errors import InputError
from mi_refgs.kernels.device import require_supported_variant
from mi_refgs.occlusion.visibility import Occluder
from mi_refgs.plugins import properties
from mi_refgs.plugins.aovs import parse_aovs, suffixes
from mi_refgs.plugins.derivatives import require_derivatives
from mi_refgs.plugins.film import FilmImage
from mi_refgs.plugins.light import light_of, used_emitters, warn_of_ignored
from mi_refgs.render.pipeline import Frame, Request, SurfelScene, render
from mi_refgs.render.surroundings import Surroundings, nothing_around
from mi_refgs.shade.ambient import update_occluder_caches
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.light.light import Light
from mi_refgs.splat.camera import Camera
from mi_refgs.surfels.attributes import ATTRIBUTES
from mi_refgs.surfels.table import Surfels

CHECK_SECONDS = 1.0  # least time between checks for unusable values: each waits for the device


class RefGSIntegrator(mi.SamplingIntegrator):
    r"""
    Splats surfels into ``perspective`` views, also in a ``batch``, and shades them under an environment.

    .. pluginparameters::

     * filename (string): PLY file with surfels or 3D Gaussians: raw values (before the activation) of 2DGS or
       3DGS and of the attributes below. In Python, tensors may add or replace attributes.
     * light *or any name* (emitter): An ``envmap`` or ``constant`` emitter, copied into the integrator's own
       light; in Python also the raw tensor of an ``EnvironmentLight``. Maps of more than 512 rows are
       downscaled. (Default: the scene's emitter of these types and, unless the model samples its light, its
       ``directional`` ones)
     * near_field (string): File (.npz) with ``nearness`` (h, 2h), 1 / distance of what an unrotated
       ``envmap`` shows, seen from the point ``centre`` (3,). (Default: infinitely far)
     * mesh (string): PLY file of the mesh that occludes mirror reflections. (Default: none)
     * occlusion (bool): Trace the visibility of the light, with the surfels' indirect light where it is
       blocked. (Default: whether there is a ``mesh``)
     * shade_at (string): ``pixel`` (deferred: blend attributes, then shade) or ``surfel`` (forward: shade,
       then blend radiance). (Default: the first that the reflectance model has)
     * reflectance (string): ``split_sum`` (diffuse and GGX specular), ``radiance`` (SH colour, needs no
       light), ``mirror`` (3DGS-DR), ``gaussian_shader``, ``monte_carlo`` (R3DG), ``displayed`` (encoded SH
       colours of a splat), or a registered model. (Default: the first that uses all attributes, else some)
     * diffuse (string): ``sh`` (view-dependent SH colour) or ``irradiance`` (albedo times the light that the
       specular term leaves). (Default: ``sh`` if there is one)
     * dominant, antialias (bool): Slower and more accurate: look the light up along the GGX lobe's dominant
       direction; average reflections over each pixel, at interpolated normals. (Default: false)
     * visibility_rays, traced_bounces, ambient_rays (int): Specular-lobe samples of the visibility, 1 is the
       mirror ray; traced bounces, in place of indirect light; rays per mesh vertex for diffuse visibility,
       with ``irradiance``. (Default: 1, 0, 0)
     * directions (int): Directions that ``monte_carlo`` samples. (Default: 24)
     * surroundings (string): PLY file with the surfels around the object, splatted with it: geometry and
       ``radiance_sh``. Also tensors, ``surroundings_position`` and so on. (Default: none)
     * background (color or string): Linear radiance behind the surfels, or a lat-long map of it (EXR, HDR; in
       Python also a raw tensor as of ``light``); alpha is then 1. (Default: none, transparent)
     * aovs (string): Comma-separated ``<name>:<type>`` pairs as in the ``aov`` integrator. Types: ``albedo``,
       ``metallic``, ``roughness``, ``tint``, ``normal`` (world, towards the camera), ``depth``, ``alpha``,
       ``visibility``, ``diffuse``, ``specular``, ``indirect``, registered attributes. (Default: none)
     * position, rotation, scale, opacity, radiance_sh, albedo, metallic, roughness, indirect_sh, tint,
       normal_offset *or any registered attribute* (tensor, differentiable): Raw attributes (N, D); all in one
       update, N may change. Three columns of ``scale``: 3D Gaussians.
     * light (tensor, differentiable): Raw map (h, w, 3) of the integrator's own light: radiance =
       ``EnvironmentLight(raw).radiance()``.
     * light_to_world (transform, differentiable): Rotation or reflection of that light.
     * surroundings_position, …, surroundings_radiance_sh, background (tensor, differentiable): Raw attributes
       of the surroundings, and raw map of the background as of ``light``, if there are any.

    Keys of ``mi.traverse`` start with the integrator's id: ``params['refgs.roughness']`` without another one.

    The scene's shapes are not rendered, and lights are visible in reflections only; directional light casts
    no shadows on diffuse surfaces. One warning each names emitters and shapes that are not used. Images have
    no noise. A sample count n (of ``mi.render``, else of the sampler) gives ⌈√n⌉² regular samples per pixel,
    box filtered; n = 1 takes pixel centres. The film's ``rfilter`` is not used. Derivatives in both modes
    reach the parameters above, ``data``, ``scale``, ``radiance.value`` or ``irradiance.value`` of the scene's
    lights, ``x_fov`` and principal point of the sensor, and ``to_world`` of both as a rigid motion; any other
    parameter with gradients raises InputError.

    A surfel with a value that is NaN, infinite or, in position or SH coefficients, beyond 1e18 is not drawn,
    with zero gradient; such a value of a light is black. One warning names each attribute, of no emitter."""

    def __init__(self, props: Any) -> None:
        require_supported_variant("refgs")
        super().__init__(props)
        self.variant = mi.variant()
        if not props.id():
            self.set_id("refgs")  # an address otherwise, and with it every parameter's key
        self.surfels = properties.read_surfels(props)
        self.light, self.light_to_world, self.near = properties.read_light(props)
        self.seen = 0  # id of the scene whose ignored emitters and shapes were named
        self.filtered_light: Light | None = None  # of images without derivatives, until it changes
        self.shading, self.mesh = properties.read_shading(props, self.surfels)
        self.occluder = Occluder(self.mesh) if self.shading.occlusion and self.mesh else None
        self.caches_valid = False  # occluder materials and ambient ratios are up to date
        self.around, self.behind = properties.read_background(props)
        self.aovs = parse_aovs(str(properties.get(props, "aovs", "")))
        self.check()
        self.changed, self.next_check = False, 0.0  # since the last check; seconds of the monotonic clock
        self.announced = set[str]()  # unusable values that were warned of
        self._warn_of_unusable()

    def check(self) -> None:
        """Raise InputError for shapes that do not fit and for attributes that are required but absent."""
        _ = Surfels(self.surfels.raw).primitive  # shapes and names; values are checked where a file is read
        self.shading.require_inputs(self.surfels.raw, mesh=self.occluder is not None)
        for name in self.aovs.values():
            if name in ATTRIBUTES and not self.surfels.has(name):
                raise InputError("the surfels have no such attribute", "refgs", name, "add it, or do without")
        if self.around is not None:
            Surroundings(Surfels(self.around.raw)).check(self.surfels)
        for name, light in self._maps.items():
            try:
                EnvironmentLight(light.raw)  # checks the shape, which an update may have changed
            except InputError as error:
                raise InputError(error.what, "refgs", name, error.remedy) from error

    @property
    def _models(self) -> dict[str, Surfels]:
        models = {"surfels": self.surfels, "surroundings": self.around}
        return {name: model for name, model in models.items() if model is not None}

    @property
    def _maps(self) -> dict[str, EnvironmentLight]:
        maps = {"light": self.light, "background": self.behind}
        return {name: found for name, found in maps.items() if isinstance(found, EnvironmentLight)}

    @property
    def surroundings(self) -> Surroundings | None:
        """What is splatted together with the object's surfels, and the map; None without both."""
        if self.around is None and "background" not in self._maps:
            return None
        around = nothing_around(self.surfels) if self.around is None else self.around
        return Surroundings(Surfels(around.raw, screened=True), self._maps.get("background"))

    def traverse(self, cb: Any) -> None:
        own: dict[str, Any] = dict(self.surfels.raw)
        if self.light is not None:
            own |= {"light": self.light.raw, "light_to_world": self.light_to_world}
        if self.around is not None:
            own |= {properties.AROUND + name: tensor for name, tensor in self.around.raw.items()}
        if "background" in self._maps:
            own["background"] = self.behind.raw
        for name, tensor in own.items():
            cb.put(name, tensor, mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys: list[str]) -> None:
        self.check()
        self.changed = True
        self.filtered_light = None
        # Cached materials depend on geometry and what is usable, ambient ratios on everything; no keys: all.
        geometry = {*self.surfels.primitive.widths, *self.surfels.primitive.optional}
        if not keys or not geometry.isdisjoint(keys) or self.shading.ambient_rays:
            self.caches_valid = False
        elif self.caches_valid and self.occluder is not None and self.shading.traced_bounces:
            self.caches_valid = bool(dr.all(self.usable == self.surfels.detach().usable()))

    def aov_names(self) -> list[str]:
        return [f"{name}.{suffix}" for name, kind in self.aovs.items() for suffix in suffixes()[kind]]

    def render(
        self,
        scene: Any,
        sensor: Any = 0,
        seed: Any = 0,
        spp: int = 0,
        develop: bool = True,
        evaluate: bool = True,
    ) -> Any:
        """The image (h, w, c) of a sensor."""
        with dr.suspend_grad():
            film = self._image(scene, sensor, spp, forward_only=True)  # refuses before anything is read
            if self.changed and (now := time.monotonic()) >= self.next_check:
                self.changed, self.next_check = False, now + CHECK_SECONDS
                self._warn_of_unusable()
            image = film.image()
        if id(scene) != self.seen:
            self.seen = id(scene)
            warn_of_ignored(scene, [] if self.light else used_emitters(self.shading, scene))
        if evaluate:
            dr.eval(image)
        return image if develop else mi.TensorXf()

    def render_forward(self, scene: Any, params: Any, sensor: Any = 0, seed: Any = 0, spp: int = 0) -> Any:
        """Tangent of the image for the tangents of the parameters."""
        with dr.resume_grad():
            return self._image(scene, sensor, spp, params).tangent()

    def render_backward(
        self, scene: Any, params: Any, grad_in: Any, sensor: Any = 0, seed: Any = 0, spp: int = 0
    ) -> None:
        """Accumulate the adjoints of the parameters for the adjoint of the image."""
        with dr.resume_grad():
            for image, δ in self._image(scene, sensor, spp, params).adjoints(grad_in):
                dr.set_grad(image, δ)
                dr.enqueue(dr.ADMode.Backward, image)
                dr.traverse(dr.ADMode.Backward)
                del image, δ  # or the memory of a pass would be held through the next

    def sample(self, *args: Any, **kwargs: Any) -> Any:
        raise InputError("renders whole images only", "refgs", "sample", "do not nest it, use its own `aovs`")

    def _image(
        self, scene: Any, sensor: Any, spp: int, params: Any = None, forward_only: bool = False
    ) -> FilmImage:
        if mi.variant() != self.variant:
            made = f"made under {self.variant}, not {mi.variant()}"
            raise InputError(made, "refgs", "variant", "load the scene again")
        if dr.flag(dr.JitFlag.FreezingScope):  # Dr.Jit would abort the process, or replay wrong sizes
            what = "cannot be recorded: the lengths of the tiles' lists of surfels change from call to call"
            raise InputError(what, "refgs", "dr.freeze", "call mi.render outside of the frozen function")
        sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
        require_derivatives(params, scene, sensor, self)
        view = partial(self.frame, scene, Request({*self.aovs.values()}, forward_only))
        names, count = self.aov_names(), sum(model.count for model in self._models.values())
        return FilmImage(sensor, spp, view, [*self.aovs.values()], names, self.shading.neighbours, count)

    def frame(self, scene: Any, request: Request, camera: Camera) -> Frame:
        """Render one sample per pixel."""
        light = self._light(scene, request.forward_only)
        if self.occluder is not None and not self.caches_valid:
            update_occluder_caches(self.occluder, self.surfels.detach(), light, self.shading)
            self.usable = self.surfels.detach().usable()
            # Mitsuba does not announce changes of the scene's light, on which ambient ratios depend.
            self.caches_valid = self.light is not None or not self.shading.ambient_rays
        surfels = Surfels(self.surfels.raw, screened=True)
        rendered = SurfelScene(surfels, self.shading, light, self.occluder, self.surroundings, self.near)
        frame = render(rendered, camera, request)
        behind = frame.background if "background" in self._maps else self.behind
        return replace(frame.only(request.aovs), background=behind)

    def _light(self, scene: Any, forward_only: bool) -> Light | None:
        """The light as the shading looks it up; its own is filtered once for images without derivatives."""
        if not forward_only or self.light is None:
            return light_of(self.shading, self.light, self.light_to_world, scene)
        if self.filtered_light is None:
            with dr.suspend_grad():
                self.filtered_light = light_of(self.shading, self.light, self.light_to_world, scene)
        return self.filtered_light

    def to_string(self) -> str:
        return f"RefGSIntegrator[\n  surfels = {self.surfels.count},\n  shading = {self.shading}\n]"

    def _warn_of_unusable(self) -> None:
        """Warn of unusable values, once for each attribute and map."""
        maps = self._maps.items()
        found = {name: f"{black} values of {name}" for name, light in maps if (black := light.unusable())}
        for kind, model in self._models.items():
            rows = model.unusable().items()
            found |= {f"{kind} {n}": f"{len(row)} {kind} in {n} (first: {row[0]})" for n, row in rows}
        new = [text for key, text in found.items() if key not in self.announced]
        self.announced |= {*found}
        if new:
            what = f"refgs: values are NaN, infinite or beyond {RAW_LIMIT:g}: {', '.join(new)}"
            warnings.warn(f"{what}; they are left out, such light is black", RuntimeWarning, stacklevel=3)


mi.register_integrator("refgs", RefGSIntegrator)
