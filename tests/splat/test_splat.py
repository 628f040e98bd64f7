"""The splatter against its float64 reference: images, gradients of every parameter, tile lists."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_refgs import constants
from mi_refgs.constants import ALPHA_MIN
from mi_refgs.errors import InputError
from mi_refgs.reference import splat as oracle
from mi_refgs.reference.camera import look_at, rotation_axes
from mi_refgs.reference.footprint import Gaussian, Rules, Surfel
from mi_refgs.splat import Camera, list_by_tile, project, splat, tiles
from mi_refgs.splat.lanes import Lanes
from mi_refgs.surfels.table import Surfels
from tests.helpers import slow
from tests.scenes import splats as scenes


@dataclass(frozen=True)
class Primitive:
    """A primitive with its scenes and its float64 reference."""

    name: str
    make: Callable[[int], scenes.Scene]
    exact: Any
    image: float  # tolerance
    gradient: float  # relative L2

    def __str__(self) -> str:
        return self.name


PRIMITIVES = [
    Primitive("surfel", scenes.make_scene, Surfel, 1e-4, 3e-4),  # observed 2e-6 … 3e-5, and 1e-6 … 1.4e-4
    Primitive("turned", scenes.make_turned, Surfel, 1e-4, 3e-4),
    Primitive("gaussian", scenes.make_gaussians, Gaussian, 1e-5, 1e-3),  # observed 2e-6
]
BOTH = pytest.mark.parametrize("kind", [one for one in PRIMITIVES if one.name != "turned"], ids=str)
ALL = pytest.mark.parametrize("kind", PRIMITIVES, ids=str)
SEEDS = [seed if seed in range(0, 20, 3) else slow(seed) for seed in range(60)]
MANY = pytest.mark.parametrize("seed", SEEDS)
TILES = [size for _, size in constants.TILE_SIZES]
EVERY_TILE = pytest.mark.parametrize("tile", TILES, indirect=True, ids=str)

DEGENERATE: dict[str, tuple[str, slice, Any]] = {
    "scales of 0": ("scale", slice(None), -1e4),
    "scales without end": ("scale", slice(None), 1e4),
    "one scale without end": ("scale", slice(1), 1e4),
    "quaternions of 0": ("rotation", slice(None), 0),
    "opacity of 1": ("opacity", slice(None), 1e4),
    "at the camera": ("position", slice(None), None),
    "none": ("position", slice(0), 0),
}
"""Attribute, columns and their raw value."""


@pytest.fixture
def tile(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> tuple[int, int]:
    """Tiles of this size, whatever the camera; smaller ones share a patch."""
    monkeypatch.setattr(constants, "TILE_SIZES", ((np.inf, request.param),))
    return request.param


@MANY
@ALL
def test_image_matches_oracle(kind: Primitive, seed: int) -> None:
    scenes.check_image(kind.make(seed), kind.image)


@MANY
@ALL
def test_gradients_match_the_oracle(kind: Primitive, seed: int) -> None:
    scenes.check_gradients(kind.make(seed), seed, kind.gradient)


@EVERY_TILE
@ALL
def test_images_and_gradients_with_tiles_of_every_size(kind: Primitive, tile: tuple[int, int]) -> None:
    assert kind.make(8).fast_camera().tile == tile
    scenes.check_image(kind.make(8), kind.image)
    scenes.check_gradients(kind.make(5), 5, kind.gradient)


@ALL
def test_derivatives_of_the_oracle_are_its_differences(kind: Primitive) -> None:
    """For the strongest opacity and for a few others."""
    scene = kind.make(1 if kind.exact is Surfel else 8)
    weights = scenes.loss_weights(scene, 1)

    def maps(raw: dict[str, np.ndarray]) -> np.ndarray:
        found = scene.exact(raw)
        return np.concatenate([found.features, found.depth[..., None], found.alpha[..., None]], axis=-1)

    gradients = scenes.exact_gradients(scene, weights)
    strongest = int(np.argmax(np.abs(gradients["opacity"])))
    for name, values in scene.raw.items():
        slopes = gradients[name]
        for row in (strongest, *range(0, len(values), max(len(values) // 3, 1))):
            for column in range(values.shape[1]):
                step = np.zeros_like(values)
                step[row, column] = 1e-6
                sides = (maps(scene.raw | {name: values + sign * step}) for sign in (1, -1))
                above, below = (np.sum(weights * side) for side in sides)
                difference = (above - below) / 2e-6
                assert slopes[row, column] == pytest.approx(difference, abs=1e-5 * np.abs(slopes).max()), name


@pytest.mark.parametrize("seed", [3, 14])
@ALL
def test_forward_mode_is_the_transpose_of_reverse(kind: Primitive, seed: int) -> None:
    """⟨∇loss, v⟩ from reverse mode equals the directional derivative from forward mode, for random v."""
    scene = kind.make(seed)
    weights = scenes.loss_weights(scene, seed)
    rng = np.random.default_rng(seed)
    reverse = scenes.fast_gradients(scene, weights)
    direction = {name: rng.normal(size=values.shape) for name, values in reverse.items()}
    surfels, features = scene.surfels(), scene.columns()
    dr.enable_grad(surfels.raw, features)
    for name in scene.raw:
        dr.set_grad(surfels.raw[name], mi.TensorXf(direction[name].astype(np.float32)))
    for k, column in enumerate(features):
        dr.set_grad(column, mi.Float(np.ascontiguousarray(direction["features"][:, k].astype(np.float32))))
    forward = dr.forward_to(scenes.fast_loss(scene, surfels, features, weights), flags=dr.ADFlag.Default)[0]
    for name in scenes.PARAMETERS:
        assert np.any(reverse[name]), name
    expected = sum(np.sum(reverse[name] * direction[name]) for name in scenes.PARAMETERS)
    size = np.sqrt(sum(np.sum((reverse[name] * direction[name]) ** 2) for name in scenes.PARAMETERS))
    assert abs(forward - expected) <= 1e-3 * size


@pytest.mark.parametrize("case", DEGENERATE)
@ALL
def test_degenerate_rows_stay_finite(kind: Primitive, case: str) -> None:
    scene = kind.make(9)
    name, columns, value = DEGENERATE[case]
    raw = {key: values[: 0 if case == "none" else None].copy() for key, values in scene.raw.items()}
    raw[name][:, columns] = scene.camera.to_world[:3, 3] if value is None else value
    features = scene.features[: len(raw[name])]
    turns = None if scene.turns is None else scene.turns[: len(raw[name])]
    scene = replace(scene, raw=raw, features=features, turns=turns)
    maps = scenes.fast_maps(scene)
    assert all(np.isfinite(x.numpy()).all() for x in [*maps.features, maps.depth, maps.alpha])
    if len(scene.features):
        gradients = scenes.fast_gradients(scene, np.ones((scene.camera.height, scene.camera.width, 6)))
        assert all(np.isfinite(x).all() for x in gradients.values())


@pytest.mark.parametrize("thinness", [1.0, 1e-5])
@pytest.mark.parametrize("seed", range(0, 20, 6))
@BOTH
def test_tile_lists_hold_what_contributes_and_little(kind: Primitive, seed: int, thinness: float) -> None:
    """Every pair with a pixel at α ≥ ALPHA_MIN is listed, needles' too, and few others."""
    scene = kind.make(seed)
    scene.raw["scale"][:, 0] += 2 * (thinness < 1)
    scene.raw["scale"][:, 1] += np.log(thinness)
    camera = scene.fast_camera()
    lists = list_by_tile(project([scene.surfels()], camera), camera)
    begin, end, surfel = (x.numpy() for x in (lists.pair_begin, lists.pair_end, lists.surfel_from_pair))
    listed = {(int(i), tile) for tile in range(len(begin)) for i in surfel[begin[tile] : end[tile]]}
    assert len(listed) == lists.pairs, "a pair is listed twice"
    y, x = (v.ravel() for v in np.mgrid[0 : camera.height, 0 : camera.width])
    alpha = kind.exact.footprint(scene.raw, scene.camera, Rules(), x + 0.5, y + 0.5).alpha
    alpha[kind.exact.culled(scene.raw, scene.camera, Rules())] = 0
    tile = y // camera.tile[1] * camera.tiles[0] + x // camera.tile[0]
    needed = {(int(i), int(tile[k])) for i, k in zip(*np.nonzero(alpha >= ALPHA_MIN * 1.001), strict=True)}
    # A tile may see a footprint between its pixels only, as it sees needles, or beyond the near plane.
    most = 1.25 if thinness == 1 else np.inf
    assert needed <= listed and len(listed) - 20 <= most * max(len(needed), 1)


