"""The `refgs` plugin: scenes, parameters, derivatives in both modes, AOVs, sensors and films, variants, refusals."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import trimesh

from mi_refgs.errors import InputError
from mi_refgs.occlusion.mesh import Mesh, write_mesh
from mi_refgs.render.pipeline import Shading, render
from mi_refgs.render.scene_xml import write_scene_xml
from mi_refgs.shade.envmap import EnvironmentLight
from mi_refgs.splat import footprint
from mi_refgs.splat.camera import Camera
from mi_refgs.surfels.ply import write_ply
from mi_refgs.surfels.table import CHANNELS, Surfels

WIDTH, HEIGHT = 16, 12
COUNT = 24
STEPS = (5e-3, 5e-4, 1e-4)
"""The order of surfels and the kinks of the lookups spoil differences over large steps, rounding those over small ones."""
TANGENT_TOLERANCE = 5e-3  # relative L2 at the best step; observed 4e-5 … 1.4e-3


def raw_channels(count: int = COUNT, seed: int = 1) -> dict[str, np.ndarray]:
    """Overlapping discs on a unit sphere, with every channel."""
    rng = np.random.default_rng(seed)
    normal = rng.normal(size=(count, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    # The shortest rotation from +z to the normal, (n × …, 1 + n_z), with some noise.
    rotation = np.stack([-normal[:, 1], normal[:, 0], 0 * normal[:, 0], 1 + normal[:, 2]], 1)
    raw = {
        "position": normal,
        "rotation": rotation + 0.1 * rng.normal(size=(count, 4)),
        "scale": np.log(rng.uniform(0.25, 0.5, (count, 2))),
        "opacity": rng.uniform(-1, 1, (count, 1)),
        "radiance_sh": 0.15 * rng.normal(size=(count, 12)),
        "albedo": rng.normal(size=(count, 3)),
        "metallic": rng.normal(size=(count, 1)),
        "roughness": rng.normal(size=(count, 1)),
        "indirect_sh": 0.15 * rng.normal(size=(count, 12)) + 0.5 * (np.arange(12) < 3),
    }
    return {name: values.astype(np.float32) for name, values in raw.items()}


def sky(height: int = 8) -> np.ndarray:
    """Smooth radiance without symmetries."""
    rng = np.random.default_rng(2)
    return np.exp(0.5 * rng.normal(size=(height, 2 * height, 3))).astype(np.float32)


def sensor(**changes: object) -> dict:
    film = {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT, "pixel_format": "rgb", "rfilter": {"type": "box"}}
    film |= changes.pop("film", {})  # type: ignore[operator]
    to_world = mi.ScalarTransform4f().look_at([3, 1, 2], [0, 0, 0], [0, 0, 1])
    sampler = {"type": "independent", "sample_count": 1}
    return {"type": "perspective", "fov": 45, "to_world": to_world, "film": film, "sampler": sampler} | changes


def integrator(raw: dict[str, np.ndarray] | None = None, **changes: object) -> dict:
    raw = raw_channels() if raw is None else raw
    light = EnvironmentLight.from_radiance(sky()).raw
    channels = {name: mi.TensorXf(values) for name, values in raw.items()}
    return {"type": "refgs", **channels, "light": light} | changes


def scene(camera: dict | None = None, raw: dict[str, np.ndarray] | None = None, **changes: object) -> mi.Scene:
    return mi.load_dict(
        {"type": "scene", "integrator": integrator(raw, **changes), "sensor": camera or sensor()}
    )


def image(of: mi.Scene, **arguments: object) -> np.ndarray:
    return mi.render(of, **arguments).numpy()


def refused(words: str, action: Callable[[], object]) -> None:
    """Mitsuba wraps what a plugin raises while it renders; the reason must stand in the chain."""
    with pytest.raises(Exception) as info:  # noqa: PT011
        action()
    error: BaseException | None = info.value
    reasons = []
    while error is not None:
        reasons.append(str(error))
        error = error.__cause__
    assert words in " ← ".join(reasons)


def plane_mesh(folder: Path) -> str:
    """A wall behind the sphere's right half, seen in its reflections."""
    mesh = trimesh.creation.box((0.2, 8, 8))
    mesh.apply_translation((-2.5, 4, 0))
    path = folder / "mesh.ply"
    write_mesh(path, Mesh(mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32), 0.05))
    return str(path)


# ---------------- scenes ----------------


