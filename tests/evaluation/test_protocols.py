"""Protocols of benchmarks: masks, scales and measures by hand, captions, refusals."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_args

import numpy as np
import pytest

from mi_refgs.cli.command import Protocol
from mi_refgs.cli.evaluate import benchmark_tables
from mi_refgs.evaluation import metrics, protocols
from mi_refgs.evaluation.protocols import PROTOCOLS, Maps, ProtocolScores
from tests.helpers import refused


def scores_of(name: str) -> ProtocolScores:
    """Scores of a benchmark, without a view."""
    measures = PROTOCOLS[name].measures
    assert measures is not None
    return ProtocolScores(measures)


def encoded(linear: float) -> float:
    """The curve of sRGB."""
    return 1.055 * linear ** (1 / 2.4) - 0.055


def half_covered(value: float, size: int = 20) -> np.ndarray:
    """RGBA (size, size, 4) whose left half has a radiance."""
    image = np.zeros((size, size, 4))
    image[:, : size // 2] = [value, value, value, 1]
    return image


# ---------- masks and scales ----------


def test_erosion_by_5_pixels_leaves_the_border_of_the_image() -> None:
    alpha = np.full((12, 12), 0.6)
    assert protocols.eroded(alpha).all() and not protocols.eroded(0.8 * alpha).any()
    alpha[6, 5] = 0.5
    hole = np.zeros((12, 12), bool)
    hole[4:9, 3:8] = True
    np.testing.assert_array_equal(protocols.eroded(alpha), ~hole)
    assert protocols.touched(np.array([0, 1e-3, 1])).tolist() == [False, True, True]


def test_least_squares_per_image_and_channel() -> None:
    """Σ gt·pred / Σ pred² = (1·2 + 2·4) / 5, (1·1 + 2·3) / 5; another image; a black one."""
    ours = [np.array([[1.0, 1], [2, 2]]), np.array([[2.0, 4]]), np.zeros((1, 2))]
    truth = [np.array([[2.0, 1], [4, 3]]), np.array([[1.0, 4]]), np.ones((1, 2))]
    np.testing.assert_allclose(protocols.least_squares(ours, truth), [[2.0, 1.4], [0.5, 1.0], [0.0, 0.0]])


def test_median_ratio_of_all_images() -> None:
    """Ratios 1, 2, 3 and 10 over two images: the lower one of the middle; predictions are at least 1e-6."""
    ours = [np.full((2, 3), 2.0), np.array([[1, 1, 0], [1, 1, 0.0]])]
    truth = [np.array([[2, 2, 2], [4, 4, 4.0]]), np.array([[3, 3, 1], [10, 10, 1.0]])]
    np.testing.assert_allclose(protocols.median_ratio(ours, truth), [[2, 2, 2]] * 2)
    np.testing.assert_allclose(protocols.median_ratio(ours[1:], truth[1:])[0, 2], 1e6)
    np.testing.assert_allclose(protocols.median_ratio([np.zeros((0, 3))], [np.zeros((0, 3))]), 1)


# ---------- images ----------


def test_psnr_h_and_psnr_l_over_the_whole_frame() -> None:
    """0.8 for 0.9 in the 8 of 20 columns that erosion leaves."""
    scores = scores_of("stanford-orb")
    scores.add(Maps(half_covered(0.8)), Maps(half_covered(0.9)))
    found = scores.result()
    lift = encoded(0.9) / 0.9
    assert found["psnr_h"] == pytest.approx(-10 * np.log10(0.4 * (0.1 * lift) ** 2))
    assert found["psnr_l"] == pytest.approx(-10 * np.log10(0.4 * (encoded(0.9) - encoded(0.8)) ** 2))


def test_clipped_ground_truth_has_no_psnr_h() -> None:
    """An image of 8 bits does not say how bright a highlight is."""
    scores = scores_of("stanford-orb")
    scores.add(Maps(half_covered(2.0)), Maps(half_covered(1.0), clipped=True))
    found = scores.result()
    assert found["psnr_h"] is None and "clipped at 1" in found["psnr_h_reason"] and found["psnr_l"] == 100
    assert "psnr_h" not in scores_of("tensoir").result()


def test_bright_pixels_are_clipped_at_4_and_1() -> None:
    ours, truth = half_covered(0.5), half_covered(0.5)
    truth[:, 0, :3], ours[:, 0, :3] = 100, 50
    found, _ = protocols.stanford_orb_images(ours, truth, truth[..., 3] > 0)
    assert found["psnr_h"] == found["psnr_l"] == 100
    ours[:, 0, :3] = 2  # 2 · lift, not 4; lift = Σ encoded / Σ linear = (9 encoded(½) + 1) / 5.5
    found, _ = protocols.stanford_orb_images(ours, truth, truth[..., 3] > 0)
    lift = (9 * encoded(0.5) + 1) / 5.5
    assert found["psnr_h"] == pytest.approx(-10 * np.log10((4 - 2 * lift) ** 2 / 20))
    assert found["psnr_l"] == 100


def test_psnr_is_at_least_that_of_grey() -> None:
    found, _ = protocols.stanford_orb_images(half_covered(0), half_covered(1), half_covered(1)[..., 3] > 0)
    assert found["psnr_h"] == pytest.approx(-10 * np.log10(0.5 * 0.25))
    assert found["psnr_l"] == pytest.approx(found["psnr_h"])


def test_black_ground_truth_is_not_divided_by() -> None:
    found, _ = protocols.stanford_orb_images(half_covered(0), half_covered(0), half_covered(1)[..., 3] > 0)
    assert found["psnr_h"] == found["psnr_l"] == 100


def test_ssim_of_3_pixels_mirrors_the_image(rng: np.random.Generator) -> None:
    """Brute force over padded windows."""
    x, y = rng.random((2, 6, 7, 3))
    side = np.exp(-0.5 * (np.arange(-1, 2) / 1.5) ** 2)
    weight = np.outer(side, side)[..., None] / side.sum() ** 2
    a, b = (np.pad(image, ((1, 1), (1, 1), (0, 0)), mode="reflect") for image in (x, y))
    values = []
    for i in range(6):
        for j in range(7):
            p, q = a[i : i + 3, j : j + 3], b[i : i + 3, j : j + 3]
            mean_p, mean_q = ((weight * part).sum((0, 1)) for part in (p, q))
            both = (weight * p * q).sum((0, 1)) - mean_p * mean_q
            spread = (weight * (p**2 + q**2)).sum((0, 1)) - mean_p**2 - mean_q**2
            means = (2 * mean_p * mean_q + 1e-4) / (mean_p**2 + mean_q**2 + 1e-4)
            values.append(means * (2 * both + 9e-4) / (spread + 9e-4))
    assert metrics.ssim(x, y, radius=1, border="mirror") == pytest.approx(np.mean(values))


def test_tensoir_images_are_over_white() -> None:
    """White for the half that is black in the ground truth; the background is equal."""
    ours, truth = half_covered(1), half_covered(0)
    found, shown = protocols.tensoir_images(ours, truth, truth[..., 3] > 0)
    assert found["psnr"] == pytest.approx(-10 * np.log10(0.5))
    assert found["ssim"] == pytest.approx(metrics.ssim(shown[0], shown[1], np.s_[5:-5, 5:-5]))
    assert np.allclose(shown[0], 1) and np.all(shown[1][:, 10:] == 1) and not shown[1][:, :10].any()


def test_lpips_has_the_network_and_images_of_the_benchmark(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stanford-ORB: VGG on images that are encoded twice; a failure is not repeated."""
    calls: list[tuple[float, str]] = []

    def lpips(image: np.ndarray, truth: np.ndarray, network: str) -> tuple[float | None, str]:
        calls.append((float(image[0, 0, 0]), network))
        return (0.25, "") if len(calls) < 3 else (None, "not installed")

    monkeypatch.setattr(metrics, "lpips", lpips)
    for name in ("stanford-orb", "tensoir"):
        scores = scores_of(name)
        scores.add(Maps(half_covered(0.3)), Maps(half_covered(0.3)))
        assert scores.result()["lpips"] == 0.25 and scores.result()["lpips_reason"] is None
    np.testing.assert_allclose([value for value, _ in calls], [encoded(encoded(0.3)), encoded(0.3)])
    assert [network for _, network in calls] == ["vgg", "alex"]
    scores = scores_of("tensoir")
    for _ in range(2):
        scores.add(Maps(half_covered(0.3)), Maps(half_covered(0.3)))
    assert scores.result()["lpips"] is None and scores.result()["lpips_reason"] == "not installed"
    assert len(calls) == 3


