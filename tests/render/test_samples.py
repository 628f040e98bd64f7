"""Several samples per pixel: frames and metrics against means made by NumPy."""

from __future__ import annotations

from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_refgs import methods
from mi_refgs.data import dataset
from mi_refgs.errors import InputError
from mi_refgs.evaluation import metrics
from mi_refgs.evaluation.evaluate import evaluate
from mi_refgs.io.images import srgb_from_linear
from mi_refgs.plugins.aovs import AOV, aov_values
from mi_refgs.reference.camera import look_at
from mi_refgs.render.pipeline import Frame
from mi_refgs.render.samples import supersampled
from mi_refgs.render.surroundings import Surroundings
from mi_refgs.runs.export import export
from mi_refgs.runs.run import Run
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.shading import Shading
from mi_refgs.splat import Camera
from mi_refgs.surfels.table import Surfels
from tests.scenes.integrator import (
    HEIGHT,
    WIDTH,
    background_light,
    far_channels,
    open_scene,
    raw_channels,
    scene,
    sensor,
    sky,
)
from tests.scenes.tiny import SETTINGS, SIZE, write_data, write_method

POSE = look_at(np.array([0.5, 1.5, 3.0]), np.zeros(3), up=(0, 1, 0))


def camera(factor: int = 1) -> Camera:
    """A view of few pixels, each divided into factor² of its own."""
    size, focal = (WIDTH * factor, HEIGHT * factor), 20.0 * factor
    return Camera.from_pose(*size, -focal, -focal, size[0] / 2, 0.45 * size[1], POSE)


def planes(value: object, factor: int = 1) -> np.ndarray:
    """(H, W, C) in float64."""
    flat = np.array(value, np.float64).reshape(-1, WIDTH * HEIGHT * factor**2)
    return flat.T.reshape(HEIGHT * factor, WIDTH * factor, -1)


def block_means(values: np.ndarray, factor: int) -> np.ndarray:
    return values.reshape(HEIGHT, factor, WIDTH, factor, -1).mean((1, 3))


@pytest.mark.parametrize("samples, factor, at", [(2, 2, "surfel"), (9, 3, "pixel")])
def test_a_pixel_is_the_mean_of_its_samples(samples: int, factor: int, at: str) -> None:
    """Radiance, terms, normals and alpha as they are; depth and maps by alpha."""
    shading = Shading(at=at, diffuse="irradiance")  # type: ignore[arg-type]
    light = EnvironmentLight.from_radiance(sky())
    made = TrainedScene(Surfels.from_numpy(raw_channels()), light, None, shading, 1, 0.0)
    frame, fine = made.renderer(samples=samples)(camera()), made.renderer()(camera(factor))

    alpha = planes(fine.alpha, factor)
    coverage = block_means(alpha, factor)
    assert 0.2 < np.mean((coverage > 0.01) & (coverage < 0.99))  # borders, where the weights matter
    np.testing.assert_allclose(planes(frame.alpha), coverage, atol=1e-6)
    assert frame.terms is not None and fine.terms is not None
    pairs = [(frame.radiance, fine.radiance), (frame.normal, fine.normal)]
    pairs += [(getattr(frame.terms, n), getattr(fine.terms, n)) for n in ("diffuse", "specular")]
    for mean, parts in pairs:
        np.testing.assert_allclose(planes(mean), block_means(planes(parts, factor), factor), atol=2e-6)
    for mean, parts in [(frame.depth, fine.depth), *((frame.maps[n], fine.maps[n]) for n in fine.maps)]:
        weighted = block_means(planes(parts, factor) * alpha, factor)
        expected = np.where(coverage > 1e-3, weighted / np.maximum(coverage, 1e-3), planes(mean))
        np.testing.assert_allclose(planes(mean), expected, atol=1e-4)
    assert {"albedo", "roughness", "metallic"} <= fine.maps.keys()


def test_one_sample_is_the_pixel_centre_and_none_is_refused() -> None:
    frame = Frame(mi.Float(1), mi.Float(1), None, mi.Color3f(1))
    assert supersampled(lambda _: frame, camera(), 1) is frame
    with pytest.raises(InputError, match="samples: 0"):
        supersampled(lambda _: frame, camera(), 0)