def run_folder(folder: Path, background: tuple[float, float, float] | None = None) -> tuple[Surfels, Camera]:
    """What a fit leaves behind, with a principal point off the centre."""
    surfels = Surfels.from_numpy(raw_channels())
    write_ply(folder / "surfels.ply", surfels)
    EnvironmentLight.from_radiance(sky()).write(folder / "envmap.exr")
    plane_mesh(folder)
    shifted = sensor(principal_point_offset_x=0.1, principal_point_offset_y=-0.2)
    camera = Camera.from_sensor(mi.load_dict(shifted))
    write_scene_xml(
        folder / "scene.xml",
        ply="surfels.ply",
        envmap="envmap.exr",
        mesh="mesh.ply",
        shading=Shading(occlusion=True),
        camera=camera,
        background=background,
    )
    return surfels, camera


def test_exported_scene_renders_the_same_view(tmp_path: Path) -> None:
    surfels, camera = run_folder(tmp_path)
    loaded = mi.load_file(str(tmp_path / "scene.xml"))
    occluder = loaded.integrator().occluder
    light = EnvironmentLight.from_radiance(sky()).prefilter()
    frame = render(surfels, camera, Shading(occlusion=True), light, occluder)
    expected = np.concatenate([frame.radiance().numpy(), frame.alpha.numpy()[None]]).T.reshape(HEIGHT, WIDTH, 4)
    result = image(loaded)
    assert expected[..., 3].max() > 0.5
    assert np.ptp(loaded.integrator().occluder.mesh().vertices) > 0
    np.testing.assert_allclose(result, expected, atol=1e-5)
    assert image(mi.load_file(str(tmp_path / "scene.xml"), spp=4)).shape == result.shape


def test_parameter_keys_do_not_depend_on_the_address(tmp_path: Path) -> None:
    run_folder(tmp_path, background=(1, 0.5, 0.25))
    params = mi.traverse(mi.load_file(str(tmp_path / "scene.xml")))
    assert [key.removeprefix("refgs.") for key in params.keys() if key.startswith("refgs.")] == [*CHANNELS, "light"]
    anonymous = f'<scene version="3.0.0"><integrator type="refgs"><string name="filename" value="{tmp_path}/surfels.ply"/>'
    params = mi.traverse(mi.load_string(anonymous + "</integrator></scene>"))
    assert "refgs.roughness" in params and "refgs.light" not in params


def test_background_is_under_alpha(tmp_path: Path) -> None:
    run_folder(tmp_path)
    transparent = image(mi.load_file(str(tmp_path / "scene.xml")))
    run_folder(tmp_path, background=(1, 0.5, 0.25))
    opaque = image(mi.load_file(str(tmp_path / "scene.xml")))
    assert np.all(opaque[..., 3] == 1)
    expected = transparent[..., :3] + (1 - transparent[..., 3:]) * np.array([1, 0.5, 0.25])
    np.testing.assert_allclose(opaque[..., :3], expected, atol=1e-6)


def test_light_of_the_scene_equals_own_light(tmp_path: Path) -> None:
    EnvironmentLight.from_radiance(sky()).write(tmp_path / "sky.exr")
    turn = mi.ScalarTransform4f().rotate([0.6, 0.8, 0], 70)
    for transform in (mi.ScalarTransform4f(), turn):
        emitter = {"type": "envmap", "filename": str(tmp_path / "sky.exr"), "scale": 2.0, "to_world": transform}
        nested = image(scene(light=emitter))
        channels = integrator()
        del channels["light"]
        outside = mi.load_dict({"type": "scene", "integrator": channels, "sensor": sensor(), "sky": emitter})
        np.testing.assert_allclose(image(outside), nested, atol=1e-5)
    assert np.abs(nested - image(scene())).max() > 0.05


