"""What an iteration number determines: the view, random numbers, the SH degree."""

import ast
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mi_refgs import fitting
from mi_refgs.constants import PATCH_EDGE
from mi_refgs.fitting.schedule import FitSetup
from mi_refgs.methods.fields import Window
from mi_refgs.methods.method import DataOptions, Method, Stage, SurfelOptions
from mi_refgs.shade.light.maps import Learnt
from tests.scenes.highlight import ball

DATA = ball(size=4, views=7)


def schedule(seed: int = 0) -> FitSetup:
    surfels = SurfelOptions(degree={"radiance_sh": 2}, sh_raise=Window(start=10, until=100, every=10))
    return FitSetup(Method(iterations=100, stage={"all": Stage(until=100)}, surfels=surfels, seed=seed), DATA)


def test_views_come_once_an_epoch_in_an_order_of_its_own() -> None:
    epochs = [[schedule().view(7 * epoch + i + 1) for i in range(7)] for epoch in range(5)]
    assert all(sorted(epoch) == list(range(7)) for epoch in epochs)
    assert len({tuple(epoch) for epoch in epochs}) == 5


def test_draws_follow_seed_iteration_and_operation() -> None:
    """Two operations of one iteration share no random numbers, nor does one with the next iteration."""
    keys = [(seed, i, name) for seed in (0, 1) for i in (0, 1, 2) for name in ("densify", "propagate", "r")]
    draws = [schedule(seed).rng(i, name).random() for seed, i, name in keys]
    assert len(set(draws)) == len(draws)
    assert draws == [schedule(seed).rng(i, name).random() for seed, i, name in keys]


def test_every_operation_of_an_iteration_draws_on_its_own() -> None:
    """Read off the package: `rng` is called with another name in each place."""
    trees = (ast.parse(path.read_text()) for path in Path(fitting.__file__).parent.rglob("*.py"))
    made = (node for tree in trees for node in ast.walk(tree) if isinstance(node, ast.Call))
    calls = [x.args[1] for x in made if isinstance(x.func, ast.Attribute) and x.func.attr == "rng"]
    names = [name.value for name in calls if isinstance(name, ast.Constant)]
    assert len(names) == len(calls) == len(set(names)) >= 6


@pytest.mark.parametrize("size", [(100, 80), (64, 64), (37, 201)])
def test_crops_cover_an_image_with_its_border(size: tuple[int, int]) -> None:
    """They begin at whole patches, contain no more than `crop` pixels, and reach every border."""
    setup = FitSetup(replace(schedule().method, data=DataOptions(crop=1_800)), DATA)
    parts = [setup.crop(iteration, *size) for iteration in range(400)]
    assert parts == [setup.crop(iteration, *size) for iteration in range(400)]
    seen = np.zeros(size[::-1])
    for part in parts:
        assert part is not None
        x, y, width, height = part
        assert x % PATCH_EDGE == y % PATCH_EDGE == 0 and (size[0] - width) % PATCH_EDGE == 0
        assert x + width <= size[0] and y + height <= size[1] and 900 < width * height <= 1_800
        seen[y : y + height, x : x + width] += 1
    assert seen.min() > 0.05 * seen.max()
    assert len({*parts}) > 10 and setup.crop(1, 45, 40) is None


def test_the_degree_rises_with_its_window() -> None:
    """One more at each multiple of 10 after the first, up to that of the table."""
    found = [schedule().sh_degree(iteration) for iteration in (1, 10, 19, 20, 29, 30, 99)]
    assert found == [0, 0, 0, 1, 1, 2, 2]


def test_the_light_learns_every_so_often_and_where_a_stage_ends() -> None:
    method = Method(iterations=20, stage={"a": Stage(until=10), "b": Stage(until=20)}, light=Learnt(every=4))
    assert [i for i in range(1, 21) if FitSetup(method, DATA).light_learns(i)] == [4, 8, 10, 12, 16, 20]
    assert not any(schedule().light_learns(i) for i in range(20))
