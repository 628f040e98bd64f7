"""What would mend what: parts of a fitted scene are replaced by ground truth, one at a time and together.

    python -m benchmarks.oracle --run RUN --run RUN ...
    python -m benchmarks.oracle --small --run RUN -o out     two views, one sample per pixel: a minute

A RUN is a fit, with a mesh and the model `split_sum`, of a data set that `refgs dataset` made of a scene in
scenes/; others are left out. Its own renderer shades what is replaced. Writes oracle.json, of which
`python -m benchmarks.pages` and `python -m benchmarks.plots` make the section of docs/accuracy.md."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import trimesh
from scipy.ndimage import gaussian_filter
from tqdm import tqdm

from benchmarks.common.report import Row, benchmark
from benchmarks.common.view import ROOT
from mi_refgs.data.dataset import Dataset
from mi_refgs.data.view import evenly_spread
from mi_refgs.errors import InputError
from mi_refgs.evaluation import metrics
from mi_refgs.evaluation.error_budget import CLASSES, ErrorBudget, classify
from mi_refgs.evaluation.images import RenderedView
from mi_refgs.evaluation.surface import TrueSurface
from mi_refgs.fitting.image_error import displayed_image
from mi_refgs.io.files import read_json
from mi_refgs.occlusion.mesh import Mesh
from mi_refgs.occlusion.surface_materials import Surface, SurfaceSample, VertexSurfels
from mi_refgs.occlusion.visibility import OFFSET_VOXELS, Occluder
from mi_refgs.render.passes import in_passes
from mi_refgs.render.pipeline import Frame, Request, SurfelScene, render
from mi_refgs.runs.run import Run
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.runs.views import views_of_run
from mi_refgs.shade.ambient import ambient_of_pixels, update_occluder_caches
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.options import ShadingOptions
from mi_refgs.shade.points import ShadingPoints
from mi_refgs.shade.reflectance import TraceContext
from mi_refgs.shade.reflectance.split_sum import SplitSum
from mi_refgs.shade.reflection import reflection
from mi_refgs.shade.shading import Shading
from mi_refgs.splat import Camera
from mi_refgs.surfels.table import Surfels
from mi_refgs.synthesis.ground_truth import Materials, materials_at
from mi_refgs.synthesis.options import scene_hash
from mi_refgs.synthesis.settings import load_scene

SCENES = ROOT / "scenes"
PARTS = ("normals", "materials", "hit normals", "hit materials", "light", "mesh")
"""What can be true: "hit …" are those where traced reflected rays end."""
BOUNCES = 4  # traced, where everything is true
EDGE = 2  # longest edge of the true mesh, whose vertices get values of surfels, in voxels of the fitted one
RAYS = 32  # per vertex, for diffuse light: a quarter of those of relit images, since the mesh is finer
GAUSS_NEWTON = 6  # steps, of the scale of a light
BLURS = (0, 0.8, 1.5, 3, 6, 12)  # σ in pixels, of the errors of normals


@dataclass(frozen=True)
class Case:
    """What is true, and how many specular bounces are traced; None: as the run was fitted."""

    true: tuple[str, ...] = ()
    bounces: int | None = None


CASES = {
    "as fitted": Case(),
    **{f"true {part}": Case((part,)) for part in PARTS if not part.startswith("hit")},
    **{f"{n} traced bounce{'s' * (n > 1)}": Case(bounces=n) for n in (1, 2, BOUNCES)},
    f"true hits, {BOUNCES} bounces": Case(PARTS[2:4], BOUNCES),
    f"all true, {BOUNCES} bounces": Case(PARTS, BOUNCES),
    **{f"all but {part}": Case(tuple(p for p in PARTS if p != part), BOUNCES) for part in PARTS},
    **{f"all true, {n} bounce{'s' * (n > 1)}": Case(PARTS, n) for n in (1, 2)},
}


@dataclass(frozen=True)
class Settings:
    """The runs, samples per pixel, and test views, evenly spread."""

    runs: tuple[str, ...] = ()
    samples: tuple[int, ...] = (1, 16)
    views: int = 4


PAGE, SMALL = Settings(), Settings(samples=(1,), views=2)


class Truth:
    """The scene that a data set shows, in the frame of its views."""

    def __init__(self, data: Dataset, edge: float) -> None:
        """`mesh`: its surface in triangles of edges of at most this length, for attributes of surfels. Raises
        InputError unless `refgs dataset` made it of a scene in scenes/, with surface and light."""
        record = read_json(data.path / "dataset.json")
        file, self.name = SCENES / record["scene"], Path(record["scene"]).stem
        surface = TrueSurface.read(data.path, data.offset)
        if data.environment is None or surface is None or scene_hash(file) != record["scene_sha256"]:
            raise InputError("no truth: its scene is not in scenes/", data.path, "scene", "make it again")
        self.scene, self.surface, whole = load_scene(file), surface, surface.mesh
        corners, faces = trimesh.remesh.subdivide_to_size(whole.vertices, whole.faces, edge, max_iter=20)
        self.mesh = replace(whole, vertices=corners.astype(np.float32), faces=faces.astype(whole.faces.dtype))
        self.light = EnvironmentLight.from_file(data.environment)
        self.offset = mi.Vector3f(*map(float, data.offset))
        wanted = record["objects"]
        self.shapes = [s for s in self.scene.shapes() if (s.id() in wanted if wanted else not s.is_emitter())]

    def at(self, origin: Any, direction: Any, reach: Any, active: Any) -> tuple[Any, Any, Materials]:
        """Whether rays meet the object within so many lengths of theirs, its normals against them, its
        materials."""
        with dr.suspend_grad():
            ray = mi.Ray3f(mi.Point3f(origin + self.offset), mi.Vector3f(direction))
            ray.maxt = reach
            si = self.scene.ray_intersect(ray, active)
            found = mi.Bool(False)
            for shape in self.shapes:
                found |= si.shape == mi.ShapePtr(shape)
            found &= si.is_valid()
            normal = mi.Vector3f(si.sh_frame.n)
            facing = dr.select(dr.dot(normal, ray.d) > 0, -normal, normal)
            materials = Materials(*((x, known & found) for x, known in materials_at(self.scene, si)))
            return found, facing, materials


class TrueHits:
    """A `Surface` whose samples are those of the true surface within OFFSET_VOXELS, where there is one."""

    def __init__(self, fitted: Surface, mesh: Mesh, truth: Truth, true: Sequence[str]) -> None:
        self.fitted, self.rows, self.vertex_surfels = fitted, fitted.rows, fitted.vertex_surfels
        self.truth, self.true, self.reach = truth, true, OFFSET_VOXELS * mesh.voxel
        self.faces, self.corners = mi.UInt32(mesh.faces.ravel()), mi.Float(mesh.vertices.ravel())

    def at(self, triangle: Any, barycentric: Any, active: Any) -> SurfaceSample:
        sample, (u, v) = self.fitted.at(triangle, barycentric, active), barycentric
        index = (dr.gather(mi.UInt32, self.faces, 3 * triangle + k, active) for k in range(3))
        a, b, c = (dr.gather(mi.Point3f, self.corners, i, active) for i in index)
        away = self.reach * dr.normalize(sample.normal)
        start = a * (1 - u - v) + b * u + c * v + away
        found, normal, materials = self.truth.at(start, -away, mi.Float(2), active)
        values = dict(sample.values)
        if "hit materials" in self.true:
            values |= _replaced(values, materials)
        outward = dr.select(found, normal, sample.normal) if "hit normals" in self.true else sample.normal
        return SurfaceSample(values, outward, sample.surfel)


def _replaced(values: dict[str, Any], materials: Materials) -> dict[str, Any]:
    """The materials among values, true where they are known, and nothing that was fitted beside them."""
    true = materials._asdict()
    found = {name: dr.select(true[name][1], true[name][0], values[name]) for name in true if name in values}
    return found | ({"residual": mi.Color3f(0)} if "residual" in values else {})


class TrueOccluder(Occluder):
    """A mesh, true or extracted, with attributes of surfels as on a mesh of `voxel`."""

    def __init__(self, mesh: Mesh, voxel: float, truth: Truth, true: Sequence[str]) -> None:
        super().__init__(mesh)
        self.mesh_now, self.voxel, self.truth, self.true = mesh, voxel, truth, true

    def set_materials(self, surfels: Surfels) -> None:
        self.vertex_surfels = VertexSurfels.of(replace(self.mesh_now, voxel=self.voxel), surfels)

    def surface(self, surfels: Surfels, names: Sequence[str] = ()) -> Any:
        return TrueHits(super().surface(surfels, names), self.mesh_now, self.truth, self.true)


class TruePoints(SplitSum):
    """The split sum, of points whose normals and materials are true before rays are traced from them."""

    visibility = "own"  # type: ignore[assignment]

    def __init__(self, truth: Truth, true: Sequence[str]) -> None:
        self.truth, self.true = truth, true

    def trace(self, points: ShadingPoints, context: TraceContext, options: Any) -> ShadingPoints:
        found, true, materials = self.truth.at(context.origin, context.ray, dr.inf, context.covered)
        normal, values = points.normal, points.attributes
        if "normals" in self.true:  # as long as those that were blended: by this, they are interpolated
            normal = dr.select(found, true * dr.norm(normal), normal)
        if "materials" in self.true:
            values = values | _replaced(values, materials)
        points = reflection(ShadingPoints(normal, points.view, values), context, options.hits)
        return points.replaced(ambient=ambient_of_pixels(context)) if options.ambient_rays else points


@dataclass(frozen=True)
class TrueShading(Shading):
    """The shading of a run with true parts: of true materials the albedo is lit, not a fitted radiance."""

    truth: Any = None
    true: tuple[str, ...] = ()
    hits: Any = None  # options of the points where reflected rays end

    @property
    def model(self) -> SplitSum:
        return TruePoints(self.truth, self.true)


def renderer(
    fitted: TrainedScene, truth: Truth, case: Case, samples: int, scale: np.ndarray
) -> Callable[[Camera], Frame]:
    """As `TrainedScene.renderer`, with a light scaled per channel (3,)."""
    true, given = case.true, asdict(fitted.shading)
    if case.bounces is not None:
        given["traced_bounces"] = case.bounces
    lit = given | {"diffuse": "irradiance", "ambient_rays": RAYS}
    hits = ShadingOptions(**lit if "hit materials" in true else given)
    shading = TrueShading(**lit if "materials" in true else given, truth=truth, true=true, hits=hits)
    assert fitted.light is not None and fitted.mesh is not None
    light = truth.light if "light" in true else fitted.light
    mesh = truth.mesh if "mesh" in true else fitted.mesh
    with dr.suspend_grad():
        filtered = shading.light_of(EnvironmentLight.from_radiance(scale * light.radiance().numpy()))
        occluder = TrueOccluder(mesh, fitted.mesh.voxel, truth, true)
        lighted = ShadingOptions(**lit if {"materials", "hit materials"} & {*true} else given)
        update_occluder_caches(occluder, fitted.surfels, filtered, lighted)
    scene = SurfelScene(fitted.surfels, shading, filtered, occluder, fitted.surroundings, fitted.near)
    once = partial(render, scene, request=Request(("normal",), forward_only=True))

    def draw(camera: Camera) -> Frame:
        with dr.suspend_grad():
            return in_passes(once, camera, samples, shading.neighbours, fitted.count, maps=False)

    return draw


def light_scale(images: Callable[[np.ndarray], np.ndarray], targets: np.ndarray) -> np.ndarray:
    """The scale (3,) of a light with which images (…, 3) of it fit targets best, by Gauss-Newton steps. Light
    and albedo share an unknown one; where only one of them is true, the other does not have it."""
    scale, axes = np.ones(3), tuple(range(targets.ndim - 1))
    for _ in range(GAUSS_NEWTON):
        low, high = images(scale), images(1.1 * scale)
        slope = (high - low) / 0.1
        step = np.sum(slope * (targets - low), axes) / np.maximum(np.sum(slope**2, axes), 1e-30)
        scale *= 1 + np.clip(step, -0.5, 1.0)
    return scale


def spectrum(errors: list[np.ndarray], smooth: list[np.ndarray]) -> dict[str, float]:
    """Root mean square in degrees of errors of unit normals (H, W, 3) in smooth pixels (H, W), after blurring
    them there with each of BLURS."""
    found = {}
    for sigma in BLURS:
        total = 0.0
        for error, where in zip(errors, smooth, strict=True):
            weight = gaussian_filter(where.astype(float), sigma)[..., None]
            blurred = gaussian_filter(error * where[..., None], (sigma, sigma, 0)) / np.maximum(weight, 1e-9)
            total += float(np.sum(blurred[where] ** 2))
        found[f"{sigma:g}"] = float(np.degrees(np.sqrt(total / max(sum(map(np.sum, smooth)), 1))))
    return found


def measured(run: Run, settings: Settings, quiet: bool) -> tuple[list[Row], dict[str, float]]:
    """Rows of the cases of a run, and its `spectrum`; raises InputError for a run without truth or mesh."""
    data, fitted = views_of_run(run, run.method(), "test"), TrainedScene.read(run.path, run.method().plugins)
    if fitted.mesh is None or not isinstance(fitted.shading.model, SplitSum):
        raise InputError("needs a mesh and the model split_sum", run.path, "shading", "leave it out")
    truth, rows, found = Truth(data, EDGE * fitted.mesh.voxel), [], {}
    views = [data.views[i].load() for i in evenly_spread(len(data.views), settings.views)]
    targets = np.stack([view.displayed for view in views])
    classes: list[Any] = [classify(view, truth.surface) for view in views]

    def frames(case: Case, count: int, scale: np.ndarray) -> list[Frame]:
        draw = renderer(fitted, truth, case, count, scale)
        return [draw(view.camera()) for view in views]

    def lit(once: list[Frame], twice: list[Frame], scale: np.ndarray) -> np.ndarray:
        """Images under a scaled light, in which radiance is linear."""
        found, more = [], mi.Color3f(*map(float, scale - 1))
        for a, b, view in zip(once, twice, views, strict=True):
            frame = replace(a, radiance=a.radiance + more * (b.radiance - a.radiance))
            found.append(displayed_image(frame, view, data))
        return np.stack(found)

    for name, case in tqdm(CASES.items(), run.path.name, disable=quiet):
        scale = np.ones(3)
        if ("light" in case.true) != ("materials" in case.true):
            once, twice = (frames(case, 1, k * scale) for k in (1, 2))
            scale = light_scale(partial(lit, once, twice), targets)
        for count in settings.samples:
            drawn, budget = zip(frames(case, count, scale), views, strict=True), ErrorBudget()
            images = [RenderedView.of(frame, data, view) for frame, view in drawn]
            for image, view, of in zip(images, views, classes, strict=True):
                budget.add(image, view, of)
            psnr = np.mean([metrics.psnr(image.image, of) for image, of in zip(images, targets, strict=True)])
            squared = 1e5 * budget.sums[1] / (3 * budget.sums[0].sum())
            row = {"scene": truth.name, "case": name, "samples": count}
            row |= {"psnr": float(psnr)} | dict(zip(CLASSES, map(float, squared), strict=True))
            rows.append(row)
            if not quiet:
                errors = ", ".join(f"{key} {row[key]:.1f}" for key in CLASSES if row[key])
                tqdm.write(f"{name:26} {count:2} samples {psnr:6.2f} dB; squared error, 1e-5: {errors}")
            if case == Case() and count == settings.samples[0]:
                wrong = [image.normal - view.normal for image, view in zip(images, views, strict=True)]
                smooth = [i for i, kind in enumerate(CLASSES) if kind.startswith("mirror")]
                found = spectrum(wrong, [np.isin(of, smooth) for of in classes])
    return rows, found


def measure(settings: Settings, quiet: bool) -> dict[str, Any]:
    """The content of oracle.json; a run that does not fit is named and left out."""
    rows: list[Row] = []
    spectra = {}
    for run in settings.runs:
        try:
            own, found = measured(Run(run), settings, quiet)
            spectra[own[0]["scene"]] = found
            rows += own
        except InputError as error:
            print(f"{run}: left out: {error}", file=sys.stderr)
    return {"spectra": spectra, "rows": rows}


if __name__ == "__main__":
    sys.exit(benchmark("oracle", __doc__, measure, PAGE, SMALL, several=("--run", "runs")))