def test_turned_light_turns_with_the_scene(tmp_path: Path) -> None:
    """Rotating the light, the surfels' SH-free part and the camera together changes nothing."""
    EnvironmentLight.from_radiance(sky(32)).write(tmp_path / "sky.exr")
    turn = mi.ScalarTransform4f().rotate([0, 1, 0], 90)  # a quarter turn about the pole moves whole columns
    raw = {name: values for name, values in raw_channels().items() if name not in ("radiance_sh", "indirect_sh")}
    quaternion = np.array([0, np.sqrt(0.5), 0, np.sqrt(0.5)])
    matrix = np.array(turn.matrix)[:3, :3]
    turned = dict(raw, position=(raw["position"] @ matrix.T).astype(np.float32))
    x, y, z, w = raw["rotation"].T
    a, b, c, d = quaternion
    turned["rotation"] = np.stack(
        [d * x + a * w + b * z - c * y, d * y - a * z + b * w + c * x, d * z + a * y - b * x + c * w, d * w - a * x - b * y - c * z], 1
    ).astype(np.float32)  # fmt: skip
    emitter = {"type": "envmap", "filename": str(tmp_path / "sky.exr")}
    before = image(scene(raw=raw, light=emitter))
    moved = sensor(to_world=turn @ sensor()["to_world"])
    after = image(scene(moved, raw=turned, light=dict(emitter, to_world=turn)))
    np.testing.assert_allclose(after, before, atol=2e-4)
    assert np.abs(image(scene(moved, raw=turned, light=emitter)) - before).max() > 0.02


def test_constant_emitters() -> None:
    channels = integrator()
    del channels["light"]
    emitter = {"type": "constant", "radiance": {"type": "rgb", "value": [0.5, 1.0, 2.0]}}
    own = image(scene(light=emitter))
    outside = mi.load_dict({"type": "scene", "integrator": channels, "sensor": sensor(), "sky": emitter})
    np.testing.assert_allclose(image(outside), own, rtol=1e-3, atol=1e-4)
    assert mi.traverse(scene(light=emitter))["integrator.light"].shape[2] == 3


def test_terms_add_up_and_radiance_needs_no_light() -> None:
    parts = [image(scene(terms=term)) for term in ("diffuse", "specular", "indirect")]
    np.testing.assert_allclose(sum(parts), image(scene()), atol=1e-5)
    assert parts[0].max() > 0.1 and parts[1].max() > 0.01
    channels = integrator(reflectance="radiance")
    del channels["light"]
    bare = mi.load_dict({"type": "scene", "integrator": channels, "sensor": sensor()})
    assert image(bare).max() > 0.1


def test_shapes_of_the_scene_are_not_rendered() -> None:
    ball = {"type": "sphere", "radius": 2.0}
    both = mi.load_dict({"type": "scene", "integrator": integrator(), "sensor": sensor(), "ball": ball})
    np.testing.assert_array_equal(image(both), image(scene()))


# ---------------- derivatives ----------------


