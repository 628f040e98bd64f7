"""The surfel table and its initial values: activations, degenerate rows, gradients in both modes, rows, hull."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from mi_refgs.errors import InputError
from mi_refgs.surfels import init
from mi_refgs.surfels.table import CHANNELS, Surfels, sh_columns
from scipy.spatial.transform import Rotation


def raw_table(count: int, rng: np.random.Generator, degree: int = 2) -> dict[str, np.ndarray]:
    return {
        name: rng.normal(size=(count, width or sh_columns(degree))).astype(np.float32) for name, width in CHANNELS.items()
    }


# ---------------- values ----------------


@pytest.mark.parametrize("count", [1, 2, 37])
def test_activations(count: int, rng: np.random.Generator) -> None:
    raw = raw_table(count, rng)
    surfels = Surfels.from_numpy(raw)
    surfels.validate()

    def sigmoid(name: str) -> np.ndarray:
        return 1 / (1 + np.exp(-raw[name].astype(np.float64)))

    np.testing.assert_array_equal(np.array(surfels.position()).T, raw["position"])
    np.testing.assert_allclose(np.array(surfels.scale()).T, np.exp(raw["scale"]), rtol=1e-6)
    np.testing.assert_allclose(np.array(surfels.albedo()).T, sigmoid("albedo"), rtol=1e-6)
    for name in ("opacity", "metallic", "roughness"):
        np.testing.assert_allclose(np.array(getattr(surfels, name)()), sigmoid(name)[:, 0], rtol=1e-6)
    axes = Rotation.from_quat(raw["rotation"]).as_matrix()
    for column, axis in enumerate(surfels.frame()):
        np.testing.assert_allclose(np.array(axis).T, axes[:, :, column], atol=1e-6)
    assert surfels.sh_degree("radiance_sh") == surfels.sh_degree("indirect_sh") == 2
    coefficient = surfels.radiance_sh()[4]
    np.testing.assert_array_equal(np.array(coefficient).T, raw["radiance_sh"][:, 12:15])
    for name, values in surfels.to_numpy().items():
        np.testing.assert_array_equal(values, raw[name])


def test_quaternion_sign_and_length_do_not_matter(rng: np.random.Generator) -> None:
    raw = raw_table(5, rng)
    frames = []
    for factor in (1, -1, 1e-10, 1e30):
        raw["rotation"] = (raw["rotation"] / np.abs(raw["rotation"]).max() * factor).astype(np.float32)
        frames.append(np.array(Surfels.from_numpy(raw).frame()[2]))
        np.testing.assert_allclose(frames[-1], frames[0], atol=1e-6)


def test_degenerate_rows_stay_finite() -> None:
    """Zero quaternion = identity without gradient; huge logits and log scales saturate; nothing becomes NaN."""
    huge = 3e38
    rotation = np.array([[0, 0, 0, 0], [1e-35, 0, 0, 0], [huge, huge, -huge, huge], [0, 0, 0, 1]])
    rows = np.array([huge, -huge, 0.0, 60.0])[:, None]
    surfels = Surfels.from_numpy(
        {"position": np.zeros((4, 3)), "rotation": rotation, "scale": np.repeat(rows, 2, 1), "opacity": rows}
    )
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


# ---------------- derivatives ----------------


def everything(surfels: Surfels) -> object:
    """Every accessor of every channel, with a weight of its own per entry."""
    arrays = [*surfels.position(), *surfels.scale(), surfels.opacity(), *surfels.albedo(), surfels.metallic()]
    arrays += [surfels.roughness(), *(entry for axis in surfels.frame() for entry in axis)]
    arrays += [part for name in ("radiance_sh", "indirect_sh") for colour in getattr(surfels, name)() for part in colour]
    generator = np.random.default_rng(9)
    total = mi.Float(0)
    for array in arrays:
        total += array * mi.Float(generator.normal(size=surfels.count).astype(np.float32))
    return total


def test_gradients_of_every_channel(rng: np.random.Generator) -> None:
    """Reverse mode against central differences in float32 (step 1e-2, truncation 1e-4) and forward mode against reverse."""
    raw = raw_table(6, rng, degree=1)
    surfels = Surfels.from_numpy(raw)
    surfels.enable_grad()
    dr.backward(dr.sum(everything(surfels)))
    for name in CHANNELS:
        found = dr.grad(surfels.raw[name]).numpy()
        wanted = np.zeros(found.shape)
        for column in range(found.shape[1]):
            # Rows are independent: one shift of a whole column gives every row's derivative.
            totals = []
            for step in (0.01, -0.01):
                shifted = {key: values.copy() for key, values in raw.items()}
                shifted[name][:, column] += np.float32(step)
                totals.append(np.array(everything(Surfels.from_numpy(shifted)), dtype=np.float64))
            wanted[:, column] = (totals[0] - totals[1]) / 0.02
        assert np.all(np.linalg.norm(wanted, axis=0) > 0)
        assert np.linalg.norm(found - wanted) <= 2e-3 * np.linalg.norm(wanted), name

        direction = rng.normal(size=found.shape).astype(np.float32)
        other = Surfels.from_numpy(raw)
        dr.enable_grad(other.raw[name])
        dr.set_grad(other.raw[name], mi.TensorXf(direction))
        total = dr.sum(everything(other))
        dr.forward_to(total)
        assert float(dr.grad(total)[0]) == pytest.approx(np.sum(found * direction), rel=1e-4, abs=1e-4)


def test_turning_a_quaternion_longer_has_no_gradient(rng: np.random.Generator) -> None:
    raw = raw_table(20, rng)
    surfels = Surfels.from_numpy(raw)
    surfels.enable_grad()
    dr.backward(dr.sum(surfels.frame()[2].x + 2 * surfels.frame()[0].y))
    radial = np.sum(dr.grad(surfels.raw["rotation"]).numpy() * raw["rotation"], axis=1)
    np.testing.assert_allclose(radial, 0, atol=1e-5)


# ---------------- rows ----------------


def test_gather_copies_rows_and_detaches(rng: np.random.Generator) -> None:
    raw = raw_table(5, rng)
    surfels = Surfels.from_numpy(raw)
    surfels.enable_grad()
    children = surfels.gather(mi.UInt32(4, 0, 0, 2))
    assert children.count == 4 and not dr.grad_enabled(list(children.raw.values()))
    for name, values in children.to_numpy().items():
        np.testing.assert_array_equal(values, raw[name][[4, 0, 0, 2]])


def test_empty_table(rng: np.random.Generator) -> None:
    for surfels in (
        Surfels.from_numpy(raw_table(0, rng)),
        Surfels.from_numpy(raw_table(3, rng)).gather(mi.UInt32()),
    ):
        surfels.validate()
        assert surfels.count == 0
        for value in (surfels.position(), surfels.opacity(), surfels.scale(), *surfels.frame(), *surfels.radiance_sh()):
            assert dr.width(value) == 0
        assert surfels.gather(mi.UInt32()).count == 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"glitter": np.zeros((3, 1))}, "glitter: unknown channel"),
        ({"albedo": np.zeros((3, 2))}, "albedo: 2 columns, expected 3"),
        ({"radiance_sh": np.zeros((3, 6))}, "radiance_sh: 6 columns, expected 3 or 12 or 27 or 48"),
        ({"opacity": np.zeros((4, 1))}, r"opacity: shape \(4, 1\), expected \(3, D\)"),
        ({"scale": np.array([[0, 1], [np.nan, 2], [np.inf, 0]])}, "scale: 2 values are NaN"),
    ],
)
def test_bad_tables_are_refused(change: dict[str, np.ndarray], message: str, rng: np.random.Generator) -> None:
    with pytest.raises(InputError, match=message):
        Surfels.from_numpy(raw_table(3, rng) | change).validate()


def test_missing_geometry_is_refused(rng: np.random.Generator) -> None:
    raw = raw_table(3, rng)
    del raw["rotation"]
    with pytest.raises(InputError, match="rotation: the channel is missing"):
        Surfels.from_numpy(raw).validate()


# ---------------- initial values ----------------


def test_from_points(rng: np.random.Generator) -> None:
    points, normals = rng.normal(size=(200, 3)), rng.normal(size=(200, 3))
    normals[0] = (0, 0, 5)
    colours = rng.random((200, 3))
    surfels = init.from_points(points, normals, colours, rng=rng, sh_degree=1, opacity=0.2, roughness=0.3)
    surfels.validate()
    np.testing.assert_allclose(np.array(surfels.frame()[2]).T, normals / np.linalg.norm(normals, axis=1)[:, None], atol=1e-6)
    squared = np.sort(np.sum((points[:, None] - points[None]) ** 2, axis=-1), axis=1)[:, 1:4]
    np.testing.assert_allclose(np.array(surfels.scale())[0], np.sqrt(squared.mean(axis=1)), rtol=1e-5)
    np.testing.assert_allclose(np.array(surfels.radiance_sh()[0]).T * 0.28209479 + 0.5, colours, atol=1e-6)
    np.testing.assert_allclose(np.array(surfels.opacity()), 0.2, rtol=1e-6)
    np.testing.assert_allclose(np.array(surfels.roughness()), 0.3, rtol=1e-6)
    assert np.abs(np.array(surfels.albedo()) - 0.5).max() <= 0.0251
    assert np.all(surfels.to_numpy()["indirect_sh"] == 0) and surfels.sh_degree() == 1


def test_random_rotations_are_uniform(rng: np.random.Generator) -> None:
    """The mean normal of 20000 uniform rotations is 0 to 3 / √20000, its second moment 1/3."""
    normal = np.array(init.from_points(rng.random((20000, 3)), rng=rng, channels=()).frame()[2])
    assert np.abs(normal.mean(axis=1)).max() < 0.02
    np.testing.assert_allclose(normal @ normal.T / 20000, np.eye(3) / 3, atol=0.02)


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_few_or_doubled_points_have_finite_scales(count: int, rng: np.random.Generator) -> None:
    surfels = init.from_points(np.ones((count, 3)), np.zeros((count, 3)), rng=rng, channels=("radiance_sh",))
    surfels.validate()
    assert surfels.count == count and list(surfels.raw) == ["position", "rotation", "scale", "opacity", "radiance_sh"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"normals": np.zeros((3, 3))}, r"normals: shape \(3, 3\), expected \(4, 3\)"),
        ({"points": np.full((4, 3), np.nan)}, "points: 12 values are NaN"),
        ({"sh_degree": 4}, "sh_degree: 4"),
        ({"channels": ("albdeo",)}, "albdeo: unknown"),
    ],
)
def test_bad_points_are_refused(change: dict[str, object], message: str, rng: np.random.Generator) -> None:
    with pytest.raises(InputError, match=message):
        init.from_points(**({"points": np.zeros((4, 3)), "rng": rng} | change))  # type: ignore[arg-type]


def sphere_views(count: int, size: int, centre: np.ndarray, radius: float, rng: np.random.Generator) -> list[init.View]:
    """Exact masks of a sphere from cameras at distance 4 around it; the picture shows the view's number."""
    views = []
    focal = -1.6 * size
    for number in range(count):
        forward = rng.normal(size=3)
        forward /= np.linalg.norm(forward)
        left = np.cross([0.3, 0.5, 0.8], forward)
        left /= np.linalg.norm(left)
        to_world = np.eye(4)
        to_world[:3, :3] = np.stack([left, np.cross(forward, left), forward], axis=-1)
        to_world[:3, 3] = centre - 4 * forward
        column, row = np.meshgrid(np.arange(size) + 0.5, np.arange(size) + 0.5)
        rays = np.stack([(column - size / 2) / focal, (row - size / 2) / focal, np.ones_like(row)], axis=-1)
        cosine = rays[..., 2] / np.linalg.norm(rays, axis=-1)
        alpha = (4 * np.sqrt(1 - cosine**2) < radius).astype(np.float32)
        colour = np.full((size, size, 3), number / count, dtype=np.float32)
        views.append(init.View(focal, focal, size / 2, size / 2, to_world, alpha, colour))
    return views


