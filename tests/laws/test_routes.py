"""One image by every route: whichever way a scene is rendered, its image and every AOV are the same.

Every shading of every method and model goes through every route, and every pair of the other features occurs.
"""

import itertools
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import mitsuba as mi
import numpy as np
import pytest

from mi_refgs import Reconstruction, import_splats, load
from mi_refgs.cli import main
from mi_refgs.data.poses import MITSUBA_FROM_OPENGL
from mi_refgs.formats import FORMATS, Shot
from mi_refgs.methods import read
from mi_refgs.plugins.aovs import suffixes, values_of_planes
from mi_refgs.reconstruction.provenance import Provenance
from mi_refgs.render.display import image_array
from mi_refgs.render.load_scene import load_scene
from mi_refgs.render.surroundings import Surroundings
from mi_refgs.runs.export import save
from mi_refgs.runs.trained_scene import SCENE, TrainedScene
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.light.near_field import NearField
from mi_refgs.shade.options import TRACED
from mi_refgs.shade.reflectance import MODELS
from mi_refgs.shade.shading import Shading
from mi_refgs.splat import Camera
from mi_refgs.surfels.ply import write_ply
from mi_refgs.surfels.table import Surfels
from mi_refgs.viewer import reconstruction_view
from mi_refgs.viewer.pose import Pose
from mi_refgs.viewer.reconstruction_view import BACKGROUND, IMAGE, DisplayOptions, ReconstructionView
from tests.helpers import read_exr
from tests.laws.covering import covering_array, marked
from tests.laws.option_scenes import xml
from tests.scenes import integrator as scenes

WIDTH, HEIGHT, FOV, NEAR = 16, 12, 40.0, 0.05
CROP = (4, 3, 9, 7)  # offset and size of a crop window, pixels
TOLERANCE = 1e-5  # of an image or an AOV, in parts of its largest value, at least 1

Maps = dict[str, np.ndarray]  # the image (H, W, 4) as IMAGE, linear and premultiplied; AOVs (H, W, C) by type


def shadings() -> list[tuple[Shading, str]]:
    """Each shading once, with its primitive: of all stages of all methods, and of all models."""
    found: dict[tuple[Shading, str], None] = {}
    for name in read.names():
        method = read.load(name, "quick")
        for (_, stage), meshed in itertools.product(method.stages(), {False, method.has_mesh}):
            shading = Shading.resolve(stage.shading, meshed)
            found[replace(shading, at=shading.shaded_at), method.surfels.primitive] = None
    for name, model in MODELS.items():
        for order in model.shaded_at:
            found[Shading(Shading(order, name).shaded_at, name), "surfel"] = None
        plain = Shading(Shading(model.shaded_at[0], name).shaded_at, name, diffuse="irradiance")
        traced = replace(plain, occlusion=plain.traceable)
        honoured = [key for key in model.honoured if traced.occlusion or key not in TRACED]
        if honoured:
            found[replace(traced, **{key: scenes.OTHER_OPTIONS[key] for key in honoured}), "surfel"] = None
    return [*found]


SHADINGS = shadings()


def lens(crop: bool) -> dict[str, Any]:
    film: dict[str, Any] = {"width": WIDTH, "height": HEIGHT}
    film |= {"pixel_format": "rgba", "component_format": "float32"}
    if crop:
        x, y, width, height = CROP
        film |= {"crop_offset_x": x, "crop_offset_y": y, "crop_width": width, "crop_height": height}
    return scenes.sensor(fov=FOV, near_clip=NEAR, film=film)


def sensor(crop: bool = False) -> Any:
    return mi.load_dict(lens(crop))


