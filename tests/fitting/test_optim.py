"""Adam against NumPy, schedules, moments that follow their rows, bitwise resume, a loop of one's own."""

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import mi_refgs
from mi_refgs.fitting import row_rates
from mi_refgs.fitting.optim import Adam, LearningRate
from mi_refgs.reference import losses as reference
from tests.helpers import unit

GROUP = LearningRate(0.1)


def tensor(values: np.ndarray | float) -> Any:
    return mi.TensorXf(np.ascontiguousarray(values, dtype=np.float32))


def give(optimiser: Adam, name: str, gradient: np.ndarray | float) -> None:
    dr.set_grad(optimiser.params[name], tensor(gradient))


def advance(optimiser: Adam, number: int, loss: Any = None, **gradients: np.ndarray) -> None:
    """One step with these gradients."""
    for name, gradient in gradients.items():
        give(optimiser, name, gradient)
    optimiser.step(number, loss)


def adam(values: np.ndarray, group: LearningRate = GROUP) -> tuple[dict[str, Any], Adam]:
    """One tensor "x" and its optimiser."""
    params = {"x": tensor(values)}
    return params, Adam(params, {"x": group})


def test_group_rates() -> None:
    """Log-linear to the end of the schedule, then constant; half-way is the geometric mean."""
    for begin, half in ((0, 50), (50, 75)):
        group, at = LearningRate(1e-2, final=1e-4, steps=100, begin=begin), (-5, begin, half, 100, 10**6)
        assert [group.at(i) for i in at] == pytest.approx([1e-2, 1e-2, 1e-3, 1e-4, 1e-4])
    assert LearningRate(1e-2, 1e-4, 100, begin=50, linear=True).at(75) == pytest.approx(5.05e-3)
    assert LearningRate(0.05).at(7) == 0.05 and LearningRate(0.0, final=1.0).at(50) == 0.0


def test_equals_published_algorithm(rng: np.random.Generator) -> None:
    """Ten steps of two tensors with a schedule and per-column rates; gradients as small as in fits."""
    start = {"position": rng.normal(size=(7, 3)), "radiance_sh": rng.normal(size=(7, 12))}
    sh = LearningRate(7.5e-3, head=3, tail=1 / 20)
    groups = {"position": LearningRate(1e-2, 1e-4, 10), "radiance_sh": sh}
    params = {name: tensor(values) for name, values in start.items()}
    optimiser = Adam(params, groups)
    gradients = {name: 1e-7 * rng.normal(size=(10, *values.shape)) for name, values in start.items()}
    for step in range(10):
        advance(optimiser, step, **{name: found[step] for name, found in gradients.items()})
    columns = np.where(np.arange(12) < 3, 1, 1 / 20)
    rates = {"position": [1e-2 * 100 ** (-step / 10) for step in range(10)]}
    rates["radiance_sh"] = [7.5e-3 * columns] * 10
    for name, values in start.items():
        wanted = reference.adam(values.astype(np.float32), [*gradients[name]], rates[name])
        moved = np.linalg.norm(wanted - values)
        assert np.linalg.norm(params[name].numpy() - wanted) < 2e-4 * moved + 1e-6
        assert moved > 1e-3 and dr.grad_enabled(params[name])


def test_gradients_are_cleared_and_tensor_without_one_rests() -> None:
    params, optimiser = adam(np.ones((2, 1)))
    params["idle"] = tensor(np.ones((2, 1)))
    optimiser.step(0)
    assert np.all(params["x"].numpy() == 1)
    advance(optimiser, 1, x=np.ones((2, 1)))
    assert np.all(dr.grad(params["x"]).numpy() == 0) and np.all(params["x"].numpy() < 1)
    assert np.all(params["idle"].numpy() == 1)
    before, moved = optimiser.state_dict(), params["x"].numpy()
    optimiser.step(2)
    np.testing.assert_array_equal(params["x"].numpy(), moved)
    after = optimiser.state_dict()
    assert before["x/steps"] == 1 and all(np.array_equal(after[key], before[key]) for key in before)
    give(optimiser, "x", np.zeros((2, 1)))  # a gradient that is zero is one
    optimiser.step(3)
    assert optimiser.state_dict()["x/steps"] == 2 and np.all(params["x"].numpy() < moved)