def test_visual_hull_of_a_sphere(rng: np.random.Generator) -> None:
    """Off-centre sphere: points within a voxel of its surface, normals outward within 12° on average."""
    centre = np.array([0.4, -0.3, 0.2])
    views = sphere_views(40, 64, centre, 0.8, rng)
    bounds = init.camera_bounds(views)
    np.testing.assert_allclose(bounds.mean(axis=0), centre, atol=1e-6)
    assert bounds[1, 0] - bounds[0, 0] == pytest.approx(2 * 4 / 1.6 / 2)
    points, normals = init.visual_hull_points(views, 2000, bounds, rng, resolution=40)
    assert points.shape == normals.shape == (2000, 3)
    outward = points - centre
    distance = np.linalg.norm(outward, axis=1)
    voxel = 2.5 / 40
    assert abs(distance.mean() - 0.8) < voxel / 2 and np.abs(distance - 0.8).max() < 2 * voxel
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-6)
    cosine = np.sum(normals * outward, axis=1) / distance
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean() < 12
    colours = init.mean_colours(points, views)
    assert np.all((colours > 0.3) & (colours < 0.7))
    facing = init.mean_colours(points, views[:1], normals)
    seen = np.sum(normals * (views[0].to_world[:3, 3] - points), axis=1) > 0
    # At the silhouette a mask of whole pixels may miss the point, which then stays grey.
    assert np.all(facing[~seen] == 0.5) and np.mean(facing[seen] == 0) > 0.8


def test_empty_hull_and_parallel_cameras_are_refused(rng: np.random.Generator) -> None:
    views = sphere_views(4, 16, np.zeros(3), 0.8, rng)
    nothing = [init.View(v.fx, v.fy, v.cx, v.cy, v.to_world, v.alpha * 0) for v in views]
    with pytest.raises(InputError, match="inside every mask"):
        init.visual_hull_points(nothing, 10, init.camera_bounds(views), rng, resolution=8)
    for few in ([], views[:1]):
        with pytest.raises(InputError, match="do not look at one point"):
            init.camera_bounds(few)
    points = init.random_points(100, np.array([[-1, 0, 2], [1, 1, 2.5]]), rng)
    assert points.shape == (100, 3) and np.all((points >= [-1, 0, 2]) & (points <= [1, 1, 2.5]))
    assert np.all(init.mean_colours(points, nothing) == 0.5)