def trained(shading: Shading, primitive: str, around: str, meshed: bool, bare: bool) -> TrainedScene:
    """Few surfels with sharp and with soft outlines, of every channel or with their colours alone."""
    rng = np.random.default_rng(3)
    raw = scenes.raw_channels()
    raw["scale"] = raw["scale"] - 0.7
    raw["opacity"] = raw["opacity"] + rng.uniform(0, 5, raw["opacity"].shape).astype(np.float32)
    raw["tint"] = rng.normal(size=raw["albedo"].shape).astype(np.float32)
    raw["normal_offset"] = 0.1 * rng.normal(size=raw["albedo"].shape).astype(np.float32)
    others = scenes.far_channels()
    for table in (raw,) * (primitive == "gaussian") + (others,):  # surroundings are Gaussians, as in a fit
        table["scale"] = np.concatenate([table["scale"], table["scale"][:, :1] - 1], axis=1)
    if bare:
        raw = {name: raw[name] for name in ("position", "rotation", "scale", "opacity", "radiance_sh")}
    map_behind = scenes.background_light() if around == "surroundings and a map" else None
    lit = EnvironmentLight.from_radiance(scenes.sky()) if "albedo" in raw else None
    near = NearField(np.array([0.1, -0.2, 0.3]), rng.uniform(0, 0.5, (8, 16)).astype(np.float32))
    return TrainedScene(
        Surfels.from_numpy(raw),
        lit,
        scenes.two_balls() if meshed or shading.occlusion else None,
        shading,
        7,
        1.5,
        surroundings=None if around == "nothing" else Surroundings(Surfels.from_numpy(others), map_behind),
        near=near if map_behind is not None and lit is not None else None,
    )


@dataclass(frozen=True)
class Case:
    """A scene in a state: in memory, as a run folder, and what of it is rendered."""

    made: Reconstruction
    folder: Path
    samples: int
    crop: bool
    alone: bool  # without what is around the object
    scratch: Path  # for files of a route
    part: int  # which third of the variables a page draws, one by one

    @property
    def names(self) -> list[str]:
        return [name for name in suffixes() if name in self.made.trained.surfels.raw or name in GEOMETRY]

    def of_whole(self, whole: Maps) -> Maps:
        """What the crop window leaves of maps of the whole film."""
        x, y, width, height = CROP if self.crop else (0, 0, WIDTH, HEIGHT)
        return {name: value[y : y + height, x : x + width] for name, value in whole.items()}


GEOMETRY = ("normal", "depth", "alpha", "visibility", "diffuse", "specular", "indirect")


def by_reconstruction(case: Case) -> Maps:
    options: Any = {"samples": case.samples, "object_only": case.alone}
    view = sensor(case.crop)
    return {IMAGE: case.made.render(view, **options)} | case.made.aovs(view, case.names, **options)


def by_its_mitsuba_scene(case: Case) -> Maps:
    scene = case.made.scene(sensor(), aovs=case.names, object_only=case.alone)
    return of_mitsuba(scene, sensor(case.crop), case)


def by_scene_file(case: Case) -> Maps:
    path = case.folder / SCENE
    maps = of_mitsuba(load_scene(path, case.names, case.alone), 0, case)
    scene = load_scene(path, object_only=True) if case.alone else mi.load_file(str(path))
    return maps | {IMAGE: mi.render(scene, spp=case.samples).numpy()}


def by_command_with_a_camera(case: Case) -> Maps:
    """The camera in a file, which has no crop window."""
    camera, path = Camera.from_sensor(sensor()), case.scratch / "camera.json"
    numbers = {"fl_x": -camera.fx[0], "fl_y": -camera.fy[0], "cx": camera.cx[0], "cy": camera.cy[0]}
    frames = [{"transform_matrix": (camera.pose() @ MITSUBA_FROM_OPENGL).tolist()}]
    path.write_text(json.dumps({"w": WIDTH, "h": HEIGHT, "near": NEAR, **numbers, "frames": frames}))
    return case.of_whole(of_command(case, case.folder, "--camera", path))


def by_viewer_of_a_run(case: Case) -> Maps:
    """The planes that a page shows at one sample per pixel, and those that it saves at several."""
    view, drawable = Camera.from_sensor(sensor()), ReconstructionView(case.made.trained)
    pose = Pose(view.pose(), 2 * np.arctan(HEIGHT / 2 / -view.fy[0]), WIDTH / HEIGHT, NEAR)
    camera = pose.camera(WIDTH, HEIGHT)
    backdrop = BACKGROUND if not case.alone and case.made.trained.surroundings is not None else "white"
    assert backdrop in drawable.backdrops
    found = {}
    for what in [IMAGE, *drawable.variables[1 + case.part :: 3]]:
        look = DisplayOptions(what, backdrop=backdrop)
        if case.samples == 1:
            planes = drawable.draw(camera, look, True)
        else:
            fine = drawable.fine(camera, look, case.samples)
            planes = reconstruction_view.planes_of(fine, camera, look, None)
        values = planes if what == IMAGE else values_of_planes(what, planes)
        found[what] = image_array(values, HEIGHT, WIDTH)
    return case.of_whole(found)


