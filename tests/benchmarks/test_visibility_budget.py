"""The error budget of visibility: the ends of its chains, and parts that vanish with their cause."""

from __future__ import annotations

import itertools
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import trimesh

from benchmarks.common.errors import Step
from benchmarks.common.view import Look
from benchmarks.visibility import budget
from benchmarks.visibility.cases import PAPER, SMALL, Concave, Rule, make_scene
from benchmarks.visibility.measure import DEPTHS
from benchmarks.visibility.setup import Setup
from mi_refgs.shade.points import reflect
from mi_refgs.shade.sh import sh_basis

TINY = replace(SMALL, size=16, lattice=233, limit=128)
WHITE = (1.0, 1.0, 1.0)


def box() -> Concave:
    """A convex object whose vertex normals are those of its faces: nothing meets itself."""
    corners = trimesh.creation.box((1.2, 1.0, 0.8)).triangles.reshape(-1, 3)
    mesh = trimesh.Trimesh(corners, np.arange(36).reshape(-1, 3), process=False)
    for _ in range(2):
        mesh = mesh.subdivide()
    return Concave("box", mesh, Look((1.5, 1.6, 3.2), (0, 0, 0), 31))


def references(setup: Setup) -> dict[str, np.ndarray]:
    return {name: setup.reference(depth) for name, depth in DEPTHS.items()}


def parts_of(setup: Setup, roughness: float) -> dict[str, dict[str, float]]:
    """relMSE of every part and of the whole, by kind of indirect light."""
    setup.material(roughness)
    rows = budget.budgets(setup, roughness, references(setup), DEPTHS["full"])
    return {
        row["indirect"]: {"total": row["total"], **{part["name"]: part["relmse"] for part in row["parts"]}}
        for row in rows
    }


@pytest.fixture(scope="module")
def plates() -> Setup:
    mi.set_variant("llvm_ad_rgb")
    setup = Setup(make_scene("plates", 0), TINY)
    setup.material(0.3)
    return setup


@pytest.fixture(scope="module")
def studio(plates: Setup) -> dict[str, dict[str, float]]:
    """Two plates under the studio's light, where everything has an error."""
    return parts_of(plates, 0.3)


# ---------- The chains ----------


def random_chains(rng: np.random.Generator) -> list[list[Step]]:
    """Decompose images that have nothing to do with one another."""

    def image() -> np.ndarray:
        return rng.uniform(0.1, 1, (50, 3))

    def light() -> budget.mc.Estimate:
        return budget.mc.Estimate(image(), 0.01 * image())

    exact = budget.Exact(image(), light(), light(), light())
    shipped = budget.Shipped(image(), image(), image())
    fitted = budget.FittedHarmonics(image(), image(), (image(), image()))
    traced = budget.Traced(image(), image(), image())
    return [budget.by_harmonics(shipped, exact, fitted), budget.by_tracing(shipped, exact, traced)]


def test_both_chains_end_with_the_path_tracer(rng: np.random.Generator) -> None:
    """At the path tracer's image, and the last two parts are the same."""
    first, second = random_chains(rng)
    for a, b in zip(first[-3:], second[-3:], strict=True):
        np.testing.assert_array_equal(a.values, b.values)


def test_chains_begin_with_the_shipped_image(plates: Setup) -> None:
    """The paper's rule is V L S + (1 - V) I S; the end is Mitsuba's image but for noise."""
    batches = references(plates)
    fitted = budget.fit(plates, DEPTHS["full"])
    exact = budget.exact_light(plates, batches)
    visibility = np.array(plates.seen(plates.points, PAPER).visibility)[:, None]
    free = plates.image(Rule(0))
    wanted = visibility * free + (1 - visibility) * fitted.mirror * budget.reflectance(plates)
    np.testing.assert_allclose(plates.image(PAPER, fitted.mirror), wanted, atol=2e-5)
    path = budget.mc.estimate(batches["full"])
    score = (exact.whole - path.mean) / np.hypot(path.error, exact.direct.error)
    assert np.sqrt(np.mean(score**2)) < 1.5
    assert abs((exact.whole - path.mean).mean()) < 0.01 * path.mean.mean()
    assert 0.2 < visibility.mean() < 0.8


# ---------- Parts without a cause ----------


