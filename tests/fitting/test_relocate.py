"""Relocation: the image hardly changes, idle surfels move onto visible ones and take random steps."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_refgs.fitting import refine
from mi_refgs.methods.method import Relocation
from mi_refgs.methods.window import Window
from mi_refgs.reference import losses as reference
from mi_refgs.reference.camera import look_at
from mi_refgs.splat import Camera, splat
from mi_refgs.surfels.attributes import logit, sigmoid
from mi_refgs.surfels.table import Surfels

WHEN = Window(0, 10, 1)
IDLE = Relocation(WHEN, opacity=0.02)


def table(count: int, idle: int, rng: np.random.Generator, scale: float = 0.05) -> Surfels:
    """Surfels in a ball, the last of them idle."""
    opacity = np.concatenate([rng.uniform(0.1, 0.9, count - idle), np.full(idle, 0.01)])
    return Surfels.from_numpy(
        {
            "position": rng.uniform(-0.4, 0.4, (count, 3)),
            "rotation": rng.normal(size=(count, 4)),
            "scale": np.log(scale * rng.uniform(0.7, 1.4, (count, 2))),
            "opacity": logit(opacity)[:, None],
            "albedo": rng.normal(size=(count, 3)),
        }
    )


@pytest.mark.parametrize("opacity", [0.01, 0.3, 0.9])
@pytest.mark.parametrize("number", [1, 2, 5, 20])
def test_correction_is_that_of_paper(opacity: float, number: int) -> None:
    new, factor = refine.shared(np.array([0.5, opacity]), np.array([1, number]))
    expected = reference.relocated(opacity, number)
    np.testing.assert_allclose([new[1], factor[1]], expected, rtol=1e-9)
    np.testing.assert_allclose([new[0], factor[0]], [0.5, 1], rtol=1e-12)
    alone, together = (
        reference.line_integral(opacity, 1, 1.0),
        reference.line_integral(new[1], number, factor[1]),
    )
    assert together == pytest.approx(alone, rel=1e-6)


def test_idle_surfels_go_where_others_are_seen(rng: np.random.Generator) -> None:
    surfels = table(30, 6, rng)
    edit = refine.relocate(surfels, IDLE, 100, rng)
    before, after = surfels.to_numpy(), edit.surfels.to_numpy()
    moved = np.arange(24, 30)
    assert np.array_equal(edit.parent[:24], np.arange(24)) and np.all(edit.parent[moved] < 24)
    # Whatever shares a place has no history, the one that was there before neither.
    assert np.array_equal(edit.fresh, np.isin(edit.parent, edit.parent[moved]))
    for name in ("position", "rotation", "albedo"):
        assert np.array_equal(after[name], before[name][edit.parent]), name
    number = np.bincount(edit.parent, minlength=24)[edit.parent]
    for row in range(30):
        opacity = float(sigmoid(before["opacity"][edit.parent[row], 0]))
        new, factor = reference.relocated(opacity, int(number[row]))
        assert sigmoid(after["opacity"][row, 0]) == pytest.approx(new, rel=1e-4)
        size = before["scale"][edit.parent[row]] + np.log(factor)
        np.testing.assert_allclose(after["scale"][row], size, atol=1e-5)


def test_opaque_surfels_are_drawn_more_often(rng: np.random.Generator) -> None:
    raw = table(1000, 998, rng).to_numpy()
    raw["opacity"][:2, 0] = logit(np.array([0.2, 0.8]))
    edit = refine.relocate(Surfels.from_numpy(raw), IDLE, 1000, rng)
    assert np.mean(edit.parent[2:] == 1) == pytest.approx(0.8, abs=0.05)


def test_relocation_hardly_changes_image(rng: np.random.Generator) -> None:
    """A tenth of what the same copies without a correction change."""
    raw = table(400, 100, rng).to_numpy()
    raw["opacity"][300:] = -20  # idle ones cover nothing
    surfels = Surfels.from_numpy(raw)
    edit = refine.relocate(surfels, IDLE, 400, rng)
    copied = surfels.gather(mi.UInt32(edit.parent))
    camera = Camera.from_pose(64, 64, 90.0, 90.0, 32.0, 32.0, look_at(np.array([0, 0, 3.0]), np.zeros(3)))
    alpha = [np.array(splat(rows, [], camera).alpha) for rows in (surfels, edit.surfels, copied)]
    changed, uncorrected = (np.abs(other - alpha[0]).mean() for other in alpha[1:])
    assert alpha[0].mean() > 0.05
    assert changed < 0.02 * alpha[0].mean()
    assert changed < 0.2 * uncorrected


def test_table_grows_up_to_limit(rng: np.random.Generator) -> None:
    surfels = table(40, 0, rng)
    grow = Relocation(WHEN, grow=0.25)
    assert refine.relocate(surfels, grow, 100, rng).surfels.count == 50
    assert refine.relocate(surfels, grow, 43, rng).surfels.count == 43
    same = refine.relocate(surfels, IDLE, 100, rng)
    assert same.surfels is surfels and not same.fresh.any()


def test_all_idle_stay_where_they_are(rng: np.random.Generator) -> None:
    edit = refine.relocate(table(5, 5, rng), IDLE, 100, rng)
    assert edit.parent.tolist() == [0, 1, 2, 3, 4]


def test_only_transparent_surfels_take_random_steps_in_their_plane(rng: np.random.Generator) -> None:
    """Steps are η λ σ² / (1 + exp(100 (o - threshold))) of normal deviates along each tangent."""
    surfels = table(20_000, 10_000, rng)
    options, rate, extent = Relocation(WHEN, opacity=0.01, noise=100.0), 0.1, 2.0
    moved = refine.wander(surfels, rate, extent, options, 3, 0).numpy() - surfels.to_numpy()["position"]
    raw = surfels.to_numpy()
    axes, σ = surfels.primitive.extent(raw)
    normal = np.array(surfels.frame()[2]).T
    assert np.abs(np.sum(moved * normal, axis=1)).max() < 1e-6
    opacity = sigmoid(raw["opacity"][:, 0])
    wanted = rate * 100.0 / extent * σ**2 / (1 + np.exp(100 * (opacity - 0.01)))[:, None]
    deviates = np.einsum("nai,ni->na", axes, moved)[opacity < 0.2] / wanted[opacity < 0.2]
    np.testing.assert_allclose(deviates[:10_000].std(axis=0), 1, atol=0.1)
    np.testing.assert_allclose(deviates[-10_000:].mean(axis=0), 0, atol=0.05)
    assert abs(np.corrcoef(deviates[-10_000:].T)[0, 1]) < 0.05
    assert np.abs(moved[opacity > 0.5]).max() < 1e-9 * np.abs(moved).max() + 1e-7


def test_steps_follow_from_seed_and_iteration_and_scale_with_scene(rng: np.random.Generator) -> None:
    small = table(50, 50, rng)
    raw = small.to_numpy()
    large = Surfels.from_numpy(raw | {"position": 8 * raw["position"], "scale": raw["scale"] + np.log(8)})

    def step(surfels: Surfels, extent: float, iteration: int, seed: int) -> np.ndarray:
        moved = refine.wander(surfels, 0.1, extent, IDLE, iteration, seed).numpy()
        return moved - surfels.to_numpy()["position"]

    first = step(small, 1.0, 5, 0)
    assert np.array_equal(first, step(small, 1.0, 5, 0))
    assert not np.allclose(first, step(small, 1.0, 6, 0)) and not np.allclose(first, step(small, 1.0, 5, 1))
    np.testing.assert_allclose(step(large, 8.0, 5, 0), 8 * first, rtol=1e-3)
    misses = dr.detail.launch_stats()[2]
    step(small, 1.0, 7, 0)
    assert dr.detail.launch_stats()[2] == misses
