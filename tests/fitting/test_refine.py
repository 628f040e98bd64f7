"""Edits of a set of surfels: parents of the rows, what changes, and what must not."""

from __future__ import annotations

import dataclasses

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_refgs.errors import InputError
from mi_refgs.fitting import refine
from mi_refgs.fitting.optim import Adam, Group
from mi_refgs.methods.method import Propagation, Refine
from mi_refgs.methods.window import Window
from mi_refgs.surfels.attributes import logit, sigmoid
from mi_refgs.surfels.table import Surfels

OPTIONS = Refine()


def table(count: int = 6, scale: float = 0.005, opacity: float = 0.8) -> Surfels:
    rng = np.random.default_rng(0)
    return Surfels.from_numpy(
        {
            "position": rng.normal(size=(count, 3)),
            "rotation": rng.normal(size=(count, 4)),
            "scale": np.full((count, 2), np.log(scale)),
            "opacity": np.full((count, 1), logit(opacity)),
            "metallic": np.full((count, 1), logit(0.5)),
            "roughness": np.full((count, 1), logit(0.05)),
            "albedo": rng.normal(size=(count, 3)),
        }
    )


def densify(
    surfels: Surfels,
    error: np.ndarray,
    most: int = 100,
    largest: float = 0.1,
    options: Refine = OPTIONS,
    faint: np.ndarray = refine.NO_ROWS,
) -> refine.TableEdit:
    return refine.densify_and_prune(surfels, error, faint, largest, options, most)


def test_surfels_with_the_largest_error_are_split() -> None:
    """As many as an event may add, or as there is room for; those without error stay as they are."""
    surfels, error = table(8), np.array([0, 3.0, 1, 0, 2, 0, 5, 4])
    assert densify(surfels, error).parent.tolist() == [0, 1, 2, 3, 4, 5, *(6, 7), *(6, 7)]
    assert densify(surfels, error, most=9).parent.tolist() == [0, 1, 2, 3, 4, 5, 7, 6, 6]
    assert densify(surfels, error, most=8).parent.tolist() == [*range(8)]
    every = densify(surfels, error, options=dataclasses.replace(OPTIONS, grow=1.0))
    assert every.parent.tolist() == [0, 3, 5, *(1, 2, 4, 6, 7), *(1, 2, 4, 6, 7)]
    assert every.fresh.tolist() == [False] * 3 + [True] * 10
    for name in ("metallic", "roughness", "albedo", "rotation"):
        values = every.surfels.to_numpy()[name]
        assert np.array_equal(values, surfels.to_numpy()[name][every.parent]), name


def test_children_lie_on_the_longest_axis_of_their_parent() -> None:
    surfels = table(2).to_numpy()
    surfels["scale"] = np.log([[0.02, 0.01], [0.01, 0.02]])
    whole = Surfels.from_numpy(surfels)
    children = densify(whole, np.ones(2), options=dataclasses.replace(OPTIONS, grow=1.0)).surfels.to_numpy()
    axes = np.array(whole.frame()).transpose(2, 0, 1)
    along = 0.02 * refine.SPLIT_OFFSET * np.stack([axes[0, 0], axes[1, 1]])
    np.testing.assert_allclose(
        children["position"] - surfels["position"][[0, 1, 0, 1]], [*along, *-along], atol=1e-6
    )
    shrunk = np.exp(children["scale"] - surfels["scale"][[0, 1, 0, 1]])
    np.testing.assert_allclose(shrunk, [[refine.SPLIT_SCALE, 1], [1, refine.SPLIT_SCALE]] * 2, rtol=1e-5)


@pytest.mark.parametrize("opacity, most", [(0.3, 0.005), (0.9, 0.016), (0.99, 0.02)])
def test_split_hardly_changes_the_profile(opacity: float, most: float) -> None:
    """Both children composited, along the axis of the split, and on a line beside it."""
    x = np.linspace(-5, 5, 1001)
    child = refine.split_opacity(np.array([opacity]))[0]
    for aside in (1.0, np.exp(-0.5)):
        parent = opacity * aside * np.exp(-(x**2) / 2)
        first, second = (
            child * aside * np.exp(-((x - side * refine.SPLIT_OFFSET) ** 2) / (2 * refine.SPLIT_SCALE**2))
            for side in (-1, 1)
        )
        both = first + second - first * second
        assert np.sum((both - parent) ** 2) < 1.5 * most * np.sum(parent**2)


def test_no_child_is_too_transparent_to_stay() -> None:
    """It would be removed at the next event; while removal waits for a reset, it is split."""
    surfels, error = table(opacity=0.06), np.ones(6)
    assert densify(surfels, error).parent.tolist() == [*range(6)]
    assert len(densify(surfels, error, options=dataclasses.replace(OPTIONS, prune_opacity=0.0)).parent) == 8


def test_faint_surfels_make_room_for_splits() -> None:
    """As many as splits need, the first ones first."""
    options = dataclasses.replace(OPTIONS, grow=0.5)  # three of six
    for most, kept in ((9, [0, 1, 2, 3, 4, 5]), (8, [0, 1, 2, 3, 5]), (7, [0, 2, 3, 5]), (6, [0, 2, 3, 5])):
        edited = densify(table(), np.zeros(6), most, options=options, faint=np.array([4, 1]))
        assert edited.parent.tolist() == kept, most
    assert densify(table(), np.zeros(6), 6).parent.tolist() == [*range(6)]