@pytest.fixture
def smooth(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the declared discontinuity at α = 1/255, central differences of the whole renderer have a meaning."""
    monkeypatch.setattr(footprint, "ALPHA_MIN", 1e-8)


def check_derivatives(of: mi.Scene, key: str, spp: int = 1) -> None:
    """Forward mode against central differences of mi.render, and reverse mode against forward mode."""
    rng = np.random.default_rng(3)
    params = mi.traverse(of)
    base = params[key].numpy().copy()  # a view: the parameter is about to be overwritten in place
    v = (rng.uniform(0.5, 1, base.shape) * rng.choice([-1, 1], base.shape)).astype(np.float32)

    def at(t: object) -> mi.TensorXf:
        params[key] = mi.TensorXf(base) + t * mi.TensorXf(v)
        params.update()
        return mi.render(of, params, spp=spp)

    t = mi.Float(0)
    dr.enable_grad(t)
    rendered = at(t)
    dr.set_grad(t, 1)
    tangent = dr.forward_to(rendered).numpy()
    errors = []
    for step in STEPS:
        difference = (at(mi.Float(step)).numpy() - at(mi.Float(-step)).numpy()) / (2 * step)
        errors.append(np.linalg.norm(tangent - difference) / np.linalg.norm(difference))
    assert np.linalg.norm(difference) > 1e-3, f"{key}: no influence on the image"
    assert min(errors) < TANGENT_TOLERANCE, f"{key}: {min(errors):.1e} from central differences"
    print("ERR", key, errors)

    leaf = mi.TensorXf(base)
    dr.enable_grad(leaf)
    params[key] = leaf
    params.update()
    weight = rng.normal(size=tangent.shape).astype(np.float32)
    dr.backward(dr.sum(mi.render(of, params, spp=spp) * mi.TensorXf(weight), axis=None))
    reverse, forward = np.sum(dr.grad(leaf).numpy() * v), np.sum(weight * tangent)
    print("DOT", abs(reverse - forward) / (np.linalg.norm(weight) * np.linalg.norm(tangent)))
    assert abs(reverse - forward) < 1e-5 * np.linalg.norm(weight) * np.linalg.norm(tangent)


@pytest.mark.parametrize("key", [*(name for name in CHANNELS if name != "indirect_sh"), "light"])
def test_derivatives_of_every_channel(key: str, smooth: None) -> None:
    check_derivatives(scene(), f"integrator.{key}")


@pytest.mark.parametrize("key", ["position", "albedo", "light"])
def test_derivatives_with_irradiance_and_supersampling(key: str, smooth: None) -> None:
    of = scene(diffuse="irradiance", aovs="nn:normal,d:depth,a:albedo")
    check_derivatives(of, f"integrator.{key}", spp=4)


@pytest.mark.parametrize("key", ["rotation", "metallic", "light"])
def test_derivatives_when_shading_at_surfels(key: str, smooth: None) -> None:
    check_derivatives(scene(shade_at="surfel"), f"integrator.{key}")


@pytest.mark.parametrize("key", ["indirect_sh", "opacity"])
def test_derivatives_with_occlusion(key: str, smooth: None, tmp_path: Path) -> None:
    of = scene(mesh=plane_mesh(tmp_path))
    check_derivatives(of, f"integrator.{key}")


def test_indirect_light_trains_from_zero(tmp_path: Path) -> None:
    raw = raw_channels()
    raw["indirect_sh"] *= 0
    of = scene(raw=raw, mesh=plane_mesh(tmp_path))
    params = mi.traverse(of)
    leaf = params["integrator.indirect_sh"]
    dr.enable_grad(leaf)
    dr.backward(dr.sum(mi.render(of, params), axis=None))
    assert np.abs(dr.grad(leaf).numpy()).max() > 1e-3


def test_derivatives_of_the_scenes_environment(tmp_path: Path) -> None:
    EnvironmentLight.from_radiance(sky()).write(tmp_path / "sky.exr")
    channels = integrator()
    del channels["light"]
    emitter = {"type": "envmap", "filename": str(tmp_path / "sky.exr")}
    of = mi.load_dict({"type": "scene", "integrator": channels, "sensor": sensor(), "sky": emitter})
    check_derivatives(of, "sky.data")


def test_gradients_reach_what_a_parameter_is_made_from() -> None:
    """θ → params → image → loss, as in Mitsuba's tutorials; and an optimiser's step lowers the loss."""
    of = scene()
    params = mi.traverse(of)
    target = mi.render(of) * 0.5
    optimizer = mi.ad.Adam(lr=0.05)
    optimizer["gain"] = mi.Float(1)
    base = mi.TensorXf(params["integrator.radiance_sh"])
    losses = []
    for _ in range(4):
        params["integrator.radiance_sh"] = base * optimizer["gain"]
        params.update()
        loss = dr.mean(dr.square(mi.render(of, params) - target), axis=None)
        dr.backward(loss)
        assert abs(dr.grad(optimizer["gain"])[0]) > 0
        optimizer.step()
        losses.append(float(loss.array[0]))
    assert losses[-1] < losses[0]
    assert not dr.grad_enabled(mi.render(of))


# ---------------- parameters ----------------


def test_surfel_count_may_change() -> None:
    of, other = scene(), raw_channels(COUNT + 9, seed=5)
    params = mi.traverse(of)
    tensors = {name: params[f"integrator.{name}"] for name in CHANNELS}
    for name, values in other.items():
        params[f"integrator.{name}"] = mi.TensorXf(values)
    params.update()
    np.testing.assert_array_equal(image(of), image(scene(raw=other)))
    assert of.integrator().surfels.count == COUNT + 9
    assert all(of.integrator().surfels.raw[name] is tensor for name, tensor in tensors.items())


@pytest.mark.parametrize(
    ("key", "shape", "words"),
    [
        ("position", (3, 3), "rotation: shape"),
        ("rotation", (COUNT, 3), "rotation: 3 columns"),
        ("opacity", (COUNT,), "opacity: shape"),
        ("radiance_sh", (COUNT, 10), "radiance_sh: 10 columns"),
        ("light", (8, 8, 3), "light: shape"),
    ],
)
def test_wrong_shapes_are_refused(key: str, shape: tuple[int, ...], words: str) -> None:
    params = mi.traverse(scene())
    params[f"integrator.{key}"] = dr.zeros(mi.TensorXf, shape)
    with pytest.raises(Exception, match=words):
        params.update()


# ---------------- AOVs, films, sensors ----------------

EVERY_AOV = (
    "al:albedo,m:metallic,r:roughness,n:normal,dd.y:depth,a:alpha,v:visibility,di:diffuse,sp:specular,ind:indirect"
)


def test_aovs_follow_mitsubas_names(tmp_path: Path) -> None:
    of = scene(sensor(film={"pixel_format": "rgba"}), aovs=EVERY_AOV, mesh=plane_mesh(tmp_path))
    names = ["al.R", "al.G", "al.B", "m.Y", "r.Y", "n.X", "n.Y", "n.Z", "dd.y.T", "a.Y", "v.Y"]
    names += [f"{term}.{c}" for term in ("di", "sp", "ind") for c in "RGB"]
    assert of.integrator().aov_names() == names
    result = image(of)
    assert result.shape == (HEIGHT, WIDTH, 4 + len(names))
    rgb, alpha, aov = result[..., :3], result[..., 3], dict(zip(names, np.moveaxis(result[..., 4:], 2, 0), strict=True))
    np.testing.assert_array_equal(aov["a.Y"], alpha)
    for i, c in enumerate("RGB"):
        np.testing.assert_allclose(aov[f"di.{c}"] + aov[f"sp.{c}"] + aov[f"ind.{c}"], rgb[..., i], atol=1e-6)
    seen = alpha > 0.01
    assert seen.any() and not seen.all()
    length = sum(aov[f"n.{c}"] ** 2 for c in "XYZ")
    np.testing.assert_allclose(length[seen], 1, atol=1e-5)
    assert 0 < aov["v.Y"][seen].mean() < 1 and aov["ind.R"].max() > 0
    assert np.all((aov["r.Y"][seen] > 0) & (aov["r.Y"][seen] < 1))
    assert all(np.all(values[alpha == 0] == 0) for values in aov.values())
    # The film holds the same picture, in layers.
    layers = dict(of.sensors()[0].film().bitmap().split())
    assert set(layers) == {"<root>", "al", "m", "r", "n", "dd.y", "a", "v", "di", "sp", "ind"}
    assert np.allclose(np.array(layers["n"]), np.stack([aov[f"n.{c}"] for c in "XYZ"], -1), atol=1e-3)  # float16 film


def test_depth_is_that_of_mitsuba() -> None:
    """One large opaque disc against a rectangle in the same plane under Mitsuba's own `aov` integrator."""
    raw = {
        "position": [[0, 0, 0]],
        "rotation": [[0, 0, 0, 1]],
        "scale": np.log([[50.0, 50.0]]),
        "opacity": [[9.0]],
        "radiance_sh": [[1.0, 1.0, 1.0]],
    }
    view = sensor(near_clip=0.5, film={"width": 5, "height": 5})
    channels = {name: mi.TensorXf(np.array(values, np.float32)) for name, values in raw.items()}
    ours = {"type": "refgs", "aovs": "d:depth", **channels}
    plate = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(100)}
    stock = mi.load_dict(
        {"type": "scene", "integrator": {"type": "aov", "aovs": "d:depth"}, "sensor": view, "plate": plate}
    )
    reference = image(stock, spp=4096)[..., 0]
    depth = image(mi.load_dict({"type": "scene", "integrator": ours, "sensor": view}), spp=64)[..., 3]
    np.testing.assert_allclose(depth, reference, rtol=1e-2)  # the noise of the reference's jitter