def values(optimiser: Adam) -> dict[str, np.ndarray]:
    """All that a step may change, but step counts."""
    state = {name: x for name, x in optimiser.state_dict().items() if name.endswith(("first", "second"))}
    return state | {name: np.array(x.numpy()) for name, x in optimiser.params.items()}


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("where", ["gradient", "loss"])
def test_step_that_is_not_finite_changes_nothing_and_is_reported(bad: float, where: str) -> None:
    """No entry of any tensor, its moments included; the next step goes on."""
    params = {"x": tensor(np.zeros((4, 2))), "y": tensor(np.zeros((3, 1))), "sh": tensor(np.zeros((4, 12)))}
    groups = {"x": LearningRate(0.1), "y": LearningRate(0.1), "sh": LearningRate(0.1, head=3, tail=0.05)}
    optimiser = Adam(params, groups)

    def step(iteration: int, spoilt: bool) -> None:
        gradient, loss = np.ones((4, 2)), 1.0
        if spoilt and where == "gradient":
            gradient[0, 0], gradient[3, 1] = bad, bad
        elif spoilt:
            loss = bad
        harmonics = np.ones((4, 12))
        harmonics[2, 1] = bad if spoilt and where == "gradient" else 1
        advance(optimiser, iteration, mi.Float(loss), x=gradient, y=np.ones((3, 1)), sh=harmonics)

    step(10, False)
    assert optimiser.report().count == 0
    before = values(optimiser)
    step(11, True)
    step(12, True)
    for name, x in values(optimiser).items():
        np.testing.assert_array_equal(before[name], x, err_msg=name)
    step(13, False)
    step(14, False)
    after = values(optimiser)
    assert all(np.all(after[name] < before[name]) and np.all(np.isfinite(after[name])) for name in params)
    report = optimiser.report()
    assert (report.count, report.iteration) == (2, 12)
    rows = {name: found.tolist() for name, found in report.rows.items()}
    assert rows == ({"x": [0, 3], "sh": [2]} if where == "gradient" else {})
    assert optimiser.report().count == 0 and not optimiser.report().rows


@pytest.mark.parametrize("huge", [1e10, -1e30, 3e38])
@pytest.mark.parametrize("at", [0, 1, 50, 1000])
def test_one_huge_gradient_slows_its_entry_but_does_not_stop_it(huge: float, at: int) -> None:
    """From 100 steps after it, the entry moves a tenth as far as its neighbours; with a history, a quarter.

    With plain Adam it would not move by a thousandth in a thousand steps."""
    rng, rate, after = np.random.default_rng(1), 1e-3, 300
    params, optimiser = adam(np.zeros((300, 1)), LearningRate(rate))
    positions = {}
    for step in range(at + 1 + after):
        usual = 1e-7 * (0.5 + np.abs(rng.normal(size=(300, 1))))
        if step == at:
            usual[7] = huge
        advance(optimiser, step, x=usual)
        if step in (at, at + 100, at + after):
            positions[step - at] = np.array(params["x"].numpy())[:, 0]
    assert all(np.all(np.isfinite(x)) for x in positions.values()) and optimiser.report().count == 0
    moved = positions[100] - positions[after]
    assert np.median(moved) > 0.5 * rate * (after - 100)
    assert moved[7] > (0.25 if at == 1000 else 0.1) * np.median(moved)
    assert np.abs(positions[100] - positions[0])[7] < 100 * 3.2 * rate


def test_ordinary_fit_is_not_cut(rng: np.random.Generator) -> None:
    """Gradients that vary by a factor of 50 from step to step, and rows that are seldom seen."""
    shape, spread = (400, 3), 1e-7 * np.exp(0.5 * rng.normal(size=(400, 3)))
    params, optimiser = adam(np.zeros(shape), LearningRate(1e-2))
    gradients = []
    for step in range(120):
        seen = rng.uniform(size=(400, 1)) < (0.1 if step > 60 else 0.7)
        gradients.append(spread * seen * np.exp(rng.uniform(-2, 2, shape)) * rng.normal(size=shape))
        advance(optimiser, step, x=gradients[-1])
    wanted = reference.adam(np.zeros(shape), gradients, [1e-2] * 120)
    np.testing.assert_allclose(params["x"].numpy(), wanted, atol=1e-5)


