"""Images in passes: the same as in one, with the same derivatives, kernels and less at a time."""

from collections import Counter
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_refgs.occlusion.mesh import read_mesh
from mi_refgs.plugins import film
from mi_refgs.render import passes
from mi_refgs.render.surroundings import Surroundings
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.shading import Shading
from mi_refgs.splat.camera import Camera
from mi_refgs.surfels.table import Surfels
from tests.helpers import arrays_of, slow, with_grad
from tests.scenes import integrator as scenes

FEW = 512  # samples of a pass in these tests: two rows of pixels or more of 4 × 4 samples
SHADINGS = {
    "pixel": Shading(),
    "surfel": Shading(at="surfel"),
    "mirror rays": Shading(occlusion=True),
    "lobe rays": Shading(antialias=True, occlusion=True, visibility_rays=4, traced_bounces=1),
    "antialias": Shading(antialias=True),
    "antialiased rays": Shading(antialias=True, occlusion=True),
    "irradiance": Shading(diffuse="irradiance", occlusion=True, ambient_rays=8),
    "monte_carlo": Shading(at="surfel", reflectance="monte_carlo", occlusion=True),
}


def renderer(shading: Shading, samples: int, folder: Path, around: bool = False) -> Any:
    far, light = Surfels.from_numpy(scenes.far_channels()), EnvironmentLight.from_radiance(scenes.sky())
    beside = Surroundings(far, scenes.background_light()) if around else None
    mesh = read_mesh(Path(scenes.hollow_mesh(folder))) if shading.occlusion else None
    surfels = Surfels.from_numpy(scenes.raw_channels())
    return TrainedScene(surfels, light, mesh, shading, 1, 0.0, surroundings=beside).renderer(samples=samples)