def test_supersampling_is_a_box_filter_over_pixel_centres() -> None:
    fine = image(scene(sensor(film={"width": 3 * WIDTH, "height": 3 * HEIGHT})))
    mean = fine.reshape(HEIGHT, 3, WIDTH, 3, 3).mean((1, 3))
    of = scene()
    for spp in (5, 9):
        np.testing.assert_allclose(image(of, spp=spp), mean, atol=2e-5)
    np.testing.assert_array_equal(image(of), image(of, spp=1, seed=7))
    assert np.abs(image(of) - mean).max() > 1e-3


def test_crop_window_is_part_of_the_whole() -> None:
    crop = {"crop_offset_x": 3, "crop_offset_y": 2, "crop_width": 9, "crop_height": 7}
    part = scene(sensor(film=crop))
    np.testing.assert_allclose(image(part), image(scene())[2:9, 3:12], atol=2e-5)
    assert list(part.sensors()[0].film().bitmap().size()) == [9, 7]


def test_principal_point_moves_the_image() -> None:
    moved = image(scene(sensor(principal_point_offset_x=2 / WIDTH, principal_point_offset_y=1 / HEIGHT)))
    still = image(scene())
    shifts = [np.abs(np.roll(still, (dy, dx), (0, 1)) - moved)[2:-2, 3:-3].max() for dx in (-2, 2) for dy in (-1, 1)]
    assert min(shifts) < 2e-5