def test_relit_images_are_compared_after_the_scale_of_the_benchmark() -> None:
    """Two images, dark by 2 and by 4: a scale each, or one median; hence errors in one image."""
    truth = [half_covered(0.4), half_covered(0.4, 30)]
    ours = [half_covered(0.2), half_covered(0.1, 30)]
    measures = scores_of("stanford-orb").measures
    found = protocols.relit_scores(measures, ours, truth)
    np.testing.assert_allclose(found["factors"], [[2] * 3, [4] * 3])
    assert found["psnr_h"] == found["psnr_l"] == pytest.approx(100) and "normal_deg" not in found
    found = protocols.relit_scores(scores_of("tensoir").measures, ours, truth)
    np.testing.assert_allclose(found["factors"], [[4] * 3] * 2)
    error = (encoded(0.8) - encoded(0.4)) ** 2 / 2
    assert found["psnr"] == pytest.approx((-10 * np.log10(error) + 100) / 2)


# ---------- maps and surfaces ----------


def test_normals_over_the_mask_or_the_frame() -> None:
    """60° in the mask of 8 of 20 columns, or in 10 of them; pixels without ground truth are left out."""
    image = half_covered(0.5)
    truth = np.broadcast_to([0.0, 0, 1], (20, 20, 3)).copy()
    ours = np.broadcast_to([np.sin(np.pi / 3), 0, 0.5], (20, 20, 3))
    for name, factor in (("stanford-orb", 1), ("tensoir", 0.5)):
        scores = scores_of(name)
        scores.add(Maps(image, ours), Maps(image, truth))
        found = scores.result()
        assert found["normal_deg"] == pytest.approx(60 * factor)
        assert found["normal_cosine"] == pytest.approx(0.5 * factor)
    truth[:, :2] = 0
    scores.add(Maps(image, np.zeros_like(truth)), Maps(image, truth))  # no normal: 90° in 8 columns
    assert scores.result()["normal_deg"] == pytest.approx((30 + 0.4 * 90) / 2)


