"""Densification, pruning and propagation: parents of the rows, what changes, and what must not."""

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_refgs.errors import InputError
from mi_refgs.fitting.events import densify as event
from mi_refgs.fitting.events.densify import Densify
from mi_refgs.fitting.events.propagate import Propagate
from mi_refgs.fitting.events.resets import OPACITY, PATIENCE, ResetOpacity
from mi_refgs.fitting.optim import Adam, LearningRate
from mi_refgs.fitting.state import TableEdit
from mi_refgs.methods.fields import Window
from mi_refgs.surfels.attributes import logit, sigmoid
from mi_refgs.surfels.table import Surfels

OPTIONS = Densify(Window(0, 1, 1))


def table(count: int = 6, scale: float = 0.005, opacity: float = 0.8) -> Surfels:
    rng = np.random.default_rng(0)
    raw = {name: rng.normal(size=(count, n)) for name, n in (("position", 3), ("rotation", 4), ("albedo", 3))}
    for name, value in (("opacity", opacity), ("metallic", 0.5), ("roughness", 0.05)):
        raw[name] = np.full((count, 1), logit(value))
    return Surfels.from_numpy(raw | {"scale": np.full((count, 2), np.log(scale))})


def densify(surfels: Surfels, error: np.ndarray, most: int = 100, **given: Any) -> TableEdit:
    """With the options of the event, unless others are given."""
    options: dict[str, Any] = {"grow": OPTIONS.grow, "prune_opacity": OPTIONS.prune_opacity, "largest": 0.1}
    return event.densify_and_prune(surfels, error, most, **options | given)


def test_children_of_curved_surfels_turn_as_their_parents_do_there() -> None:
    rng, flat = np.random.default_rng(1), table(200, 0.05)
    raw = flat.to_numpy() | {"curvature": rng.normal(0, 5, (200, 3)).astype(np.float32)}
    raw["scale"] = np.log(rng.uniform(0.01, 0.05, (200, 2))).astype(np.float32)
    edit = densify(Surfels.from_numpy(raw), np.ones(200), 400, grow=1.0)
    parents, children = Surfels.from_numpy(raw).gather(mi.UInt32(edit.parent)), edit.surfels
    normal, now, longest = (
        np.array(x) for x in (parents.frame()[2], children.frame()[2], dr.detach(parents.scale()))
    )
    turns = [np.array(turn) for turn in parents.primitive.turns(parents, parents.frame()[2]).values()]
    turn = event.SPLIT_OFFSET * np.where(longest[0] > longest[1], *turns) * np.repeat([1, -1], 200)
    expected = normal + turn
    assert np.linalg.norm(turn, axis=0).max() > 0.1
    np.testing.assert_allclose(now, expected / np.linalg.norm(expected, axis=0), atol=2e-3)


def test_surfels_with_the_largest_error_are_split() -> None:
    """As many as an event may add, or as there is room for; those without error stay as they are."""
    surfels, error = table(8), np.array([0, 3.0, 1, 0, 2, 0, 5, 4])
    assert densify(surfels, error).parent.tolist() == [0, 1, 2, 3, 4, 5, *(6, 7), *(6, 7)]
    assert densify(surfels, error, most=9).parent.tolist() == [0, 1, 2, 3, 4, 5, 7, 6, 6]
    assert densify(surfels, error, most=8).parent.tolist() == [*range(8)]
    every = densify(surfels, error, grow=1.0)
    assert every.parent.tolist() == [0, 3, 5, *(1, 2, 4, 6, 7), *(1, 2, 4, 6, 7)]
    assert every.fresh.tolist() == [False] * 3 + [True] * 10
    for name in ("metallic", "roughness", "albedo", "rotation"):
        assert np.array_equal(every.surfels.to_numpy()[name], surfels.to_numpy()[name][every.parent]), name


def test_children_lie_on_the_longest_axis_of_their_parent() -> None:
    surfels = table(2).to_numpy()
    surfels["scale"] = np.log([[0.02, 0.01], [0.01, 0.02]])
    whole = Surfels.from_numpy(surfels)
    children = densify(whole, np.ones(2), grow=1.0).surfels.to_numpy()
    axes = np.array(whole.frame()).transpose(2, 0, 1)
    along = 0.02 * event.SPLIT_OFFSET * np.stack([axes[0, 0], axes[1, 1]])
    moved = children["position"] - surfels["position"][[0, 1, 0, 1]]
    np.testing.assert_allclose(moved, [*along, *-along], atol=1e-6)
    shrunk = np.exp(children["scale"] - surfels["scale"][[0, 1, 0, 1]])
    np.testing.assert_allclose(shrunk, [[event.SPLIT_SCALE, 1], [1, event.SPLIT_SCALE]] * 2, rtol=1e-5)


@pytest.mark.parametrize("opacity, most", [(0.3, 0.005), (0.9, 0.016), (0.99, 0.02)])
def test_split_hardly_changes_the_profile(opacity: float, most: float) -> None:
    """Both children composited, along the axis of the split, and on a line beside it."""
    x = np.linspace(-5, 5, 1001)
    child = event.split_opacity(np.array([opacity]))[0]
    for aside in (1.0, np.exp(-0.5)):
        parent = opacity * aside * np.exp(-(x**2) / 2)
        first, second = (
            child * aside * np.exp(-((x - side * event.SPLIT_OFFSET) ** 2) / (2 * event.SPLIT_SCALE**2))
            for side in (-1, 1)
        )
        both = first + second - first * second
        assert np.sum((both - parent) ** 2) < 1.5 * most * np.sum(parent**2)