def test_film_writes_and_luminance_films_work(tmp_path: Path) -> None:
    of = scene()
    result = image(of)
    of.sensors()[0].film().write(str(tmp_path / "out.exr"))
    written = np.array(mi.Bitmap(str(tmp_path / "out.exr")))
    np.testing.assert_allclose(written, result, atol=2e-3)  # float16 film
    grey = image(scene(sensor(film={"pixel_format": "luminance"})))
    np.testing.assert_allclose(grey[..., 0], result @ [0.212671, 0.71516, 0.072169], atol=1e-4)


@pytest.mark.parametrize("kind", ["thinlens", "orthographic"])
def test_other_sensors_are_refused(kind: str) -> None:
    camera = sensor(type=kind)
    if kind == "thinlens":
        camera |= {"aperture_radius": 0.1, "focus_distance": 3.0}
    else:
        del camera["fov"]
    refused("use a `perspective` sensor", lambda: image(scene(camera)))


# ---------------- refusals ----------------


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"shade_at": "voxel"}, "shade_at: 'voxel' is unknown"),
        ({"reflectance": "phong"}, "reflectance: 'phong'"),
        ({"terms": "diffuse,caustic"}, "terms: 'caustic'"),
        ({"aovs": "normal"}, "<name>:<type>"),
        ({"aovs": "a:colour"}, "unknown type 'colour'"),
        ({"aovs": "a:depth,a:normal"}, "occurs twice"),
        ({"occlusion": True}, "no mesh"),
        ({"mesh": "nowhere.ply"}, "nowhere.ply: mesh: no such file"),
        ({"filename": "nowhere.ply"}, "nowhere.ply: file: cannot be read"),
        ({"light": {"type": "point"}}, "not a PointLight"),
        ({"max_depth": 3}, "unreferenced property"),
    ],
)
def test_bad_properties_are_refused(changes: dict, words: str) -> None:
    with pytest.raises(Exception, match=words):
        mi.load_dict(integrator(**changes))


def test_missing_channels_are_refused() -> None:
    raw = raw_channels()
    del raw["roughness"]
    with pytest.raises(Exception, match="roughness: the surfels have no such channel"):
        mi.load_dict(integrator(raw, reflectance="split_sum"))
    with pytest.raises(Exception, match="there are no surfels"):
        mi.load_dict({"type": "refgs"})
    channels = integrator()
    del channels["light"]
    dark = mi.load_dict({"type": "scene", "integrator": channels, "sensor": sensor()})
    refused("light: there is none", lambda: image(dark))


def test_nesting_in_stock_integrators_is_refused() -> None:
    nested = {"type": "aov", "aovs": "d:depth", "inner": integrator()}
    outer = mi.load_dict({"type": "scene", "integrator": nested, "sensor": sensor()})
    refused("whole images only", lambda: image(outer))


def test_mirrored_cameras_cannot_be_exported(tmp_path: Path) -> None:
    camera = Camera.look(8, 8, 10, -10, 4, 4, np.eye(4))
    with pytest.raises(InputError, match="fx, fy"):
        write_scene_xml(tmp_path / "scene.xml", ply="a.ply", shading=Shading(), camera=camera)
    good = Camera.look(8, 8, -10, -10, 4, 4, np.eye(4))
    with pytest.raises(InputError, match="cannot be written"):
        write_scene_xml(tmp_path / "no" / "scene.xml", ply="a.ply", shading=Shading(), camera=good)


# ---------------- variants ----------------


def test_variants() -> None:
    of = scene()
    before = image(of)
    mi.set_variant("scalar_rgb")
    with pytest.raises(Exception, match="'scalar_rgb' is not supported"):
        mi.load_dict({"type": "refgs"})
    mi.set_variant("llvm_ad_rgb")
    np.testing.assert_array_equal(image(scene()), before)
