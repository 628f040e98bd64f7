"""The paper's settings for its data sets, `scenes/paper`: each loads, and says what the paper's code does."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from mi_refgs import methods
from mi_refgs.io.resources import resource_dir
from tests.helpers import ROOT

FOLDER = resource_dir("scenes")
FILES = sorted(path.relative_to(FOLDER) for path in (FOLDER / "paper").rglob("*.toml"))
NAMES = [str(path.with_suffix("")) for path in FILES]
SMOOTH = {"ball": 1.0, "helmet": 1.0, "tbell": 1.0, "gardenspheres": 0.45}
DOWNSCALE = {"gardenspheres": 4, "toycar": 4, "sedan": 8}
TABLES = json.loads((ROOT / "benchmarks" / "paper_tables.json").read_text())["data_sets"]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("preset", ["quick", "paper"])
def test_each_loads_and_is_read_back(name: str, preset: str, tmp_path: Path) -> None:
    method = methods.load(name, preset)
    (tmp_path / "config.toml").write_text(methods.dump(method))
    assert methods.load_resolved(tmp_path / "config.toml") == method
    assert methods.load(method.file, preset) == method  # as a fit does that tries terms


@pytest.mark.parametrize("name", [name for name in NAMES if name.count("/") == 2 and "open" not in name])
def test_settings_are_those_of_the_scene(name: str) -> None:
    _, folder, scene = name.split("/")
    method = methods.load(name, "paper")
    assert method.loss["smooth"].weight == SMOOTH.get(scene, 0.0)
    assert method.data.downscale == DOWNSCALE.get(scene, 1)
    real = folder == "ref_real"
    assert method.data.background == ("black" if real else "white")
    first, second = (stage for _, stage in method.stages())
    share = 3 / 20 if real else 18 / 50
    assert first.until == pytest.approx(share * method.iterations) and second.until == method.iterations
    assert first.shading.reflectance == ("radiance" if real else "split_sum")
    assert bool(second.restart) != real


def test_every_scene_of_the_tables_has_settings() -> None:
    for data in TABLES.values():
        if data["folder"] == "nerf_synthetic":  # the paper names no settings for it
            continue
        for words in data["scenes"].values():
            assert f"paper/{data['folder']}/{words[0]}" in NAMES
