"""The estimate of a fit, the size that it chooses, and the speed that it is made of."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
from test_train import METHOD
from tiny_scene import write_data

from mi_refgs import methods
from mi_refgs.cli import main
from mi_refgs.data.picture_files import PictureFile
from mi_refgs.fitting import plan
from mi_refgs.fitting import speed as speeds
from mi_refgs.methods.method import CoarsePictures, DataOptions, Method
from mi_refgs.methods.surroundings import SurroundingsOptions

SPEED = speeds.Speed({"initial": [1.0, 5.0], "deferred": [2.0, 10.0]}, 3.0, 0.5)
"""Seconds at 10² and 20² pixels: (P - 25) / 75 and twice as long."""


@pytest.fixture
def method(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Method:
    monkeypatch.setattr(speeds, "SIZES", (10, 20))
    path = tmp_path / "small.toml"
    path.write_text(METHOD)
    return dataclasses.replace(methods.load_resolved(path), data=DataOptions())


def test_an_estimate_is_the_sum_of_the_stages(method: Method) -> None:
    """8 iterations of the first, 22 of the second, three meshes of 7 views, the files; coarse ones apart."""
    at_100 = 8 * 1 + 22 * 2
    others = plan.START + 3 * (3.0 + 7 * 0.5)
    found = plan.estimate(method, SPEED, 7, (21, 20), 2)
    assert found.seconds == pytest.approx(others + 7 * 420 * plan.DECODING + at_100) and found.width == 10
    at_400 = 8 * 5 + 22 * 10
    whole = plan.estimate(method, SPEED, 7, (20, 20), 1)
    assert whole.seconds == pytest.approx(others + 7 * 400 * plan.DECODING + at_400)
    coarse = DataOptions(coarse=(CoarsePictures(6, 2), CoarsePictures(12, 2)))
    partly = plan.estimate(dataclasses.replace(method, data=coarse), SPEED, 7, (20, 20), 1)
    assert partly.seconds == pytest.approx(others + 7 * 400 * plan.DECODING + 8 * 1 + 4 * 2 + 18 * 10)
    assert whole.bytes - found.bytes == pytest.approx(300 * (plan.PER_PIXEL + 7 * (12 + 19)))
    around = dataclasses.replace(method, surroundings=SurroundingsOptions(max_count=50))
    more = plan.estimate(around, SPEED, 7, (20, 20), 1).bytes - whole.bytes
    assert more == pytest.approx(50 * plan.PER_SURFEL)
    scene = plan.estimate(method, SPEED, 7, (20, 20), 1, cut_out=False)
    assert whole.seconds - scene.seconds == pytest.approx((plan.GROWTH - plan.OPEN_GROWTH) * at_400)
    tiny = plan.estimate(method, SPEED, 7, (1, 1), 1)
    assert tiny.seconds == pytest.approx(others + 7 * plan.DECODING + 0.5 * at_100)  # never next to nothing


def test_the_largest_pictures_that_fit_the_time_are_chosen(
    method: Method, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of 20 × 20 pixels; a size that the method says stays, and nothing is decoded meanwhile."""
    data = write_data(tmp_path / "data", truth=False)
    for name, value in {"speed_of": lambda *_: SPEED, "WORTH": 0, "LEAST": 5}.items():
        monkeypatch.setattr(plan, name, value)
    monkeypatch.setattr(PictureFile, "decode", lambda file: pytest.fail("decoded"))
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
    assert factor == 4 and "no size of pictures" in said[1]
    kept = dataclasses.replace(method, data=DataOptions(downscale=1))
    assert chosen(1.0, kept) == (1, [])
    promised = dataclasses.replace(method, preset="standard")
    assert plan.planned(promised, data)[0].data.downscale == 1
    promised = dataclasses.replace(method, preset="quick")
    assert plan.planned(promised, data)[0].data.downscale == 2
    monkeypatch.setattr(plan, "WORTH", 1e7)
    small, nothing = plan.planned(method, data, 1.0)
    assert nothing is None and small.data.downscale == 1


@pytest.mark.parametrize("cut_out", [True, False])
def test_the_speed_is_measured_once(
    cut_out: bool, method: Method, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of every stage, with the mesh, and with surroundings where pictures have no alpha."""
    monkeypatch.setenv("DRJIT_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(speeds, "_busy", lambda: False)
    monkeypatch.setattr(speeds, "SIZES", (16, 32))
    around = SurroundingsOptions(count=60, max_count=60, height=8)
    method = dataclasses.replace(method, surroundings=around)
    meshes, real = [], speeds._mesh

    def mesh(trainer: speeds.Trainer) -> tuple[float, float]:
        meshes.append((trainer.open, len(trainer.data.views)))
        return real(trainer)

    monkeypatch.setattr(speeds, "_mesh", mesh)
    speed = speeds.speed_of(method, cut_out)
    assert {*speed.stages} == {"initial", "deferred"} and meshes == 2 * [(not cut_out, speeds.VIEWS)]
    assert all(0 < seconds < 60 for both in speed.stages.values() for seconds in both)
    assert speed.mesh + speed.mesh_view > 0
    monkeypatch.setattr(speeds, "measured", lambda *_: pytest.fail("measured again"))
    assert speeds.speed_of(method, cut_out) == speed
    assert speeds.speed_of(dataclasses.replace(method, seed=7, file="other"), cut_out) == speed
    monkeypatch.setattr(speeds, "measured", lambda *_: SPEED)
    assert speeds.speed_of(method, not cut_out) == SPEED
    other = dataclasses.replace(method, surfels=dataclasses.replace(method.surfels, count=99))
    assert speeds.speed_of(other, cut_out) == SPEED and speeds.speed_of(method, cut_out) == speed
    monkeypatch.setattr(speeds, "_busy", lambda: True)  # then it is the speed of now alone
    kept = (tmp_path / speeds.SPEED_FILE).read_text()
    assert speeds.speed_of(dataclasses.replace(other, log_every=1), cut_out) == SPEED
    assert (tmp_path / speeds.SPEED_FILE).read_text() == kept
    (tmp_path / speeds.SPEED_FILE).write_text("{")
    assert speeds.speed_of(method, cut_out) == SPEED


def test_no_time_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = write_data(tmp_path / "data", truth=False)
    assert main(["train", str(data), "-o", str(tmp_path / "run"), "--minutes", "0"]) == 2
    assert "--minutes: 0.0 is no time; give more than 0" in capsys.readouterr().err