@EVERY_TILE
@pytest.mark.parametrize("seed", [12, 16])
@BOTH
def test_tile_lists_are_in_the_oracles_order(kind: Primitive, seed: int, tile: tuple[int, int]) -> None:
    scene = kind.make(seed)
    camera = scene.fast_camera()
    lists = list_by_tile(project([scene.surfels()], camera), camera)
    pixels = np.arange(camera.width * camera.height)
    order = oracle.sorted_rows([scene.raw], scene.camera, pixels).reshape(-1, camera.height, camera.width)
    surfel, compared = lists.surfel_from_pair.numpy(), 0
    for i, (begin, end) in enumerate(zip(lists.pair_begin.numpy(), lists.pair_end.numpy(), strict=True)):
        y, x = (k * size for k, size in zip(divmod(i, camera.tiles[0]), camera.tile[::-1], strict=True))
        listed = surfel[begin:end]
        np.testing.assert_array_equal(listed, [k for k in order[:, y, x] if k in set(listed)])
        compared += len(listed)
    assert compared > 100


@pytest.mark.parametrize(("surfels", "tile_count"), [(1, 1), (40_000, 3600), (1 << 27, 1 << 18)])
def test_numbers_that_are_sorted_leave_depth_its_bits(
    surfels: int, tile_count: int, rng: np.random.Generator
) -> None:
    """24, or 19 beside 2²⁷ surfels and 2¹⁸ tiles; equal keys keep their order."""
    tile, surfel = (rng.integers(0, most, 3000, np.uint32) for most in (tile_count, surfels))
    depth = rng.uniform(1, 4, 3000).astype(np.float32)  # two octaves fill 24 bits
    found = tiles._sorted(mi.UInt32(tile), mi.UInt32(surfel), mi.Float(depth), surfels, tile_count)
    key = (depth.view(np.uint32) - depth.view(np.uint32).min()) >> (5 if surfels == 1 << 27 else 0)
    order = np.lexsort((key, tile))
    for ours, expected in zip(found, (tile, surfel), strict=True):
        np.testing.assert_array_equal(ours.numpy(), expected[order])