def test_moments_follow_their_rows(rng: np.random.Generator) -> None:
    """Permuting, cloning and pruning rows commutes with stepping; fresh rows start anew."""
    start, g1, g2 = (rng.normal(size=(5, 3)) for _ in range(3))
    (_, whole), (_, moved) = (adam(start, LearningRate(0.01)) for _ in range(2))
    for optimiser in (whole, moved):
        advance(optimiser, 0, x=g1)
    middle = whole.params["x"].numpy()
    parent = np.array([4, 1, 1, 0])
    moved.params["x"] = tensor(middle[parent])
    moved.gather(mi.UInt32(parent), ["x", "unknown"], fresh=mi.Bool(False, False, True, False))
    advance(whole, 1, x=g2)
    advance(moved, 1, x=g2[parent])
    found, wanted = moved.params["x"].numpy(), whole.params["x"].numpy()[parent]
    np.testing.assert_array_equal(found[[0, 1, 3]], wanted[[0, 1, 3]])
    # A row without history: m = 0.1 g, v = 0.001 g², at the step count 2 of its tensor.
    fresh = 0.01 * np.sqrt(1 - 0.999**2) / (1 - 0.9**2) * 0.1 * np.sign(g2[1]) / np.sqrt(0.001)
    np.testing.assert_allclose(middle[1] - found[2], fresh, rtol=1e-3)


def test_resume_is_bitwise(rng: np.random.Generator) -> None:
    gradients = rng.normal(size=(6, 9, 2))

    def steps(optimiser: Adam, numbers: range) -> None:
        for number in numbers:
            advance(optimiser, number, x=gradients[number])

    groups = {"x": LearningRate(0.01, 0.001, 6)}
    straight = Adam({"x": tensor(np.ones((9, 2)))}, groups)
    straight.factors["x"] = 0.5
    steps(straight, range(3))
    saved, values = straight.state_dict(), straight.params["x"].numpy()
    steps(straight, range(3, 6))
    resumed = Adam({"x": tensor(values)}, groups)
    resumed.load_state_dict(saved)
    steps(resumed, range(3, 6))
    assert straight.params["x"].numpy().tobytes() == resumed.params["x"].numpy().tobytes()
    for key, value in straight.state_dict().items():
        assert value.tobytes() == resumed.state_dict()[key].tobytes()


@pytest.mark.parametrize(
    ("start", "options", "factors"),
    [
        # What is above 1 moves by the rate times itself, what is below by the rate.
        ([[-3.0], [0.5], [1.0], [4.0], [50.0]], {"by_row": row_rates.relative}, [[1], [1], [1], [4], [50]]),
        # Each row moves by the rate times its distance from the centre, in its unit.
        (
            [[1.0, 2, 3], [1, 2, 5], [1 + 30, 2, 3 + 40], [1, 1.5, 3]],
            {"by_row": row_rates.ByDistance((1.0, 2.0, 3.0), 2.0), "unit": 2.0},
            [[0] * 3, [1] * 3, [25] * 3, [0.25] * 3],
        ),
    ],
)
def test_rates_of_lamps_and_of_distant_positions_grow(
    start: list[list[float]], options: dict[str, Any], factors: list[list[float]]
) -> None:
    params, optimiser = adam(np.array(start), LearningRate(0.1, **options))
    advance(optimiser, 0, x=-np.ones_like(start))
    np.testing.assert_allclose(params["x"].numpy() - start, 0.1 * np.array(factors), rtol=1e-3)


def test_materials_decide_how_fast_rows_learn(rng: np.random.Generator) -> None:
    """A row's step is Adam's times metallic (1 - roughness)², or over 1 - metallic ≥ 0.05, else Adam's."""
    materials = ("metallic", "roughness")
    for at, names in [(at, materials[:count]) for at in ("", "n.", "n/") for count in range(3)]:
        values = {at + name: np.append(rng.normal(size=(4, 1)), [[4.0]], axis=0) for name in names}
        params = {key: tensor(x) for key, x in values.items()}
        rules = {"normal": row_rates.of_mirrors} | dict.fromkeys(("sh", "other"), row_rates.of_diffuse_colour)
        rates = {at + name: LearningRate(0.1, by_row=rule) for name, rule in rules.items()}
        params |= {name: tensor(np.zeros((7 if "other" in name else 5, 3))) for name in rates}
        advance(Adam(params, rates), 0, **{name: np.ones(params[name].shape) for name in rates})
        share = {name: 1 / (1 + np.exp(-raw)) for name, raw in values.items()}
        metallic = share.get(at + "metallic", 0)
        mirror = (metallic if names else 1) * (1 - share.get(at + "roughness", 0)) ** 2
        for name, factor in (("normal", mirror), ("sh", 1 / np.maximum(1 - metallic, 0.05)), ("other", 1)):
            expected = np.broadcast_to(-0.1 * factor, params[at + name].shape)
            np.testing.assert_allclose(params[at + name].numpy(), expected, rtol=1e-4)


