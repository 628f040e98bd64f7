"""Every edit of the table: who descends from whom, what changes, what must not."""

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
    surfels: Surfels, gradient: np.ndarray, max_count: int = 100, extent: float = 1.0
) -> refine.TableEdit:
    return refine.densify_and_prune(surfels, gradient, extent, OPTIONS, max_count, np.random.default_rng(1))


def test_small_hot_surfels_are_cloned_and_cold_ones_left_alone() -> None:
    surfels = table()
    edited = densify(surfels, np.array([0, 1e-3, 0, 0, 5e-4, 0]))
    assert edited.parent.tolist() == [0, 1, 2, 3, 4, 5, 1, 4]
    assert edited.fresh.tolist() == [False] * 6 + [True] * 2
    for name, values in edited.surfels.to_numpy().items():
        assert np.array_equal(values, surfels.to_numpy()[name][edited.parent]), name


def test_large_hot_surfels_are_split_within_their_own_plane() -> None:
    surfels = table(scale=0.05)
    edited = densify(surfels, np.array([0, 1e-3, 0, 0, 0, 0]))
    assert edited.parent.tolist() == [0, 2, 3, 4, 5, 1, 1]
    raw, children = surfels.to_numpy(), edited.surfels.to_numpy()
    shrunk = np.exp(children["scale"][5:] - raw["scale"][[1, 1]])
    np.testing.assert_allclose(shrunk, 1 / refine.SPLIT_SHRINK, rtol=1e-5)
    normal = np.array(surfels.frame()[2]).T[1]
    offsets = children["position"][5:] - raw["position"][1]
    assert np.abs(offsets @ normal).max() < 1e-6
    assert 0 < np.abs(offsets).max() < 6 * 0.05


def test_ordered_rows_keep_their_values_and_parents() -> None:
    edited = densify(table(40), np.where(np.arange(40) % 3, 0, 1e-3))
    ordered = edited.ordered()
    place = [
        np.flatnonzero((edited.parent == p) & (edited.fresh == f))[0]
        for p, f in zip(ordered.parent, ordered.fresh, strict=True)
    ]
    assert sorted(place) == list(range(len(edited.parent))) != place
    for name, values in ordered.surfels.to_numpy().items():
        assert np.array_equal(values, edited.surfels.to_numpy()[name][place]), name


def test_transparent_and_oversized_surfels_go_even_when_hot() -> None:
    raw = table().to_numpy()
    raw["opacity"][0] = logit(0.01)
    raw["scale"][1] = np.log(0.5)
    edited = densify(Surfels.from_numpy(raw), np.full(6, 1e-3))
    assert sorted(set(edited.parent.tolist())) == [2, 3, 4, 5]


def test_sizes_are_shares_of_scene() -> None:
    """In any unit the same surfels are cloned, split and dropped."""
    gradient, sizes = np.array([1e-3, 1e-3, 1e-3, 0, 0, 0]), np.array([0.005, 0.05, 0.5, 0.005, 0.05, 0.5])
    parents = []
    for unit in (1e-3, 1.0, 1e3):
        raw = table().to_numpy()
        raw["scale"] = np.log(unit * sizes)[:, None] + np.zeros((1, 2))
        parents.append(densify(Surfels.from_numpy(raw), gradient, extent=unit).parent.tolist())
    assert parents == [[0, 3, 4, 0, 1, 1]] * 3


def test_opacities_get_time_to_grow_back_after_reset() -> None:
    surfels = table(opacity=0.02)
    limits = (np.zeros(6), 1.0, OPTIONS, 100, np.random.default_rng(1))
    assert len(refine.densify_and_prune(surfels, *limits, prune_transparent=False).parent) == 6
    with pytest.raises(InputError, match=r"refine\.prune_opacity"):
        refine.densify_and_prune(surfels, *limits)


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


@pytest.mark.parametrize("scale", [0.005, 0.05])
def test_growth_stops_at_limit_and_takes_hottest(scale: float) -> None:
    edited = densify(table(scale=scale), np.array([3, 9, 4, 8, 5, 7]) * 1e-3, max_count=8)
    assert len(edited.parent) == 8
    assert np.flatnonzero(np.bincount(edited.parent) == 2).tolist() == [1, 3]


def test_reset_lowers_opacity_and_lifts_metallic_only() -> None:
    surfels = table()
    edited = refine.reset_opacity(surfels, OPTIONS, {"metallic": 0.6}).to_numpy()
    np.testing.assert_allclose(sigmoid(edited["opacity"]), OPTIONS.reset_opacity, rtol=1e-5)
    np.testing.assert_allclose(sigmoid(edited["metallic"]), 0.6, rtol=1e-5)
    assert np.array_equal(edited["scale"], surfels.to_numpy()["scale"])


PROPAGATION = Propagation(Window(0, 1, 1), roughness=0.1)


def test_propagation_is_material_aware(rng: np.random.Generator) -> None:
    """Only metallic and smooth surfels grow; all become opaque. [Ref-Gaussian §3.4]"""
    raw = table().to_numpy()
    raw["metallic"][0] = logit(0.01)  # no metal
    raw["roughness"][1] = logit(0.5)  # a rough metal
    raw["opacity"][2] = logit(0.95)  # opaque already
    edited = refine.propagate_normals(Surfels.from_numpy(raw), PROPAGATION, rng).to_numpy()
    grown = np.exp(edited["scale"] - raw["scale"])[:, 0]
    np.testing.assert_allclose(grown, [1, 1, 1.5, 1.5, 1.5, 1.5], rtol=1e-5)
    np.testing.assert_allclose(sigmoid(edited["opacity"])[:, 0], [0.9, 0.9, 0.95, 0.9, 0.9, 0.9], rtol=1e-5)


def test_propagation_without_limit_of_roughness_grows_every_metal(rng: np.random.Generator) -> None:
    """3DGS-DR's rule: whatever the roughness; and noise on the colour of what is no metal alone."""
    raw = table().to_numpy() | {"radiance_sh": np.zeros((6, 12), np.float32)}
    raw["metallic"][:2] = logit(0.01)
    raw["roughness"][2] = logit(0.9)
    options = dataclasses.replace(PROPAGATION, roughness=None, noise=0.4)
    edited = refine.propagate_normals(Surfels.from_numpy(raw), options, rng).to_numpy()
    grown = np.exp(edited["scale"] - raw["scale"])[:, 0]
    np.testing.assert_allclose(grown, [1, 1, 1.5, 1.5, 1.5, 1.5], rtol=1e-5)
    noise = edited["radiance_sh"]
    assert np.all(noise[:, 3:] == 0) and np.all(noise[2:] == 0)
    assert np.all(noise[:2, :3] != 0) and np.abs(noise).max() <= 0.4


def test_restart_of_materials_leaves_geometry() -> None:
    surfels = table()
    starts = {"albedo": 0.5, "metallic": 0.01, "roughness": 0.1}
    edited = refine.restart(surfels, starts, np.random.default_rng(0)).to_numpy()
    np.testing.assert_allclose(sigmoid(edited["metallic"]), 0.01, rtol=1e-5)
    np.testing.assert_allclose(sigmoid(edited["roughness"]), 0.1, rtol=1e-5)
    assert np.abs(sigmoid(edited["albedo"]) - 0.5).max() <= 0.025 + 1e-6
    for name in ("position", "rotation", "scale", "opacity"):
        assert np.array_equal(edited[name], surfels.to_numpy()[name])