def test_eval_encodes_the_mean_of_linear_radiance(tmp_path: Path) -> None:
    """PSNR with 2 × 2 samples is that of srgb(mean L / mean A), not of the mean of encoded samples."""
    data, run = write_data(tmp_path / "ball"), Run(tmp_path / "run")
    run.create(methods.load(str(write_method(tmp_path)), "quick", SETTINGS), str(data))
    views = dataset.read_dataset(data, "test")
    raw = raw_channels(200)  # neighbours that differ
    raw["radiance_sh"] = np.random.default_rng(1).normal(scale=10, size=raw["radiance_sh"].shape)
    raw["position"], raw["scale"] = raw["position"] / 2, raw["scale"] - 2
    made = TrainedScene(Surfels.from_numpy(raw), None, None, Shading("surfel", "radiance"), 1, 0.0)
    export(made, run.path, views.views[0].camera())
    once, result = evaluate(run), evaluate(run, samples=4)
    assert once["samples"] == 1 and result["samples"] == 4
    assert abs(once["psnr"] - result["psnr"]) > 1e-3
    scores, encoded_first = [], []
    for view in (view.load() for view in views.views):
        small = view.camera()
        large = small.supersampled(2)
        frame = made.renderer()(large)
        parts = np.array([*frame.radiance, frame.alpha], np.float64).reshape(4, SIZE, 2, SIZE, 2)

        def shown(radiance: np.ndarray, alpha: np.ndarray) -> np.ndarray:
            colour = srgb_from_linear(radiance / np.maximum(alpha, 1e-6))
            return alpha * colour + (1 - alpha) * views.background[:, None, None]

        mean = parts.mean((2, 4))
        scores.append(metrics.psnr(shown(mean[:3], mean[3]).transpose(1, 2, 0), view.image))
        each = [shown(parts[:3, :, i, :, j], parts[3, :, i, :, j]) for i in (0, 1) for j in (0, 1)]
        encoded_first.append(metrics.psnr(np.mean(each, axis=0).transpose(1, 2, 0), view.image))
    assert result["psnr"] == pytest.approx(np.mean(scores), abs=1e-4)
    assert abs(np.mean(encoded_first) - np.mean(scores)) > 1e-3


@pytest.mark.parametrize("spp, at, around", [(4, "pixel", False), (9, "surfel", False), (4, "pixel", True)])
def test_aovs_of_several_samples_are_premultiplied_means_divided_once(
    spp: int, at: str, around: bool
) -> None:
    """Against means in float64 of the samples' own AOVs; the plugin and the renderer of a run agree."""
    kinds = ["albedo", "metallic", "roughness", "normal", "depth", "alpha", "visibility", "diffuse"]
    options = {"shade_at": at, "aovs": ",".join(f"{kind}:{kind}" for kind in kinds)}
    raw = raw_channels()
    raw["scale"] -= 0.7  # of sharp outlines
    raw["opacity"] += 5
    of = (open_scene if around else scene)(sensor(film={"pixel_format": "rgba"}), raw=raw, **options)
    eye, factor = Camera.from_sensor(of.sensors()[0]), round(spp**0.5)
    fine_eye = eye.supersampled(factor)
    surfels, light = Surfels.from_numpy(raw), EnvironmentLight.from_radiance(sky())
    beside = Surroundings(Surfels.from_numpy(far_channels()), background_light()) if around else None
    shading = Shading(at=at)  # type: ignore[arg-type]
    made = TrainedScene(surfels, light, None, shading, 1, 0.0, surroundings=beside)
    frame, fine = made.renderer(samples=spp)(eye), made.renderer()(fine_eye)

    image = mi.render(of, spp=spp).numpy().astype(np.float64)
    widths = [len(AOV(kind, kind).channels()) for kind in kinds]
    plugin = dict(zip(kinds, np.split(image[..., 4:], np.cumsum(widths)[:-1], axis=-1), strict=True))
    samples = {kind: planes(wide(aov_values(kind, fine, fine_eye), factor), factor) for kind in kinds}
    alpha = samples["alpha"]
    own = planes(fine.object_alpha, factor)
    coverage, own_coverage = block_means(alpha, factor), block_means(own, factor)
    silhouettes = (own_coverage > 0.01) & (block_means((own < 1e-3) * 1.0, factor) > 0)
    assert np.mean(silhouettes) > 0.03

    def divided(values: np.ndarray, weight: np.ndarray) -> np.ndarray:
        total = block_means(weight, factor)
        return np.where(total > 1e-3, block_means(values * weight, factor) / np.maximum(total, 1e-3), 0)

    expected = {kind: divided(samples[kind], own) for kind in ("albedo", "metallic", "roughness")}
    expected["depth"] = divided(samples["depth"], alpha)
    expected["visibility"] = (own_coverage > 1e-3) * 1.0
    blended = block_means(planes(fine.normal, factor), factor)
    norm = np.linalg.norm(blended, axis=-1, keepdims=True)
    expected["normal"] = np.where(own_coverage > 1e-3, blended / np.maximum(norm, 1e-20), 0)
    expected |= {kind: block_means(samples[kind], factor) for kind in ("alpha", "diffuse")}
    clear = np.abs(coverage - 1e-3) > 1e-5  # of rounding at the floor
    for kind in kinds:
        np.testing.assert_allclose(plugin[kind] * clear, expected[kind] * clear, atol=2e-4, err_msg=kind)
        ours = planes(wide(aov_values(kind, frame, eye), 1))
        np.testing.assert_allclose(ours, plugin[kind], atol=1e-4, err_msg=kind)
    seen = own_coverage[..., 0] > 0.01
    np.testing.assert_allclose(np.linalg.norm(plugin["normal"], axis=-1)[seen], 1, atol=1e-5)

    through = planes(fine.radiance, factor)
    if around:
        through = through + (1 - alpha) * planes(fine.background, factor)
    np.testing.assert_allclose(image[..., :3], block_means(through, factor), atol=1e-5)


def wide(values: list[object], factor: int) -> mi.ArrayXf:
    """Planes of full width."""
    return mi.ArrayXf([value + dr.zeros(mi.Float, WIDTH * HEIGHT * factor**2) for value in values])