@pytest.mark.parametrize("case", range(len(SHADINGS)))
def test_passes_are_the_whole_frame(case: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each shading with one or 16 samples, and every other two of them with surroundings."""
    name, samples = [*SHADINGS][case], (16, 1)[case % 2]
    view = renderer(SHADINGS[name], samples, tmp_path, around=case % 4 < 2)
    eye = Camera.from_sensor(mi.load_dict(scenes.sensor()))
    whole = arrays_of(view(eye))
    monkeypatch.setattr(passes, "PASS_SAMPLES", FEW if samples > 1 else 64)
    assert len(passes.bands(eye, round(samples**0.5), SHADINGS[name].neighbours)) > 1
    parts = arrays_of(view(eye))
    assert whole.keys() == parts.keys() and {"alpha", "radiance", "roughness"} <= parts.keys()
    for key, value in whole.items():
        np.testing.assert_allclose(parts[key], value, atol=2e-5, err_msg=key)


@pytest.mark.parametrize("case", range(len(SHADINGS)))
def test_a_crop_window_is_part_of_the_whole(case: int, tmp_path: Path) -> None:
    """With the random numbers of the whole, and the neighbours beside the window; 1 or 4 samples."""
    view = renderer([*SHADINGS.values()][case], (1, 4)[case % 2], tmp_path)
    crop = {"crop_offset_x": 5, "crop_offset_y": 2, "crop_width": 7, "crop_height": 6}
    cameras = (Camera.from_sensor(mi.load_dict(scenes.sensor(film=film))) for film in ({}, crop))
    whole, part = (arrays_of(view(camera)) for camera in cameras)
    for key, value in whole.items():
        if value.shape[-1] == scenes.HEIGHT * scenes.WIDTH:
            value = value.reshape(*value.shape[:-1], scenes.HEIGHT, scenes.WIDTH)[..., 2:8, 5:12]
            value = value.reshape(*value.shape[:-2], -1)
        np.testing.assert_allclose(part[key], value, atol=2e-5, err_msg=key)


def few(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(passes, "PASS_SAMPLES", FEW)
    monkeypatch.setattr(film, "DERIVATIVE_SAMPLES", FEW)


@pytest.mark.parametrize("kind", ["open", slow("surfel"), slow("antialias")])
def test_the_plugin_in_passes_and_its_derivatives_are_those_of_one(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In both modes, of parameters computed from others; on a film whose channels are not those rendered."""
    options: dict[str, Any] = {"aovs": "d:depth,n:normal,a:albedo", "mesh": scenes.plane_mesh(tmp_path)}
    camera = scenes.sensor(film={"pixel_format": "luminance_alpha" if kind == "surfel" else "rgb"})
    if kind == "surfel":
        of = scenes.scene(camera, aovs=options["aovs"], shade_at="surfel")
    else:
        make = scenes.open_scene if kind == "open" else scenes.scene
        of = make(camera, antialias=kind == "antialias", **options)
    params = mi.traverse(of)
    keys = ["integrator.position", "integrator.opacity", "integrator.albedo", "integrator.light"]
    start = {key: mi.TensorXf(params[key]) for key in keys}
    pose, angle = mi.Transform4f(params["sensor.to_world"]), mi.Float(params["sensor.x_fov"])
    rng = np.random.default_rng(5)
    moved = {key: mi.TensorXf(rng.normal(size=x.shape).astype(np.float32)) for key, x in start.items()}

    def rendered() -> tuple[mi.Float, mi.TensorXf]:
        amount = with_grad(mi.Float(0))
        for key in keys:
            params[key] = start[key] + moved[key] * amount
        move_sensor(amount)
        return amount, mi.render(of, params, spp=16)

    def move_sensor(amount: mi.Float) -> None:
        turned = mi.Transform4f().translate([amount, 0, 2 * amount]).rotate([0.6, 0.8, 0], 50 * amount)
        params["sensor.to_world"], params["sensor.x_fov"] = turned @ pose, angle + 10 * amount
        params.update()

    def derivatives() -> tuple[np.ndarray, ...]:
        amount, image = rendered()
        weight = np.random.default_rng(2).normal(size=image.shape).astype(np.float32)
        dr.backward(dr.sum(image * mi.TensorXf(weight), axis=None))
        shown = np.array(of.sensors()[0].film().bitmap())
        reverse = np.array(dr.grad(amount))
        leaf = with_grad({key: mi.TensorXf(value) for key, value in start.items()})
        for key, value in leaf.items():
            params[key] = value
        leaf["sensor"] = with_grad(mi.Float(0))
        move_sensor(leaf["sensor"])
        image_again = mi.render(of, params, spp=16)
        mi.render(of, integrator=mi.load_dict({"type": "path"}), spp=1)  # leaves fewer channels in the film
        dr.backward(dr.sum(image_again * mi.TensorXf(weight), axis=None))
        gradients = [np.array(dr.grad(value)) for value in leaf.values()]
        amount, again = rendered()
        dr.forward(amount)
        return (image.numpy(), shown, dr.grad(again).numpy(), reverse, *gradients)

    whole = derivatives()
    assert np.abs(whole[2]).max() > 1 and all(np.abs(value).max() > 1e-4 for value in whole[4:])
    few(monkeypatch)
    for i, (one, several) in enumerate(zip(whole, derivatives(), strict=True)):
        np.testing.assert_allclose(several, one, atol=3e-5 * np.abs(one).max(), err_msg=str(i))


def history(of: "mi.Scene", spp: int, backward: bool) -> list[dict[str, Any]]:
    """Kernels of a render."""
    params = mi.traverse(of)
    leaf = with_grad(mi.TensorXf(params["integrator.albedo"]))
    params["integrator.albedo"] = leaf
    params.update()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        image = mi.render(of, params, spp=spp)
        dr.eval(image)
        if backward:
            dr.kernel_history_clear()
            dr.backward(dr.sum(image, axis=None))
            dr.eval(dr.grad(leaf))
        return [dict(kernel) for kernel in dr.kernel_history([dr.KernelType.JIT])]


@pytest.mark.parametrize("backward", [False, True])
def test_passes_share_their_kernels_and_take_few_samples_at_a_time(
    backward: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    of = scenes.scene(scenes.sensor(film={"height": 16}))
    samples = 16 * scenes.WIDTH * 64
    assert max(kernel["size"] for kernel in history(of, 64, backward)) >= samples
    few(monkeypatch)
    count = len(passes.bands(Camera.from_sensor(of.sensors()[0]), 8))
    assert count == 16
    kernels = history(of, 64, backward)
    copies = 10  # operations of a kernel that uploads the levels of the light
    assert max(kernel["size"] for kernel in kernels if kernel["operation_count"] > copies) < samples / 2
    times = Counter(kernel["hash"] for kernel in kernels)
    assert len(times) < len(kernels) / count + 12
    assert sum(n % count == 0 for n in times.values()) > len(times) / 2


def test_bands_cover_every_row_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Equally high without neighbours; inside the image with them; one if it fits."""
    eye = Camera.look_at((0, 0, 3), up=(0, 1, 0), size=(30, 103))
    assert [band.size[1] for band in passes.bands(eye)] == [103]
    for factor, margin in ((1, 0), (1, 1), (2, 0), (3, 1), (8, 0)):
        found = passes.bands(eye, factor, margin, 30 * 24 * factor**2)
        assert sum(band.size[1] for band in found) == 103 and len(found) > 1
        top = 0
        for band in found:
            assert band.camera.offset[1] == top - band.first[1] and band.first in ((0, 0), (0, margin))
            assert band.camera.width * (band.camera.height - 2 * margin) * factor**2 <= 30 * 24 * factor**2
            top += band.size[1]
        heights = {band.camera.height for band in found}
        assert len(heights) == 1 if not margin else max(heights) <= 26
    assert scenes.HEIGHT < 103
    for x, y, width, height in ((20, 5, 40, 16), (-4, 5, 20, 16), (5, -4, 20, 16), (5, 95, 20, 16)):
        for margin in (0, 1):
            [band] = passes.bands(eye.window(x, y, width, height), margin=margin)
            seen, first = band.camera, band.first
            assert seen.offset == (x - first[0], y - first[1]) and min(first) >= 0 and max(first) <= margin
            assert seen.width >= first[0] + width == first[0] + band.size[0]
            assert seen.height >= first[1] + height == first[1] + band.size[1]