def test_views_with_an_empty_mask_are_left_out() -> None:
    """Four columns, which erosion removes."""
    image = half_covered(0.5)
    image[:, :6], thin = 0, half_covered(0.5)
    thin[:, 2:] = 0
    scores = scores_of("stanford-orb")
    scores.add(Maps(image), Maps(thin))
    assert scores.result() == {"lpips": None, "lpips_reason": None}


def test_depth_after_one_scale() -> None:
    """Scale (2 + 8 + 10) / 9; errors over frames of 4 and 2 pixels."""
    ours, truth = [np.array([1.0, 2]), np.array([2.0])], [np.array([2.0, 4]), np.array([5.0])]
    expected = ((20 / 9 - 2) ** 2 + (40 / 9 - 4) ** 2) / 4, (40 / 9 - 5) ** 2 / 2
    assert metrics.depth_si_mse(ours, truth, [4, 2]) == pytest.approx(1e3 * np.mean(expected))
    assert metrics.depth_si_mse([3 * depth for depth in truth], truth, [4, 2]) == pytest.approx(0)


def test_depth_inside_of_the_mask() -> None:
    image, depth = half_covered(0.5), np.full((20, 20), 2.0)
    wrong = np.where(np.arange(20) < 8, depth, 9)  # beyond the eroded mask
    scores = scores_of("stanford-orb")
    scores.add(Maps(image, depth=3 * wrong), Maps(image, depth=depth))
    assert scores.result()["depth_si_mse"] == pytest.approx(0, abs=1e-9)