def test_reference_footprints_match_textbook_intersections() -> None:
    """Tangent coordinates (a, b) of the point where a ray meets a disc: ray t = p + a σ_u u + b σ_v v."""
    scene, tested = scenes.make_scene(8), 0
    camera, raw = scene.camera, scene.raw
    to_camera, origin = camera.to_world[:3, :3].T, camera.to_world[:3, 3]
    at = np.stack([v.ravel() + 0.5 for v in np.meshgrid(range(camera.width), range(camera.height))], axis=1)
    focal, middle = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    sample = Surfel.footprint(raw, camera, Rules(), *at.T)
    axes = np.stack(rotation_axes(raw["rotation"]), axis=2)
    for i in np.flatnonzero(~Surfel.culled(raw, camera, Rules())):
        p, (u, v, _) = to_camera @ (raw["position"][i] - origin), (to_camera @ axes[i]).T
        σ, opacity = np.exp(raw["scale"][i]), 1 / (1 + np.exp(-raw["opacity"][i, 0]))
        pixel = np.argmax(sample.unclamped[i] * (sample.jump[i] > 1e-6))
        ray = np.array([*(at[pixel] - middle) / focal, 1])
        a, b, t = np.linalg.solve(np.stack([-σ[0] * u, -σ[1] * v, ray], axis=1), p)
        screen = constants.LOW_PASS_INV_VARIANCE * np.sum((at[pixel] - focal * p[:2] / p[2] - middle) ** 2)
        on_disc = t > 0 and a**2 + b**2 < screen
        rho, z = (a**2 + b**2, t) if on_disc else (screen, p[2])
        assert sample.alpha[i, pixel] == pytest.approx(min(constants.ALPHA_MAX, opacity * np.exp(-rho / 2)))
        assert sample.z[i, pixel] == pytest.approx(z)
        tested += on_disc
    assert tested > 5


def test_crossing_surfels_each_hide_the_other_on_their_own_side() -> None:
    """Two opaque, tilted discs that cross: a tile shows the nearer plane, not the nearer centre."""
    tilt = np.radians(50)
    rotation = np.array([[0, np.sin(s * tilt / 2), 0, np.cos(tilt / 2)] for s in (1, -1)])
    position = np.array([[0, 0, 0], [0, 0, 0.01]])
    raw = scenes.discs(position=position, rotation=rotation, scale=np.zeros((2, 2)))
    camera = oracle.PinholeCamera(32, 32, -50, -50, 16, 16, look_at(np.array([0, 0, 4.0]), np.zeros(3)))
    maps = scenes.fast_maps(scenes.Scene(raw, np.eye(2), camera))
    first, second = (f.numpy().reshape(32, 32)[16] for f in maps.features)
    left, right = first[11] - second[11], first[20] - second[20]
    assert left * right < 0 and min(abs(left), abs(right)) > 0.5