def by_layers(case: Case) -> Maps:
    """`refgs export --to exr`, which has the depth along the axis, and what is behind as a layer."""
    path, camera = case.scratch / "layers.exr", Camera.from_sensor(sensor(case.crop))
    shots = [Shot("view", "test", camera)]
    options = {"view": 0, "samples": case.samples, "object": case.alone}
    FORMATS["exr"].writer(case.made.trained, path, shots, **options)
    layers = read_exr(path)
    found = {IMAGE: np.stack([layers[letter] for letter in "RGBA"], axis=-1)}
    if "background.R" in layers:
        through = np.stack([layers[f"background.{letter}"] for letter in "RGB"], axis=-1)
        found[IMAGE][..., :3] += (1 - layers["A"][..., None]) * through
        found[IMAGE][..., 3] = 1
    return found | of_layers(layers, [name for name in case.names if name not in ("depth", "alpha")])


ROUTES: dict[str, Callable[[Case], Maps]] = {
    "reconstruction": by_reconstruction,
    "its Mitsuba scene": by_its_mitsuba_scene,
    "scene file": by_scene_file,
    "command of a run": lambda case: of_command(case, case.folder),
    "command of a scene": lambda case: of_command(case, case.folder / SCENE),
    "command with a camera": by_command_with_a_camera,
    "viewer of a run": by_viewer_of_a_run,
    "layers": by_layers,
}


def of_mitsuba(scene: Any, view: Any, case: Case) -> Maps:
    image = mi.render(scene, sensor=view, spp=case.samples).numpy()
    film = (scene.sensors()[view] if isinstance(view, int) else view).film()
    names = [channel.name for channel in film.bitmap().struct_()]
    layers = dict(zip(names, np.moveaxis(image, -1, 0), strict=True))
    return {IMAGE: image[..., :4]} | of_layers(layers, case.names)


def of_command(case: Case, scene: Path, *more: object) -> Maps:
    path = case.scratch / "out.exr"
    command = ["render", scene, "-o", path, "--samples", case.samples, "--aov", *case.names, *more]
    assert main([str(word) for word in [*command, *(["--object"] if case.alone else [])]]) == 0
    layers = read_exr(path)
    return {IMAGE: np.stack([layers[letter] for letter in "RGBA"], axis=-1)} | of_layers(layers, case.names)


def of_layers(layers: dict[str, np.ndarray], names: Sequence[str]) -> Maps:
    found: dict[str, list[np.ndarray]] = {name: [] for name in names}
    for key in sorted(layers, key=lambda key: "RGBXYZ".find(key[-1])):
        if (name := key.partition(".")[0]) in found:
            found[name].append(layers[key])
    return {name: np.stack(values, axis=-1) for name, values in found.items()}


def run_of(made: Reconstruction, folder: Path) -> Path:
    save(made.trained, folder, made.method, Camera.from_sensor(sensor()))
    return folder


def as_fitted(made: Reconstruction, scratch: Path) -> tuple[Reconstruction, Path]:
    return made, run_of(made, scratch / "fitted")


def saved_and_loaded(made: Reconstruction, scratch: Path) -> tuple[Reconstruction, Path]:
    again = load(run_of(made, scratch / "fitted"))
    return again, run_of(again, scratch / "again")


def exported(made: Reconstruction, scratch: Path) -> tuple[Reconstruction, Path]:
    run, out = run_of(made, scratch / "fitted"), scratch / "exported"
    assert main(["export", str(run), "-o", str(out)]) == 0
    return made.changed(TrainedScene.read(out)), out


def edited(made: Reconstruction, scratch: Path) -> tuple[Reconstruction, Path]:
    run, out = run_of(made, scratch / "fitted"), scratch / "edited"
    assert main(["edit", str(run), "-o", str(out), "--where", "x > 0.2", "--set", "opacity*=0.5"]) == 0
    return made.edit(where="x > 0.2", set=["opacity*=0.5"]), out