def test_squared_chamfer_distance() -> None:
    """(1 + 2) / 2 in one direction and 1 in the other."""
    ours, truth = np.array([[0.0, 0, 0], [1, 0, 0]]), np.array([[0.0, 0, 1]])
    assert metrics.squared_chamfer(ours, truth) == metrics.squared_chamfer(truth, ours) == 2500


def test_albedo_after_the_scale_of_the_benchmark() -> None:
    """0.2 and 0.4 for 0.4 and 0.4; the median ratio of both images is 1."""
    ours, truth = np.repeat([[0.2], [0.4]], 3, axis=1), np.full((2, 3), 0.4)
    scale = (0.08 + 0.16) / (0.04 + 0.16)
    error = ((0.2 * scale - 0.4) ** 2 + (0.4 * scale - 0.4) ** 2) / 10  # of a frame of 10 pixels
    grey = 2 * 0.1**2 / 10
    assert error > grey  # so ½ is better
    found = protocols.stanford_orb_albedo([ours, truth], [truth, truth], [10, 10])
    assert found == pytest.approx((-10 * np.log10(grey) + 100) / 2)
    dark = protocols.stanford_orb_albedo([ours / 4], [truth / 4], [10])
    assert dark == pytest.approx(-10 * np.log10(error / 16))
    error = (0.2 ** (1 / 2.2) - 0.4 ** (1 / 2.2)) ** 2 / 20
    assert protocols.tensoir_albedo([ours, truth], [truth, truth], [10, 10]) == pytest.approx(
        -10 * np.log10(error)
    )


def test_albedo_is_compared_where_it_is_known() -> None:
    image, albedo = half_covered(0.5), np.full((20, 20, 3), 0.3)
    truth = np.dstack([albedo, np.arange(400).reshape(20, 20) % 20 < 4])
    scores = scores_of("tensoir")
    scores.add(Maps(image, albedo=np.where(truth[..., 3:] > 0, albedo, 0.9)), Maps(image, albedo=truth))
    assert scores.result()["albedo_psnr"] == 100


# ---------- captions and refusals ----------


def test_tables_have_captions() -> None:
    """Scale, mask and frame, and why a number is missing."""
    found: dict[str, Any] = {"protocols": protocols.captions("stanford-orb", (30, 20))}
    assert found["protocols"].keys() == {"ours", "stanford-orb"}
    found["protocols"]["stanford-orb"] |= {"psnr_h": 21.5, "lpips": None, "lpips_reason": "gone"}
    text = "\n".join(benchmark_tables(found))
    for line in ("protocol stanford-orb", "scale: ", "mask:  ", "frame: whole image of 30 × 20 pixels"):
        assert f"\n{line}" in text
    assert "PSNR-H                     21.50 dB" in text and "not measured: " in text and "(gone)" in text
    assert benchmark_tables({"protocols": protocols.captions("ours", (30, 20))}) == []
    for protocol in PROTOCOLS.values():
        assert protocol.caption((3, 2), relit=True)["scale"] != protocol.caption((3, 2), relit=False)["scale"]


def test_unknown_protocols_and_images_without_alpha_are_refused() -> None:
    opaque: Any = SimpleNamespace(path=Path("photographs"), views=[SimpleNamespace(has_alpha=False)])
    refused(lambda: protocols.measures_of("orb", None), "--protocol: orb", "stanford-orb, tensoir")
    refused(lambda: protocols.measures_of("tensoir", opaque), "photographs: alpha", "give RGBA")
    assert protocols.measures_of("ours", opaque) is None


def test_the_command_line_offers_every_protocol() -> None:
    choices, _ = get_args(Protocol)
    assert get_args(choices) == tuple(PROTOCOLS)