@BOTH
def test_features_of_the_first_table_alone(kind: Primitive, rng: np.random.Generator) -> None:
    """Where only other surfels are, only theirs are blended: with the same maps and gradients."""
    scene, few, own = kind.make(8), 1, 2
    camera = scene.fast_camera()
    columns = rng.normal(size=(4, len(scene.raw["position"]))).astype(np.float32)
    columns[few:, own:] = 0
    weights = rng.normal(size=(6, camera.width * camera.height)).astype(np.float32)
    found = []
    for count in (None, few):
        parts = (slice(own), slice(own, None))
        tables = [Surfels.from_numpy({n: x[rows] for n, x in scene.raw.items()}) for rows in parts]
        features = [mi.Float(column) for column in columns]
        dr.enable_grad(features, [table.raw for table in tables])
        blended = splat(tables, features, camera, few=count)
        maps = [*blended.features, blended.depth, blended.alpha]
        dr.backward(sum(dr.sum(mi.Float(w) * x) for w, x in zip(weights, maps, strict=True)))
        slopes = [dr.grad(x) for x in (features[0], *tables[0].raw.values(), *tables[1].raw.values())]
        found.append([x.numpy() for x in maps + slopes] + [dr.grad(x).numpy()[:own] for x in features[few:]])
    lists = list_by_tile(project(tables, camera), camera, features, few=(own, few))
    assert [count for _, count in Lanes.parts(lists)] == [4, few]
    for plain, parted in zip(*found, strict=True):
        np.testing.assert_allclose(parted, plain, rtol=1e-5, atol=2e-6 * np.abs(plain).max())


def test_second_view_compiles_nothing() -> None:
    scene = scenes.make_scene(15)
    weights = scenes.loss_weights(scene, 15)
    moved = replace(scene, camera=replace(scene.camera, cx=9.0, fx=-30.0))
    scenes.fast_gradients(scene, weights)
    misses = dr.detail.launch_stats()[2]
    scenes.fast_gradients(moved, weights)
    assert dr.detail.launch_stats()[2] == misses


@pytest.mark.parametrize("chunk", [1, 100, 20_000])
def test_candidates_in_parts_give_the_same_lists(chunk: int, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = scenes.make_scene(13)
    camera = scene.fast_camera()
    footprints = project([scene.surfels()], camera)
    whole = list_by_tile(footprints, camera)
    monkeypatch.setattr(tiles, "CHUNK", chunk)
    assert len(list(tiles._candidates(footprints, camera))) > (1 if chunk < 20_000 else 0)
    parts = list_by_tile(footprints, camera)
    for name in ("surfel_from_pair", "pair_begin", "pair_end"):
        np.testing.assert_array_equal(getattr(parts, name).numpy(), getattr(whole, name).numpy())


def test_more_pairs_than_32_bits_count_are_refused_with_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    """2¹⁶ surfels on 2¹⁶ tiles: counted in 32 bits there are none, and the image is blank."""
    monkeypatch.setattr(tiles, "CHUNK", 1 << 20)
    monkeypatch.setattr(tiles, "MAX_PAIR_BITS", 22)
    count = 1 << 16  # large discs, parallel to the image
    position = np.stack([np.zeros(count), np.zeros(count), np.linspace(2, 3, count)], axis=1)
    raw = scenes.discs(position=position, scale=np.full((count, 2), 4.0))
    camera = Camera.from_pose(1024, 1024, -500, -500, 512, 512, np.eye(4))
    with pytest.raises(InputError, match=r"65,536 tiles of 1024 × 1024 pixels; render fewer pixels"):
        splat([Surfels.from_numpy(raw)], [], camera)


@pytest.mark.parametrize("opacity", [0.9, 0.3, 0.05])
def test_the_cut_biases_gradients_by_what_is_documented(opacity: float) -> None:
    """Gradients of a footprint's mass, averaged over places in a pixel, beside the mass's own slopes."""
    scale, focal, size, places = 0.1, 60.0, 48, 6
    mass, by_size, by_opacity = 0.0, 0.0, 0.0
    for i in range(places * places):
        x, y = (k + 0.5 for k in divmod(i, places))
        shape = {"scale": np.full((1, 2), np.log(scale)), "opacity": np.log([[opacity / (1 - opacity)]])}
        surfels = Surfels.from_numpy(scenes.discs(position=[[0, 0, 1]], **shape))
        surfels.enable_grad()
        centre = (size / 2 + x / places, size / 2 + y / places)
        camera = Camera.from_pose(size, size, -focal, -focal, *centre, np.eye(4))
        total = dr.sum(splat([surfels], [], camera).alpha)
        dr.backward(total)
        mass += float(total[0]) / places**2
        by_size += dr.grad(surfels.raw["scale"]).numpy().sum() / places**2
        by_opacity += dr.grad(surfels.raw["opacity"]).numpy().sum() / places**2
    # mass = 2π s² (o - ε), with s in pixels: its slopes by log s and by the logit of o.
    area = 2 * np.pi * (scale * focal) ** 2
    assert mass == pytest.approx(area * (opacity - ALPHA_MIN), rel=5e-3)
    bias = ALPHA_MIN * np.log(opacity / ALPHA_MIN) / (opacity - ALPHA_MIN)
    assert by_size / (2 * area * (opacity - ALPHA_MIN)) - 1 == pytest.approx(-bias, abs=5e-3)
    assert by_opacity / (area * opacity * (1 - opacity)) - 1 == pytest.approx(-ALPHA_MIN / opacity, abs=5e-3)