def test_no_child_is_too_transparent_to_stay() -> None:
    """It would be removed at the next event; while removal waits for a reset, it is split."""
    surfels, error = table(opacity=0.06), np.ones(6)
    assert densify(surfels, error).parent.tolist() == [*range(6)]
    assert len(densify(surfels, error, prune_opacity=0.0).parent) == 8
    with pytest.raises(InputError, match="prune_opacity"):
        densify(table(opacity=0.02), np.zeros(6))


def test_faint_surfels_make_room_for_splits() -> None:
    """As many as splits need, the first ones first."""
    for most, kept in ((9, [0, 1, 2, 3, 4, 5]), (8, [0, 1, 2, 3, 5]), (7, [0, 2, 3, 5]), (6, [0, 2, 3, 5])):
        edited = densify(table(), np.zeros(6), most, grow=0.5, faint=np.array([4, 1]))  # three of six
        assert edited.parent.tolist() == kept, most
    assert densify(table(), np.zeros(6), 6).parent.tolist() == [*range(6)]


def test_least_weight_is_counted_per_tile_up_to_a_share_of_it() -> None:
    weight = np.array([0.4, 0, 3, 0.4, 1, 0.2])
    for share, found in ((0, [1]), (0.05, [1, 5]), (0.13, [1, 5, 0]), (0.21, [1, 5, 0, 3])):
        assert event.least_weight(weight, np.ones(6), share).tolist() == found, share
    cost = np.array([1, 0, 100, 1, 20, 1])
    for share, found in ((0.5, [1]), (0.65, [1, 2]), (0.82, [1, 2, 4]), (0.85, [1, 2, 4, 5])):
        assert event.least_weight(weight, cost, share).tolist() == found, share


def test_transparent_oversized_and_floating_surfels_go_even_when_hot() -> None:
    raw = table().to_numpy()
    raw["opacity"][0], raw["scale"][1] = logit(0.01), np.log(0.5)
    edited = densify(Surfels.from_numpy(raw), np.full(6, 1e-3), gone=np.array([5]))
    assert sorted(set(edited.parent.tolist())) == [2, 3, 4]


def test_wait_follows_rate_that_lifts_opacities() -> None:
    """As many steps as Adam needs under a constant gradient, times the patience; 150 as shipped."""
    rate, reset = 0.05, ResetOpacity(Window(0, 10, 10))
    params = {"opacity": mi.TensorXf(np.full((1, 1), logit(OPACITY), np.float32))}
    optimiser = Adam(params, {"opacity": LearningRate(rate)})
    steps = 0
    while sigmoid(params["opacity"].numpy())[0, 0] < OPTIONS.prune_opacity:
        dr.set_grad(params["opacity"], -1e-6)
        optimiser.step(steps)
        steps += 1

    def wait(opacity: float, rate: float) -> int:
        return next(i for i in range(11, 9_999) if reset.grown(i, opacity, rate)) - 10

    shipped = wait(OPTIONS.prune_opacity, rate)
    assert shipped == pytest.approx(PATIENCE * steps, rel=0.05) == pytest.approx(150, rel=0.02)
    assert wait(OPTIONS.prune_opacity, rate / 2) == pytest.approx(2 * shipped, abs=1)
    assert wait(OPACITY, rate) == 1 and reset.grown(10, OPTIONS.prune_opacity, rate)
    assert not reset.grown(10**6, OPTIONS.prune_opacity, 0.0)


@pytest.mark.parametrize("limit", [0.1, None])
def test_propagation_is_material_aware(limit: float | None, rng: np.random.Generator) -> None:
    """Metals grow, with a limit only smooth ones [Ref-Gaussian §3.4; 3DGS-DR]; all surfels become opaque, and
    the colour of what is no metal noisy."""
    raw = table().to_numpy() | {"radiance_sh": np.zeros((6, 12), np.float32)}
    raw["metallic"][0] = logit(0.01)  # no metal
    raw["roughness"][1] = logit(0.5)  # a rough metal
    raw["opacity"][2] = logit(0.95)  # opaque already
    options = Propagate(Window(0, 1, 1), roughness=limit, noise=0.4)
    edited = options.propagated(Surfels.from_numpy(raw), rng).to_numpy()
    grown = np.exp(edited["scale"] - raw["scale"])[:, 0]
    np.testing.assert_allclose(grown, [1, 1 if limit else 1.5, 1.5, 1.5, 1.5, 1.5], rtol=1e-5)
    np.testing.assert_allclose(sigmoid(edited["opacity"])[:, 0], [0.9, 0.9, 0.95, 0.9, 0.9, 0.9], rtol=1e-5)
    noise = edited["radiance_sh"]
    assert np.all(noise[:, 3:] == 0) and np.all(noise[1:] == 0)
    assert np.all(noise[0, :3] != 0) and np.abs(noise).max() <= 0.4