def test_equal_images_have_no_error(rng: np.random.Generator) -> None:
    """A lobe as free as its mirror ray, light as it is fitted and traced, a split sum as its integral:
    every part is nothing; and the input that then is off is its own part alone."""
    visibility = (rng.uniform(0, 1, (50, 1)) < 0.5) * np.ones(3)
    free, scale, sh, other = (rng.uniform(0.1, 1, (50, 3)) for _ in range(4))
    blocked = (1 - visibility) * scale * sh
    whole = visibility * free + blocked

    def light(values: np.ndarray) -> budget.mc.Estimate:
        return budget.mc.Estimate(values, np.zeros_like(values))

    exact = budget.Exact(visibility, light(free), light(visibility * free), light(blocked))
    shipped = budget.Shipped(free, scale, whole)
    fitted = budget.FittedHarmonics(sh, blocked, (sh, sh))
    traced = budget.Traced(whole, whole, blocked)
    cases = {
        (): (shipped, exact, traced),
        (budget.MIRROR,): (replace(shipped, paper=other), exact, traced),
        (budget.RAY,): (shipped, exact, replace(traced, ray=other)),
        (budget.HIT, budget.FURTHER): (shipped, exact, replace(traced, indirect=other)),
        (budget.APART,): (shipped, replace(exact, direct=light(other)), traced),
    }
    for off, (images, lit, seen) in cases.items():
        for steps in (budget.by_harmonics(images, lit, fitted), budget.by_tracing(images, lit, seen)):
            for before, after in itertools.pairwise(steps):
                distance = np.abs(before.values - after.values).max()
                assert (distance > 0.1) == (after.replaced in off), (off, after.replaced)
                assert distance > 0.1 or distance < 1e-12


def test_without_occlusion_only_the_split_sum_errs() -> None:
    """A convex object: no visibility and no indirect light has an error, exactly; the split sum has."""
    for found in parts_of(Setup(box(), TINY), 0.3).values():
        assert found.pop(budget.SPLIT) == pytest.approx(found.pop("total")) and found
        assert all(value == 0 for value in found.values()), found


def test_white_furnace_has_no_error(studio: dict[str, dict[str, float]]) -> None:
    """In a white furnace a plate reflects what the light would send, which SH can represent."""
    furnace = parts_of(Setup(make_scene("plates", 0), TINY, "constant", WHITE), 0.1)["harmonics"]
    assert furnace["total"] < 5e-4 < 0.03 < studio["harmonics"]["total"], furnace
    for name in (budget.MIRROR, budget.DIRECTION, budget.HARMONICS):
        assert furnace[name] < 5e-4 < 1e-3 < studio["harmonics"][name], (name, furnace)


def test_constant_light_separates_from_visibility() -> None:
    """Visibility times light averages as the product of averages where the light is constant."""
    found = parts_of(Setup(make_scene("plates", 0), TINY, "constant"), 0.3)["harmonics"]
    assert max(found[budget.APART], found[budget.SPLIT]) < 1e-5 < 1e-3 < found[budget.MIRROR]


# ---------- Spherical harmonics ----------


def directions(rng: np.random.Generator, points: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Random directions (P, D, 3) of the upper hemisphere, and the basis there (P, D, K)."""
    d = rng.normal(size=(points, count, 3))
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    d[..., 2] = np.abs(d[..., 2])
    basis = sh_basis(mi.Vector3f(np.ascontiguousarray(d.reshape(-1, 3).T, np.float32)), budget.DEGREE)
    columns = [np.broadcast_to(np.array(y, np.float64), points * count) for y in basis]
    return d, np.stack(columns, -1).reshape(points, count, -1)


def test_sh_radiance_is_recovered(rng: np.random.Generator) -> None:
    """From blocked directions alone: values in free ones are nonsense. And a constant is a constant."""
    d, basis = directions(rng, 5, 4000)
    wanted = rng.normal(size=(5, basis.shape[-1], 3)) * 0.1
    wanted[:, 0] = 5
    blocked = d[..., 0] < 0.6
    radiance = np.where(blocked[..., None], basis @ wanted, 1e3)
    found = basis @ budget.solve([budget.sums(basis, radiance, blocked)])
    truth = basis @ wanted
    assert np.sqrt(np.mean((found - truth)[blocked] ** 2)) < 0.01 * truth.mean()
    nothing = budget.sums(basis, radiance, np.zeros_like(blocked))
    np.testing.assert_array_equal(budget.solve([nothing]), 0)


def test_sh_integrated_over_the_lobe_equals_radiance(plates: Setup) -> None:
    """A constant one gives its radiance times the lobe; a tilted one, along the mirror, what `along` says."""
    count = plates.points.count
    coefficients = np.zeros((count, 16, 3))
    coefficients[:, 0] = np.linspace(1, 2, count)[:, None] * np.array([1, 2, 3])
    constant = np.sqrt(1 / (4 * np.pi)) * coefficients[:, 0]
    lobe = plates.reflected(plates.constant, None).mean(0)
    found = plates.reflected(budget.HarmonicsEmitter(coefficients), None).mean(0)
    np.testing.assert_allclose(found, constant * lobe, rtol=5e-3)
    coefficients[:, 2] = 0.5
    mirror = reflect(plates.points.view, plates.points.normal)
    along = np.array(budget.along(coefficients, mirror)).T
    tilt = 0.5 * np.sqrt(3 / (4 * np.pi)) * np.array(mirror.z)[:, None]
    np.testing.assert_allclose(along, np.maximum(constant + tilt, 0), atol=1e-5)
    plates.roughness = dr.opaque(mi.Float, 0.05)
    narrow = plates.reflected(budget.HarmonicsEmitter(coefficients), None).mean(0)
    lobe = plates.reflected(plates.constant, None).mean(0)
    assert np.median(np.abs(narrow / lobe - along)) < 0.01
    plates.material(0.3)
