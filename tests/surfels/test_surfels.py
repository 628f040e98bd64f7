"""The surfel table: activations, degenerate rows, gradients in both modes, rows, refusals."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mi_refgs.constants import MAX_TURN
from mi_refgs.errors import InputError
from mi_refgs.surfels.attributes import ATTRIBUTES
from mi_refgs.surfels.table import Surfels
from tests.scenes.splats import random_raw


@pytest.mark.parametrize("count", [1, 2, 37])
def test_activations(count: int, rng: np.random.Generator) -> None:
    raw = random_raw(count, rng, 2)
    surfels = Surfels.from_numpy(raw)
    surfels.validate()

    def sigmoid(name: str) -> np.ndarray:
        return 1 / (1 + np.exp(-raw[name].astype(np.float64)))

    np.testing.assert_array_equal(np.array(surfels.position()).T, raw["position"])
    np.testing.assert_allclose(np.array(surfels.scale()).T, np.exp(raw["scale"]), rtol=1e-6)
    np.testing.assert_allclose(np.array(surfels.value("albedo")).T, sigmoid("albedo"), rtol=1e-6)
    for name in ("opacity", "metallic", "roughness"):
        np.testing.assert_allclose(np.array(surfels.value(name)), sigmoid(name)[:, 0], rtol=1e-6)
    axes = Rotation.from_quat(raw["rotation"]).as_matrix()
    for column, axis in enumerate(surfels.frame()):
        np.testing.assert_allclose(np.array(axis).T, axes[:, :, column], atol=1e-6)
    assert surfels.sh_degree("radiance_sh") == surfels.sh_degree("indirect_sh") == 2
    np.testing.assert_array_equal(np.array(surfels.value("radiance_sh")[4]).T, raw["radiance_sh"][:, 12:15])
    for name, values in surfels.to_numpy().items():
        np.testing.assert_array_equal(values, raw[name])


def test_quaternion_sign_and_length_do_not_matter(rng: np.random.Generator) -> None:
    raw = random_raw(5, rng, 2)
    frames = []
    for factor in (1, -1, 1e-10, 1e30):
        raw["rotation"] = (raw["rotation"] / np.abs(raw["rotation"]).max() * factor).astype(np.float32)
        frames.append(np.array(Surfels.from_numpy(raw).frame()[2]))
        np.testing.assert_allclose(frames[-1], frames[0], atol=1e-6)


def test_degenerate_rows_stay_finite() -> None:
    """Zero quaternion = identity without gradient; huge logits and log scales saturate; nothing is NaN."""
    huge = 3e38
    rotation = np.array([[0, 0, 0, 0], [1e-35, 0, 0, 0], [huge, huge, -huge, huge], [0, 0, 0, 1]])
    rows = np.array([huge, -huge, 0.0, 60.0])[:, None]
    raw = {"position": np.zeros((4, 3)), "rotation": rotation, "scale": rows.repeat(2, 1), "opacity": rows}
    surfels = Surfels.from_numpy(raw)
    surfels.enable_grad()
    t_u, t_v, n = surfels.frame()
    total = t_u.y + 2 * t_v.z + 3 * n.x + n.z + surfels.opacity() + surfels.scale().x * 1e-6
    assert np.all(np.isfinite(np.array(total)))
    np.testing.assert_array_equal(np.array(n)[:, 0], [0, 0, 1])
    np.testing.assert_allclose(np.array(surfels.opacity()), [1, 0, 0.5, 1], atol=1e-12)
    dr.backward(total)
    for tensor in surfels.raw.values():
        assert np.all(np.isfinite(dr.grad(tensor).numpy()))
    assert np.all(dr.grad(surfels.raw["rotation"]).numpy()[:2] == 0)


def test_turns_are_bounded_however_curved_or_large_a_surfel_is() -> None:
    rng, count = np.random.default_rng(0), 60
    raw = random_raw(count, rng, 2)
    raw["curvature"] = np.outer(10.0 ** rng.uniform(-30, 17, count), [1, -1, 1]).astype(np.float32)
    raw["scale"] = rng.uniform(-60, 60, (count, 2)).astype(np.float32)
    surfels = Surfels.from_numpy(raw)
    surfels.enable_grad()
    turns = surfels.primitive.turns(surfels, -surfels.frame()[2])
    length = np.array([np.array(dr.norm(turn)) for turn in turns.values()])
    assert length.max() == pytest.approx(MAX_TURN, rel=1e-5) and length.min() < 1e-20
    dr.backward(sum(dr.sum(turn.x + 2 * turn.y + 3 * turn.z) for turn in turns.values()))
    for tensor in surfels.raw.values():
        assert np.all(np.isfinite(dr.grad(tensor).numpy()))


def everything(surfels: Surfels) -> object:
    """Every accessor of every channel, with a weight of its own per entry."""
    arrays = [*surfels.position(), *surfels.scale(), surfels.opacity()]
    arrays += [surfels.value(name) for name in ("metallic", "roughness", "confidence")]
    arrays += [entry for axis in surfels.frame() for entry in axis]
    arrays += [entry for name in ("albedo", "tint", "normal_offset") for entry in surfels.value(name)]
    turns = surfels.primitive.turns(surfels, surfels.frame()[2])
    arrays += [entry for turn in turns.values() for entry in turn]
    harmonics = (name for name in ATTRIBUTES if ATTRIBUTES[name].harmonics)
    arrays += [x for name in harmonics for colour in surfels.value(name) for x in colour]
    generator = np.random.default_rng(9)
    total = mi.Float(0)
    for array in arrays:
        total += array * mi.Float(generator.normal(size=surfels.count).astype(np.float32))
    return total


def test_gradients_of_every_channel(rng: np.random.Generator) -> None:
    """Reverse mode against central differences (step 1e-2, truncation 1e-4), forward mode against reverse."""
    raw = random_raw(6, rng, 1)
    surfels = Surfels.from_numpy(raw)
    surfels.enable_grad()
    dr.backward(dr.sum(everything(surfels)))
    for name in ATTRIBUTES:
        found = dr.grad(surfels.raw[name]).numpy()
        wanted = np.zeros(found.shape)
        for column in range(found.shape[1]):
            # Rows are independent: one shift of a whole column gives every row's derivative.
            step = np.float32(0.01) * (np.arange(found.shape[1]) == column)
            sides = (Surfels.from_numpy(raw | {name: raw[name] + sign * step}) for sign in (1, -1))
            above, below = (np.array(everything(side), np.float64) for side in sides)
            wanted[:, column] = (above - below) / 0.02
        assert np.all(np.linalg.norm(wanted, axis=0) > 0)
        assert np.linalg.norm(found - wanted) <= 2e-3 * np.linalg.norm(wanted), name

    direction = {name: rng.normal(size=values.shape).astype(np.float32) for name, values in raw.items()}
    other = Surfels.from_numpy(raw)
    other.enable_grad()
    for name, values in direction.items():
        dr.set_grad(other.raw[name], mi.TensorXf(values))
    expected = sum(np.sum(dr.grad(surfels.raw[name]).numpy() * values) for name, values in direction.items())
    assert dr.forward_to(dr.sum(everything(other)))[0] == pytest.approx(expected, rel=1e-4)


def test_gather_copies_rows_and_detaches(rng: np.random.Generator) -> None:
    raw = random_raw(5, rng, 2)
    surfels = Surfels.from_numpy(raw)
    surfels.enable_grad()
    children = surfels.gather(mi.UInt32(4, 0, 0, 2))
    assert children.count == 4 and not dr.grad_enabled(list(children.raw.values()))
    for name, values in children.to_numpy().items():
        np.testing.assert_array_equal(values, raw[name][[4, 0, 0, 2]])


def test_empty_table(rng: np.random.Generator) -> None:
    gathered = Surfels.from_numpy(random_raw(3, rng, 2)).gather(mi.UInt32())
    for surfels in (Surfels.from_numpy(random_raw(0, rng, 2)), gathered):
        surfels.validate()
        assert surfels.count == 0
        values = [surfels.position(), surfels.opacity(), surfels.scale()]
        assert not any(map(dr.width, [*values, *surfels.frame(), *surfels.value("radiance_sh")]))
        assert surfels.gather(mi.UInt32()).count == 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"glitter": np.zeros((3, 1))}, "surfels: .*glitter.* is unknown; use"),
        ({"albedo": np.zeros((3, 2))}, "albedo: 2 columns, expected 3"),
        ({"curvature": np.zeros((3, 3)), "scale": np.zeros((3, 3))}, "curvature: a gaussian has none"),
        ({"radiance_sh": np.zeros((3, 6))}, "radiance_sh: 6 columns, expected 3 or 12 or 27 or 48"),
        ({"opacity": np.zeros((4, 1))}, r"opacity: shape \(4, 1\), expected \(3, D\)"),
        ({"scale": np.array([[0, 1], [np.nan, 2], [np.inf, 0]])}, "scale: 2 values are NaN"),
        ({"rotation": None}, "rotation: the attribute is missing"),
    ],
)
def test_bad_surfel_models_are_refused(
    change: dict[str, np.ndarray | None], message: str, rng: np.random.Generator
) -> None:
    raw = {name: values for name, values in (random_raw(3, rng, 2) | change).items() if values is not None}
    with pytest.raises(InputError, match=message):
        Surfels.from_numpy(raw).validate()
