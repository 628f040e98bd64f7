"""The result of a fit as one object: render it, relight it, edit it, export it.

A `Reconstruction` never changes; methods that change something return another one, which `save` writes into a
run folder. Images are NumPy arrays (H, W, channels) of float32, linear radiance, their first row at the top.
"""

import tempfile
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeAlias, Unpack

import mitsuba as mi
import numpy as np

from mi_refgs import formats
from mi_refgs.data.dataset import Dataset
from mi_refgs.data.view import View
from mi_refgs.editing.change import apply, edit
from mi_refgs.editing.options import EditOptions, Selection
from mi_refgs.editing.selection import select
from mi_refgs.errors import InputError, counted, require_between, within
from mi_refgs.evaluation import evaluate as evaluation
from mi_refgs.formats.orbits import turntable_cameras
from mi_refgs.formats.splat_import import method_of, read_splats
from mi_refgs.kernels.device import require_supported_variant
from mi_refgs.methods.method import Method
from mi_refgs.occlusion.mesh import Mesh
from mi_refgs.plugins.aovs import aov_values, suffixes
from mi_refgs.reconstruction.new_light import AnyLight, any_light
from mi_refgs.reconstruction.own_scene import scene_of
from mi_refgs.reconstruction.provenance import EDITS, Provenance
from mi_refgs.render.display import composited, image_array
from mi_refgs.render.load_scene import load_scene
from mi_refgs.render.pipeline import Frame
from mi_refgs.render.scene_xml import has_square_pixels
from mi_refgs.runs.export import export, newest, save, write_if_stale
from mi_refgs.runs.relightable import relightable
from mi_refgs.runs.run import Run
from mi_refgs.runs.trained_scene import SCENE, TrainedScene
from mi_refgs.shade.options import ShadingOptions
from mi_refgs.splat import Camera

