"""The estimate of a fit, the size that it chooses, and the speed that it is made of."""

from __future__ import annotations

import dataclasses
import json
import time
from pathlib import Path
from typing import Any

import pytest

from mi_refgs.cli import main
from mi_refgs.fitting import cost_model, plan
from mi_refgs.fitting.train import Trainer
from mi_refgs.kernels import memory
from mi_refgs.methods.method import (
    CoarseImages,
    DataOptions,
    MetalTrial,
    Method,
    MethodComponent,
    Rates,
    Selection,
    SurroundingsOptions,
)
from mi_refgs.methods.read import PRESETS
from mi_refgs.splat import Camera
from tests.scenes.highlight import small_method
from tests.scenes.tiny import write_data

SPEED = cost_model.Speed({"initial": [1.0, 5.0], "deferred": [2.0, 10.0]}, 3.0, 0.5)
"""Seconds at 10² and 20² pixels: (P - 25) / 75 and twice as long."""


@pytest.fixture
def method(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Method:
    monkeypatch.setattr(cost_model, "SIZES", (10, 20))
    return dataclasses.replace(small_method(tmp_path), data=DataOptions())


@pytest.fixture
def data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Images of 20 × 20 pixels that may be downscaled, on a machine of SPEED."""
    for name, value in {"speed_of": lambda *_: SPEED, "WORTH": 0, "LEAST": 5, "SMALL_IMAGE": 399}.items():
        monkeypatch.setattr(plan, name, value)
    return write_data(tmp_path / "data", truth=False)


def test_estimate_is_sum_of_stages(method: Method) -> None:
    """8 iterations of the first, 22 of the second, three meshes of 7 views, the files; coarse ones apart."""
    at_100 = 8 * 1 + 22 * 2
    others = plan.START + 3 * (3.0 + 7 * 0.5)
    found = plan.estimate(method, SPEED, 7, (21, 20), 2)
    assert found.seconds == pytest.approx(others + 7 * 420 * plan.DECODING + at_100) and found.width == 10
    at_400 = 8 * 5 + 22 * 10
    whole = plan.estimate(method, SPEED, 7, (20, 20), 1)
    assert whole.seconds == pytest.approx(others + 7 * 400 * plan.DECODING + at_400)
    coarse = DataOptions(coarse=(CoarseImages(6, 2), CoarseImages(12, 2)))
    partly = plan.estimate(dataclasses.replace(method, data=coarse), SPEED, 7, (20, 20), 1)
    assert partly.seconds == pytest.approx(others + 7 * 400 * plan.DECODING + 8 * 1 + 4 * 2 + 18 * 10)
    assert whole.bytes - found.bytes == pytest.approx(300 * (memory.PER_PIXEL + 7 * (12 + 19)))
    crop = dataclasses.replace(method, data=DataOptions(coarse=(CoarseImages(6, 2),), crop=200))
    part = plan.estimate(crop, SPEED, 7, (20, 20), 1)
    assert part.seconds == pytest.approx(
        others + 7 * 400 * plan.DECODING + 6 * 1 + 2 * (119 / 75) + 22 * 2 * (119 / 75)
    )
    around = dataclasses.replace(method, surroundings=SurroundingsOptions(max_count=50))
    more = plan.estimate(around, SPEED, 7, (20, 20), 1).bytes - whole.bytes
    assert more == pytest.approx(50 * memory.PER_SURFEL)
    scene = plan.estimate(method, SPEED, 7, (20, 20), 1, has_alpha=False)
    before = plan.OPEN_START + 7 * plan.STEREO
    assert scene.seconds - before == pytest.approx(whole.seconds - (plan.GROWTH - plan.OPEN_GROWTH) * at_400)
    assert (
        plan.estimate(method, SPEED, 99, (1, 1), 1, has_alpha=False).seconds
        < plan.estimate(method, SPEED, 99, (1, 1), 1).seconds + plan.OPEN_START + 65 * plan.STEREO
    )  # stereo compares 64 views at most
    twice = plan.estimate(dataclasses.replace(method, metal_trial=MetalTrial(11)), SPEED, 7, (20, 20), 1)
    assert twice.seconds - whole.seconds == pytest.approx(8 * 5 + 3 * 10)
    tiny = plan.estimate(method, SPEED, 7, (1, 1), 1)
    assert tiny.seconds == pytest.approx(others + 7 * plan.DECODING + 0.5 * at_100)  # never next to nothing


def test_largest_images_within_time_limit_are_chosen(
    method: Method, data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Images have 20 × 20 pixels; a size that the method says stays."""
    seconds = [plan.estimate(method, SPEED, 3, (20, 20), factor).seconds for factor in (1, 2, 3, 4)]
    assert sorted(seconds, reverse=True) == seconds

    def chosen(limit: float, wanted: Method = method) -> tuple[int | None, list[str]]:
        said: list[str] = []
        made, expected = plan.planned(wanted, data, limit / plan.SAFETY, said.append)
        assert made.data.downscale is not None and expected is not None
        assert expected.seconds == seconds[made.data.downscale - 1]
        return made.data.downscale, said

    assert chosen(seconds[0] + 1e-6) == (1, [])
    factor, said = chosen(seconds[0] - 1e-6)
    assert factor == 2 and "20 × 20 pixels are read as 10 × 10" in said[0] and len(said) == 1
    assert chosen(seconds[1] - 1e-6)[0] == 3
    factor, said = chosen(1.0)
    assert factor == 4 and "the fit takes 50 s, more than 1 s" in said[1]
    kept = dataclasses.replace(method, data=DataOptions(downscale=1))
    assert chosen(1.0, kept) == (1, [])
    promised = dataclasses.replace(method, preset="standard")
    assert plan.planned(promised, data)[0].data.downscale == 1
    promised = dataclasses.replace(method, preset="quick")
    assert plan.planned(promised, data)[0].data.downscale == 2
    monkeypatch.setattr(plan, "WORTH", 401 * method.iterations)
    monkeypatch.setattr(plan, "speed_of", lambda *_: pytest.fail("measured"))
    small, nothing = plan.planned(method, data, 1.0)
    assert nothing is None and small.data.downscale == 1


def test_images_are_no_larger_than_the_surfels_can_show(method: Method, data: Path) -> None:
    """20 × 20 pixels need 25 surfels, those of optional components included; a size that is given stays."""

    def chosen(surfels: int, capacity: float = 1.0, **data_options: Any) -> tuple[int | None, list[str]]:
        tried = {"more": MethodComponent(1, 1, {"surfels": {"capacity": capacity}})}
        wanted = dataclasses.replace(
            method,
            select=Selection(tried),
            surfels=dataclasses.replace(method.surfels, max_count=surfels),
            data=DataOptions(**data_options),
        )
        said: list[str] = []
        return plan.planned(wanted, data, 1e6, said.append)[0].data.downscale, said

    assert chosen(25) == (1, []) and chosen(13, capacity=2.0) == (1, [])
    factor, said = chosen(24)
    assert factor == 2 and "read as 10 × 10, so that 24 surfels can show them" in said[0]
    assert chosen(24, downscale=1) == (1, [])


def test_surfels_beyond_the_time_limit_are_not_tried(method: Method, data: Path) -> None:
    """The image size is chosen first; twice or four times the surfels have to fit into what is left."""
    tried = {
        "colour": MethodComponent(1, 1),
        "twice": MethodComponent(1, 1, {"surfels": {"capacity": 2}}),
        "fourfold": MethodComponent(2, 1, {"surfels": {"capacity": 4}}, needs=("twice",)),
    }
    method = dataclasses.replace(method, select=Selection(tried))
    one, two, four = (
        plan.estimate(method, SPEED, 3, (20, 20), 1, capacity=capacity).seconds
        for capacity in (1.0, 2.0, 4.0)
    )
    steps = 8 * 5 + 22 * 10
    assert two - one == pytest.approx(0.45 * steps) and four - one == pytest.approx((1.45**2 - 1) * steps)
    for seconds, names in ((one, ["colour"]), (two, ["colour", "twice"]), (four, [*tried])):
        said: list[str] = []
        made, expected = plan.planned(method, data, (seconds + 1e-6) / plan.SAFETY, said.append)
        assert len(said) == (len(names) < 3) and all("are not tried" in text for text in said)
        assert made.select is not None and [*made.select.component] == names
        assert made.data.downscale == 1 and expected is not None and expected.seconds == one


@pytest.mark.parametrize("preset", ["", *PRESETS])
@pytest.mark.parametrize("limit", [None, 1e-3])
def test_small_images_are_never_downscaled_unasked(
    preset: str, limit: float | None, method: Method, data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """400 pixels where that many are small, whatever the preset and the time; where 399 are, they are."""
    monkeypatch.setattr(plan, "SMALL_IMAGE", 400)
    method = dataclasses.replace(method, preset=preset)
    said: list[str] = []
    chosen, expected = plan.planned(method, data, limit, said.append)
    assert chosen.data.downscale == 1 and expected is not None and expected.width == 20
    assert (limit is None) == (not said) and all("data.downscale=2" in text for text in said)
    assert plan.SMALL_IMAGE == 400 and all(made.pixels >= 256**2 for made in PRESETS.values())
    monkeypatch.setattr(plan, "SMALL_IMAGE", 399)
    assert limit is None or plan.planned(method, data, limit)[0].data.downscale == 4


class Machine:
    """Clocks that steps and meshes of known cost move; the wall's shows what others do as well."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.busy, self.steps, self.cpu, self.wall = 1.0, 0, 0.0, 0.0
        self.meshes: list[int] = []
        monkeypatch.setattr(plan.time, "thread_time", lambda: self.cpu)
        monkeypatch.setattr(plan.time, "perf_counter", lambda: self.wall)
        monkeypatch.setattr(Trainer, "step", lambda trainer: self.step(trainer))
        monkeypatch.setattr(Trainer, "extract_mesh", lambda _, cameras: self.extract(cameras))

    def work(self, seconds: float) -> None:
        self.cpu, self.wall = self.cpu + seconds, self.wall + self.busy * seconds

    def step(self, trainer: Trainer) -> None:
        """Take 1 + P seconds, later 2 + P; each seventh step is disturbed."""
        self.steps += 1
        trainer.fit.iteration += 1
        view = trainer.data.views[0]
        late = trainer.method.stage_at(trainer.iteration)[0] == "deferred"
        self.work(1 + late + view.width * view.height + 5 * (self.steps % 7 == 0))

    def extract(self, cameras: list[Camera]) -> None:
        """Take 3 seconds, and 0.5 per view."""
        self.meshes.append(len(cameras))
        self.work(3 + 0.5 * len(cameras))


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "cache"
    monkeypatch.setenv(cost_model.FOLDER_VARIABLE, str(folder))
    return folder


def test_speed_is_measured_once_and_stays_on_busy_machine(
    method: Method, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is CPU time, and of one machine and one kind of method; damaged files are measured anew."""
    machine = Machine(monkeypatch)
    expected = cost_model.Speed({"initial": [101.0, 401.0], "deferred": [102.0, 402.0]}, 3.0, 0.5)
    machine.busy = 3.0
    speed = plan.speed_of(method, True)
    calls: list[Method] = []

    def measured(method: Method, has_alpha: bool) -> cost_model.Speed:
        calls.append(method)
        return expected

    monkeypatch.setattr(plan, "measured", measured)
    assert speed == expected and machine.meshes[:2] == [plan.VIEWS, plan.VIEWS]
    [file] = cache.glob("speed-*.json")

    def measurements(wanted: Method = method, has_alpha: bool = True) -> int:
        calls.clear()
        assert plan.speed_of(wanted, has_alpha) == expected
        return len(calls)

    assert measurements() == 0
    alike = dataclasses.replace(method, seed=7, file="other", rates=Rates(light=0.5), iterations=29)
    assert measurements(alike) == 0 and measurements(method, False) == 1
    larger = dataclasses.replace(method, surfels=dataclasses.replace(method.surfels, count=99))
    assert measurements(larger) == 1 == 1 - measurements(larger) and measurements() == 0
    kept = json.loads(file.read_text())
    for damage in (
        "{",
        "[]",
        json.dumps(kept | {"subject": kept["subject"] | {"cpu": "another"}}),
        json.dumps(kept | {"speed": {"stages": {}}}),
        json.dumps(kept | {"speed": kept["speed"] | {"stages": {"initial": [1.0]}}}),
        json.dumps(kept | {"speed": kept["speed"] | {"stages": {"initial": [1.0, -1.0]}}}),
        json.dumps(kept | {"speed": kept["speed"] | {"mesh": float("nan")}}),
    ):
        file.write_text(damage)
        assert measurements() == 1 and json.loads(file.read_text()) == kept
    assert any("3 measured with" in text for text in cost_model.summary())
    machines = plan.machine()
    for name, value in {"threads": 99, "cpu": "another", "mitsuba": "0"}.items():
        monkeypatch.setattr(plan, "machine", lambda name=name, value=value: machines | {name: value})
        assert measurements() == 1
    monkeypatch.setattr(plan, "machine", lambda: machines)
    monkeypatch.setattr(plan, "simd_width", lambda: 99)
    assert measurements() == 1


def test_cache_that_cannot_be_written_is_no_error(
    method: Method, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(plan, "measured", lambda *_: SPEED)
    (tmp_path / "file").write_text("")
    monkeypatch.setenv(cost_model.FOLDER_VARIABLE, str(tmp_path / "file" / "cache"))
    assert plan.speed_of(method, True) == SPEED and cost_model.summary() == []


def test_real_steps_are_measured(method: Method, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every stage is measured, with the background of images without alpha."""
    monkeypatch.setattr(cost_model, "SIZES", (16, 32))
    around = SurroundingsOptions(count=60, max_count=60, height=8)
    method = dataclasses.replace(method, surroundings=around)
    begin = time.thread_time()
    speed = plan.measured(method, False)
    taken = time.thread_time() - begin
    assert {*speed.stages} == {"initial", "deferred"}
    each = [seconds for both in speed.stages.values() for seconds in both]
    assert min(each) > 1e-4  # a kernel alone takes longer
    meshes = plan.REPEATS * (speed.mesh + plan.VIEWS * speed.mesh_view)
    assert plan.REPEATS * plan.TIMED * sum(each) + meshes < taken


def test_tests_keep_away_from_users_cache() -> None:
    """In this process and in those that it starts."""
    assert Path.home() / ".cache" not in [cost_model.folder(), *cost_model.folder().parents]


def test_cache_is_where_user_keeps_caches(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(cost_model.FOLDER_VARIABLE)
    monkeypatch.setenv("XDG_CACHE_HOME", "/caches")
    assert cost_model.folder() == Path("/caches/mi_refgs")
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert cost_model.folder() == Path.home() / ".cache" / "mi_refgs"


def test_no_time_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = write_data(tmp_path / "data", truth=False)
    assert main(["train", str(data), "-o", str(tmp_path / "run"), "--minutes", "0"]) == 2
    assert "--minutes: 0.0 is no time; give more than 0" in capsys.readouterr().err