def test_every_tensor_has_its_bit_however_many_there_are() -> None:
    """The first and the last of 40 tensors are distinguished, also where rows are wide."""
    sizes = {f"t{i}": (4, 2) for i in range(38)} | {"wide": (2, 100), "last": (4, 2)}
    params = {name: tensor(np.zeros(size)) for name, size in sizes.items()}
    optimiser = Adam(params, {name: LearningRate(1.0) for name in sizes})
    spoilt = {"t0": (1, 0), "t33": (2, 1), "wide": (1, 70), "last": (3, 1)}
    for name, size in sizes.items():
        gradient = np.ones(size, np.float32)
        if name in spoilt:
            gradient[spoilt[name]] = np.nan
        give(optimiser, name, gradient)
    optimiser.step(0)
    found = optimiser.report()
    assert found.count == 1
    expected = {name: [0 if name == "wide" else row] for name, (row, _) in spoilt.items()}
    assert {name: rows.tolist() for name, rows in found.rows.items()} == expected
    assert np.all(params["t1"].numpy() == 0)


def _scene_of(surfels: mi_refgs.Surfels, light: Any) -> Any:
    pose = mi.ScalarTransform4f().look_at([4, 0, 1], [0, 0, 0], [0, 0, 1])
    film = {"type": "hdrfilm", "width": 24, "height": 24, "pixel_format": "rgba"}
    camera = {"type": "perspective", "fov": 34, "to_world": pose, "film": film}
    integrator = {"type": "refgs", **surfels.raw, "light": light}
    return mi.load_dict({"type": "scene", "refgs": integrator, "c": camera})


def test_a_loop_over_the_parameters_of_a_scene(rng: np.random.Generator) -> None:
    """The score is the length of the position's gradient; moments follow children and moved rows."""
    points = unit(rng.normal(size=(150, 3)))
    true = mi_refgs.from_points(points, points, 0.5 + 0.4 * points, rng=rng, opacity=0.95, metallic=0.1)
    light = mi_refgs.EnvironmentLight.constant(1, height=8).raw
    goal = mi.render(_scene_of(true, light), spp=1)
    start = mi_refgs.from_points(points[:100], points[:100], rng=rng, opacity=0.9, metallic=0.1)
    scene = _scene_of(start, light)
    params = mi.traverse(scene)
    own = mi_refgs.learning_rates(start.raw, extent=1.0, iterations=16)
    rates = {f"refgs.{name}": rate for name, rate in own.items()} | {"refgs.light": 0.01}
    adam = mi_refgs.Adam(params, rates)
    table = mi_refgs.ParameterTable(params, adam, "refgs.")
    losses = []
    for step in range(16):
        params.update()
        planes, true_planes = (mi_refgs.image_planes(x) for x in (mi.render(scene, params, spp=1), goal))
        loss = mi_refgs.l1(planes, true_planes) + mi_refgs.d_ssim(planes, true_planes, 24, 24)
        dr.backward(loss)
        table.observe(mi.Float(np.linalg.norm(dr.grad(params["refgs.position"]).numpy(), axis=1)))
        adam.step(step, loss)
        losses.append(float(loss.array[0]))
        if step == 7:
            table.apply(mi_refgs.densify_and_prune(table.surfels, table.error_sum, most=130))
            table.clear()
    state = adam.state_dict()
    assert table.surfels.count == 125 == dr.width(table.error_sum) == len(state["refgs.opacity/first"])
    assert adam.report().count == 0 and losses[-1] < 0.7 * losses[0], losses