CameraLike: TypeAlias = Camera | View | int | Any
"""A `Camera`, a data set's `View`, the index of one of `Reconstruction.cameras`, or a Mitsuba sensor."""


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """Surfels with materials, an environment map and a mesh, and how they were fitted.

    Returned by `mi_refgs.fit`, `mi_refgs.load` and `mi_refgs.import_splats`."""

    trained: TrainedScene
    provenance: Provenance
    folder: Path | None = None  # the run folder with exactly this content; None: only in memory
    _temporary: Any = field(default=None, repr=False)  # keeps a temporary folder until the last user is gone
    _renderers: dict[Any, Callable[[Camera], Frame]] = field(default_factory=dict, init=False, repr=False)

    @staticmethod
    def from_params(
        params: Any,
        *,
        mesh: Mesh | None = None,
        shading: ShadingOptions | None = None,
        data: str | Path | None = None,
        name: str = "own",
    ) -> "Reconstruction":
        """Make a reconstruction, in memory, of the state of a loop of one's own.

        params: an `mi.Scene` with the `refgs` integrator or its `mi.traverse`, with its light, mesh, shading
        and surroundings; or a mapping of raw attributes (N, D) by name and "light", the raw map (h, 2h, 3),
        arrays or tensors, whose names may begin with "refgs.". mesh: for relighting and exports, as
        `extract_mesh` makes it. shading: of a mapping only, by default the first model that uses all
        attributes, or else some. data: folder of its data set; without one, cameras are around the object.
        name: of its method. Raises InputError for others, unknown names, wrong shapes, NaN, no light."""
        trained = scene_of(params, mesh, shading)
        if trained.light is not None and (count := trained.light.unusable()):
            raise InputError(f"{count} values are NaN or infinite", "light", remedy="give finite values")
        provenance = Provenance(method_of(trained, name)).with_data(None if data is None else Path(data))
        return Reconstruction(trained, provenance)

    def __repr__(self) -> str:
        light, mesh, around = self.trained.light, self.trained.mesh, self.trained.surroundings
        parts = [
            counted(self.trained.surfels.count, self.trained.surfels.primitive.name),
            f"attributes = {', '.join(self.trained.surfels.raw)}",
            f"light = {None if light is None else f'{light.height} × {2 * light.height}'}",
            f"mesh = {None if mesh is None else f'{len(mesh.faces)} triangles'}",
            *([] if around is None else [f"surroundings = {around.surfels.count}"]),
            f"method = {self.method.name}, {self.trained.iteration} iterations",
            f"folder = {self.folder}",
        ]
        return "Reconstruction[\n  " + ",\n  ".join(parts) + "\n]"

    @property
    def method(self) -> Method:
        return self.provenance.method

    def views(self, split: str = "test") -> Dataset:
        """Read the "test" or "train" views of the data set; `view.load().image` is (H, W, 3)."""
        return self.provenance.views(split)

    def cameras(self, split: str = "test") -> list[Camera]:
        """Return the cameras of the "test" or "train" views; without a data set, some around the object."""
        return [shot.camera for shot in self.provenance.shots(self.trained, split)]

    def turntable(self, count: int) -> list[Camera]:
        """Return cameras on a circle around the object, at the distance and height of the test views, or of
        the training views without any. Raises InputError below 1."""
        require_between(count, "turntable", 1)
        trained, region = self.trained, None
        if trained.surroundings is not None:  # the mesh contains the background, too
            trained, region = replace(trained, mesh=None), self.provenance.region
        try:
            known = self.cameras()
        except InputError:
            known = self.cameras("train")
        return turntable_cameras(trained, known, count, region)

    def camera(self, camera: CameraLike = 0, size: int | tuple[int, int] | None = None) -> Camera:
        """Convert a camera, a view, a Mitsuba sensor or an index of `cameras()` to a `Camera`.

        size: resize it (`Camera.resized`). Raises InputError for an index out of range and any other object.
        """
        if isinstance(camera, int | np.integer):
            known = self.cameras()
            if not -len(known) <= camera < len(known):
                remedy = f"give 0 to {len(known) - 1}"
                raise InputError(f"test has {len(known)}", "camera", f"{camera}", remedy)
            found = known[camera]
        elif isinstance(camera, View):
            found = camera.camera()
        elif isinstance(camera, mi.Sensor):
            found = Camera.from_sensor(camera)
        elif isinstance(camera, Camera):
            found = camera
        else:
            remedy = "give a Camera, a View, a Mitsuba sensor or an index"
            raise InputError("no camera", "camera", type(camera).__name__, remedy)
        return found if size is None else found.resized(size)

    def render(
        self,
        camera: CameraLike = 0,
        *,
        size: int | tuple[int, int] | None = None,
        samples: int = 1,
        object_only: bool = False,
    ) -> np.ndarray:
        """Render a camera (H, W, 4): linear RGB, premultiplied by alpha, and alpha.

        samples: samples per pixel; 4 are 2 × 2, box filtered, 1 is the pixel centre, as in training.
        object_only: render without the background Gaussians; alpha is 1 everywhere with them."""
        seen = self.camera(camera, size)
        frame = self._frame(seen, samples, object_only, aovs=False)
        radiance, alpha = composited(frame)
        return image_array([*radiance, alpha], seen.height, seen.width)

    def aovs(
        self,
        camera: CameraLike = 0,
        names: Sequence[str] = ("albedo", "roughness", "metallic", "normal", "depth"),
        *,
        size: int | tuple[int, int] | None = None,
        samples: int = 1,
        object_only: bool = False,
    ) -> dict[str, np.ndarray]:
        """Render AOVs (H, W, 3) or (H, W, 1) of a camera by name, as the `refgs` integrator does.

        albedo, roughness, metallic (0 … 1) and unit normals (world, towards the camera) are those of the
        visible surface; depth is the distance along the ray from the near plane, scene units; diffuse,
        specular and indirect are premultiplied and sum to the image of the object over black. Raises
        InputError for a name that is unknown or that the surfels do not have."""
        kinds = suffixes()
        for name in names:
            if name not in kinds:
                raise InputError("unknown", "aovs", name, f"use some of {', '.join(kinds)}")
        seen = self.camera(camera, size)
        frame = self._frame(seen, samples, object_only, aovs=True)
        found = {}
        for name in names:
            try:
                values = aov_values(name, frame, seen)
            except KeyError:
                raise InputError("the surfels have no such attribute", "aovs", name, "leave it out") from None
            found[name] = image_array(values, seen.height, seen.width)
        return found

    def _frame(self, camera: Camera, samples: int, object_only: bool, aovs: bool) -> Frame:
        """Render a frame; each kind of renderer is made once."""
        key = mi.variant(), samples, object_only, aovs
        if key not in self._renderers:
            scene = replace(self.trained, surroundings=None) if object_only else self.trained
            self._renderers[key] = scene.renderer(aovs=aovs, samples=samples)
        return self._renderers[key](camera)

    def scene(
        self,
        cameras: CameraLike | Sequence[CameraLike] = 0,
        *,
        aovs: Sequence[str] = (),
        object_only: bool = False,
    ) -> Any:
        """Make the `mi.Scene` of a run's scene.xml, with one sensor per camera.

        `mi.traverse` of it lists the raw attributes (N, D) of the surfels, such as "refgs.roughness", and the
        raw environment map, "refgs.light": `mi.render(scene, params)` differentiates all of them. aovs:
        types, or name:type, appended to the image. A sensor's pixels are square: with a warning, those of a
        camera of fx ≠ fy are others. Raises InputError for mirrored cameras and unknown AOVs."""
        several = cameras if isinstance(cameras, list | tuple) and cameras else [cameras]
        first, *more = map(self.camera, several)
        if not all(map(has_square_pixels, (first, *more))):
            what = "fx and fy differ: the scene's square pixels are not those of `render`"
            warnings.warn(what, RuntimeWarning, stacklevel=2)
        with tempfile.TemporaryDirectory(prefix="refgs_") as folder:
            export(self.trained, Path(folder), first, more)
            return load_scene(Path(folder) / SCENE, aovs, object_only)

    def save(self, folder: str | Path) -> "Reconstruction":
        """Write a run folder without checkpoints, which every command reads, and load it.

        It renders the same images, bit for bit. Raises InputError for a folder that has other files."""
        source, camera = self.provenance, self.provenance.first_camera(self.trained)
        records = source.records | ({EDITS: {"edits": source.edits}} if source.edits else {})
        about: Any = {name: getattr(source, name) for name in ("data", "region", "images", "offset")}
        save(self.trained, Path(folder), source.method, camera, records=records, **about)
        return load(folder)

    def export(self, form: str, path: str | Path, **options: Any) -> list[Path]:
        """Write a file or folder of another program, such as "3dgs-ply" or "cameras"; returns the files.

        `mi_refgs.formats.FORMATS` lists the formats and their options, as `refgs export --help` does. Raises
        InputError for an unknown format or option, a scene that the format cannot represent, a missing
        package, and a path that cannot be written."""
        shots = self.provenance.shots(self.trained, "test", "train")
        return formats.write(self.trained, [form], Path(path), shots, options, self.folder)[form]

    def relight(
        self, light: AnyLight, *, world: bool = False, rotate: float = 0.0, exposure: float = 0.0
    ) -> "Reconstruction":
        """Replace the light: only materials stay, with shadows and bounces of the mesh.

        light: a lat-long map (EXR, HDR), its linear radiance (h, w, 3), or an `EnvironmentLight`. Its first
        row is straight up, along +z, unless it is in `world` directions already, as an `EnvironmentLight`,
        environment.exr and envmap.exr are. rotate: degrees about +z, counter-clockwise seen from above.
        exposure: stops. Raises InputError for a reconstruction without light or materials
        (`runs.relightable`), a light that cannot be used, and options of a `NewLight`, which has its own."""
        scene = replace(relightable(self.trained), light=any_light(light, world, rotate, exposure))
        return self.changed(scene)

    def edit(self, **options: Unpack[EditOptions]) -> "Reconstruction":
        """Change some surfels, as `refgs edit` does; `provenance.edits[-1]` then records how many.

        options: `EditOptions`, such as where="metallic > 0.5", set={"roughness": 0.3}. Raises InputError for
        options that cannot be used."""
        edited, record = edit(self.trained, **options)
        record = {"run": self.folder and str(self.folder), **record}
        provenance = replace(self.provenance, edits=(*self.provenance.edits, record))
        return replace(self.changed(edited), provenance=provenance)

    def changed(self, trained: TrainedScene) -> "Reconstruction":
        """Return another scene of the same method and data, in memory."""
        return replace(self, trained=trained, folder=None)

    def evaluate(
        self, data: str | Path | Dataset | None = None, *, samples: int = 1, progress: bool = False
    ) -> dict[str, Any]:
        """Measure the run on its test views, or on those of `data`, a folder or in memory, as `refgs eval`.

        Raises InputError for a reconstruction in memory, and as `evaluation.evaluate.evaluate` does."""
        if self.folder is None:
            raise InputError("only in memory", "evaluate", "folder", "measure what save(folder) returns")
        data = Path(data) if isinstance(data, str) else data
        return evaluation.evaluate(Run(self.folder), data, progress, samples)