def test_least_weight_is_counted_per_tile_up_to_a_share_of_it() -> None:
    weight = np.array([0.4, 0, 3, 0.4, 1, 0.2])
    for share, found in ((0, [1]), (0.05, [1, 5]), (0.13, [1, 5, 0]), (0.21, [1, 5, 0, 3])):
        assert refine.least_weight(weight, np.ones(6), share).tolist() == found, share
    cost = np.array([1, 0, 100, 1, 20, 1])
    for share, found in ((0.5, [1]), (0.65, [1, 2]), (0.82, [1, 2, 4]), (0.85, [1, 2, 4, 5])):
        assert refine.least_weight(weight, cost, share).tolist() == found, share


def test_ordered_rows_keep_their_values_and_parents() -> None:
    edited = densify(table(40), np.where(np.arange(40) % 3, 0, 1e-3))
    ordered = edited.ordered()
    before, after = (table.surfels.to_numpy()["position"] for table in (edited, ordered))
    place = [int(np.flatnonzero((before == position).all(axis=1))[0]) for position in after]
    assert edited.parent[place].tolist() == ordered.parent.tolist()
    assert edited.fresh[place].tolist() == ordered.fresh.tolist()
    assert sorted(place) == list(range(len(edited.parent))) != place
    for name, values in ordered.surfels.to_numpy().items():
        assert np.array_equal(values, edited.surfels.to_numpy()[name][place]), name


def test_transparent_and_oversized_surfels_go_even_when_hot() -> None:
    raw = table().to_numpy()
    raw["opacity"][0] = logit(0.01)
    raw["scale"][1] = np.log(0.5)
    edited = densify(Surfels.from_numpy(raw), np.full(6, 1e-3))
    assert sorted(set(edited.parent.tolist())) == [2, 3, 4, 5]


def test_opacities_get_time_to_grow_back_after_reset() -> None:
    surfels = table(opacity=0.02)
    waiting = dataclasses.replace(OPTIONS, prune_opacity=0.0)
    assert len(densify(surfels, np.zeros(6), options=waiting).parent) == 6
    with pytest.raises(InputError, match=r"refine\.prune_opacity"):
        densify(surfels, np.zeros(6))


def test_wait_follows_rate_that_lifts_opacities() -> None:
    """As many steps as Adam needs under a constant gradient, times the patience; 150 as shipped."""
    options, rate = Refine(), 0.05
    params = {"opacity": mi.TensorXf(np.full((1, 1), logit(options.reset_opacity), np.float32))}
    optimiser = Adam(params, {"opacity": Group(rate)})
    steps = 0
    while sigmoid(params["opacity"].numpy())[0, 0] < options.prune_opacity:
        dr.set_grad(params["opacity"], -1e-6)
        optimiser.step(steps)
        steps += 1
    wait = refine.prune_wait(options, rate)
    assert wait == pytest.approx(refine.PRUNE_PATIENCE * steps, rel=0.05) == pytest.approx(150, rel=0.02)
    assert refine.prune_wait(options, rate / 2) == pytest.approx(2 * wait)
    raised = dataclasses.replace(options, prune_opacity=options.reset_opacity)
    assert refine.prune_wait(raised, rate) == 0 and refine.prune_wait(options, 0.0) == np.inf


def test_reset_lowers_opacity_and_lifts_metallic_only() -> None:
    surfels = table()
    edited = refine.reset_opacity(surfels, OPTIONS, {"metallic": 0.6}).to_numpy()
    np.testing.assert_allclose(sigmoid(edited["opacity"]), OPTIONS.reset_opacity, rtol=1e-5)
    np.testing.assert_allclose(sigmoid(edited["metallic"]), 0.6, rtol=1e-5)
    assert np.array_equal(edited["scale"], surfels.to_numpy()["scale"])


@pytest.mark.parametrize("limit", [0.1, None])
def test_propagation_is_material_aware(limit: float | None, rng: np.random.Generator) -> None:
    """Metals grow, with a limit only smooth ones [Ref-Gaussian §3.4; 3DGS-DR]; all surfels become opaque, and
    the colour of what is no metal noisy."""
    raw = table().to_numpy() | {"radiance_sh": np.zeros((6, 12), np.float32)}
    raw["metallic"][0] = logit(0.01)  # no metal
    raw["roughness"][1] = logit(0.5)  # a rough metal
    raw["opacity"][2] = logit(0.95)  # opaque already
    options = Propagation(Window(0, 1, 1), roughness=limit, noise=0.4)
    edited = refine.propagate_normals(Surfels.from_numpy(raw), options, rng).to_numpy()
    grown = np.exp(edited["scale"] - raw["scale"])[:, 0]
    np.testing.assert_allclose(grown, [1, 1 if limit else 1.5, 1.5, 1.5, 1.5, 1.5], rtol=1e-5)
    np.testing.assert_allclose(sigmoid(edited["opacity"])[:, 0], [0.9, 0.9, 0.95, 0.9, 0.9, 0.9], rtol=1e-5)
    noise = edited["radiance_sh"]
    assert np.all(noise[:, 3:] == 0) and np.all(noise[1:] == 0)
    assert np.all(noise[0, :3] != 0) and np.abs(noise).max() <= 0.4


def test_restart_of_materials_leaves_geometry() -> None:
    surfels = table()
    starts = {"albedo": 0.5, "metallic": 0.01, "roughness": 0.1}
    edited = refine.restart(surfels, starts, np.random.default_rng(0)).to_numpy()
    np.testing.assert_allclose(sigmoid(edited["metallic"]), 0.01, rtol=1e-5)
    np.testing.assert_allclose(sigmoid(edited["roughness"]), 0.1, rtol=1e-5)
    assert np.abs(sigmoid(edited["albedo"]) - 0.5).max() <= 0.025 + 1e-6
    for name in ("position", "rotation", "scale", "opacity"):
        assert np.array_equal(edited[name], surfels.to_numpy()[name])