def through_a_ply(made: Reconstruction, scratch: Path) -> tuple[Reconstruction, Path]:
    """Display-encoded 3D Gaussians as `refgs export --to` writes them; linear ones as every run has them."""
    path, run, encoded = scratch / "splats.ply", scratch / "imported", made.trained.shading.model.encoded
    if encoded:
        FORMATS["3dgs-ply"].writer(made.trained, path, [], degree=1, object=False)
    else:
        write_ply(path, made.trained.surfels)
    assert main(["import", str(path), "-o", str(run), *([] if encoded else ["--linear"])]) == 0
    return import_splats(path, linear=not encoded), run


FEATURES: dict[str, tuple[Any, ...]] = {
    "samples": (1, 4),
    "crop": (False, True),
    "around": ("nothing", "surroundings", "surroundings and a map", "surroundings, left out"),
    "meshed": (False, True),
    "state": (as_fitted, saved_and_loaded, exported, edited),
}

ROWS = covering_array(FEATURES, (), seed=5)
LOSSLESS = [
    (Shading("pixel", "displayed"), "gaussian"),
    (Shading("surfel", "radiance"), "gaussian"),
    (Shading("surfel", "radiance"), "surfel"),
]
"""What a PLY file of another program stores completely."""


def cases() -> Iterator[Any]:
    """Every shading and every row, at least once; and what goes through files of other programs."""
    count = max(len(SHADINGS), len(ROWS))
    crossed = [(*SHADINGS[i % len(SHADINGS)], ROWS[i % len(ROWS)]) for i in range(count)]
    alone = {"samples": 4, "crop": True, "around": "nothing", "meshed": False, "state": through_a_ply}
    crossed += [(*one, alone) for one in LOSSLESS]
    values = [row | {"model": one.reflectance, "options": bool(one.chosen())} for one, _, row in crossed]
    for index, ((shading, primitive, row), marks) in enumerate(zip(crossed, marked(values), strict=True)):
        options = "-".join(shading.chosen())
        rays = "traced" if shading.occlusion else "open"
        state = row["state"].__name__
        name = f"{primitive}-{shading.at}-{shading.reflectance}-{shading.diffuse}-{rays}-{options}-{state}"
        yield pytest.param(shading, primitive, row, index % 3, id=name, marks=marks)


def assert_same(expected: Maps, found: Maps, route: str) -> None:
    assert IMAGE in found
    for name, values in found.items():
        wanted = expected[name]
        assert values.shape == wanted.shape, (route, name)
        worst = np.abs(values - wanted).max() / max(1.0, np.abs(wanted).max())
        assert worst <= TOLERANCE, f"{route}: {name}: differs by {worst:.2g}"


@pytest.mark.parametrize(("shading", "primitive", "row", "part"), [*cases()])
def test_every_route_gives_one_image(
    shading: Shading, primitive: str, row: dict[str, Any], part: int, tmp_path: Path
) -> None:
    alone = row["around"] == "surroundings, left out"
    around = "surroundings and a map" if alone else row["around"]
    scene = trained(shading, primitive, around, row["meshed"], bare=row["state"] is through_a_ply)
    made = Reconstruction(scene, Provenance(read.load("ref_gaussian", "quick")))
    state, folder = row["state"](made, tmp_path)
    crop_sensor_of(folder / SCENE, row["crop"])
    case = Case(state, folder, row["samples"], row["crop"], alone, tmp_path, part)
    expected = by_reconstruction(replace(case, made=state if row["state"] is edited else made))
    assert 0.2 < np.mean(expected["alpha"] > 0.1) and expected[IMAGE][..., :3].max() > 0.1
    for name, route in ROUTES.items():
        assert_same(expected, route(case), name)


def crop_sensor_of(path: Path, crop: bool) -> None:
    """Put the sensor of every scene, by its crop window, into a scene file."""
    tree = ElementTree.parse(path)
    root = tree.getroot()
    for old in root.findall("sensor"):
        root.remove(old)
    root.append(xml(lens(crop), "sensor"))
    tree.write(path)