def load(run: str | Path, *, write: bool = True) -> Reconstruction:
    """Read a run folder.

    Where a checkpoint is newer than the files of the scene, these are written first, unless `write` is off.
    Raises InputError for a folder that is no run or cannot be used, and without a supported Mitsuba variant.
    """
    require_supported_variant("mi_refgs.load")
    folder = Run(run)
    provenance = Provenance.of(folder)
    method, camera = provenance.method, provenance.first_camera
    trained = write_if_stale(folder, method, camera) if write else newest(folder, method)
    return Reconstruction(trained, provenance, folder.path)


def import_splats(
    path: str | Path,
    *,
    linear: bool = False,
    box: Sequence[float] | None = None,
    light: AnyLight | None = None,
) -> Reconstruction:
    """Read a splat file of 3DGS or 2DGS into memory, as `refgs import` does; `save` writes the run folder.

    linear: its colours are linear radiance, as this package fits them; otherwise they are display-encoded, as
    3DGS and 2DGS write them. box: two corners (6,); surfels whose centre is outside are left out. light: of a
    file with materials, such as those of Ref-Gaussian (default: constant). It has no mesh, and its cameras
    are around the object, z up. Raises InputError for any other file, a box without surfels, a light that
    changes nothing, and without a supported Mitsuba variant."""
    require_supported_variant("mi_refgs.import_splats")
    trained = read_splats(Path(path), linear, None if light is None else any_light(light, False, 0.0, 0.0))
    if box is not None:
        with within(path):
            trained = apply(trained, ~select(trained, Selection(box=box)), cut=True)
    return Reconstruction(trained, Provenance(method_of(trained, Path(path).stem)))
