"""Methods as data: every shipped file loads, presets scale it, and anything unknown is refused by name."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from mi_refgs.errors import InputError
from mi_refgs.fit import config


@pytest.mark.parametrize("variant", config.names())
@pytest.mark.parametrize("preset", config.PRESETS)
def test_shipped_methods_load_and_read_back(variant: str, preset: str, tmp_path: Path) -> None:
    method = config.load(variant, preset)
    assert method.iterations == config.PRESETS[preset].iterations == method.stages()[-1][1].until
    path = tmp_path / "config.toml"
    path.write_text(config.dump(method))
    assert config.load_resolved(path) == method


def test_presets_scale_the_whole_schedule() -> None:
    quick, standard = config.load("ref_gaussian", "quick"), config.load("ref_gaussian", "standard")
    factor = standard.iterations / quick.iterations
    for name, stage in quick.stage.items():
        assert standard.stage[name].until == pytest.approx(stage.until * factor, abs=factor)
    assert quick.refine.densify is not None and standard.refine.densify is not None
    assert standard.refine.densify.until == pytest.approx(quick.refine.densify.until * factor, abs=factor)


def test_stages_and_windows_meet_without_gap_or_overlap() -> None:
    method = config.load("ref_gaussian", "quick")
    names = [method.stage_at(i)[0] for i in range(1, method.iterations + 1)]
    order = [name for name, _ in method.stages()]
    assert sorted(set(names), key=names.index) == order
    window = config.Window(2, 8, 3)
    assert [i for i in range(12) if window.due(i)] == [3, 6]
    assert [window.since(i) for i in (3, 4, 6, 7, 9, 20)] == [None, 1, 3, 1, 3, 14]


def test_assignments_are_applied_unscaled() -> None:
    method = config.load(
        "ref_gaussian", "quick", ["loss.ssim=0.3", "mesh.resolution=64", "refine.densify.until=7"]
    )
    assert method.mesh is not None and method.refine.densify is not None
    assert (method.loss.ssim, method.mesh.resolution, method.refine.densify.until) == (0.3, 64, 7)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            "iterations = 10\n[stage.a]\nuntil = 10\n[loss]\nsim = 1",
            ["own.toml", "loss", "unknown key 'sim'"],
        ),
        ("iterations = 10\n[stage.a]\nuntil = 'x'", ["own.toml", "until", "expected int"]),
        (
            "iterations = 10\n[stage.a]\nuntil = 10\nat = 'voxel'",
            ["own.toml", "'voxel' is not allowed", "surfel"],
        ),
        ("iterations = 10", ["own.toml", "missing key 'stage'"]),
        ("[stage.a]\nuntil = 10", ["own.toml", "missing key 'iterations'"]),
        ("iterations = [", ["own.toml", "not valid TOML"]),
    ],
)
def test_bad_files_are_named(text: str, words: list[str], tmp_path: Path) -> None:
    path = tmp_path / "own.toml"
    path.write_text(text)
    with pytest.raises(InputError) as error:
        config.load(str(path))
    assert all(word in str(error.value) for word in words), error.value


@pytest.mark.parametrize("assignment", ["loss.sim=1", "loss", "iterations.x=1"])
def test_bad_assignments_are_named(assignment: str) -> None:
    with pytest.raises(InputError, match=r"--set|unknown key"):
        config.load("ref_gaussian", "quick", [assignment])


def test_unknown_names_list_the_known_ones() -> None:
    with pytest.raises(InputError, match="ref_gaussian"):
        config.load("no_such_method")
    with pytest.raises(InputError, match="standard"):
        config.load("ref_gaussian", "slow")


def test_extends_changes_only_what_it_says(tmp_path: Path) -> None:
    child = tmp_path / "child.toml"
    child.write_text('extends = "ref_gaussian"\n[loss]\nssim = 0.5\n')
    base, changed = config.load("ref_gaussian"), config.load(str(child))
    assert changed.loss == dataclasses.replace(base.loss, ssim=0.5)
    assert dataclasses.replace(changed, loss=base.loss, variant=base.variant) == base
    assert Path(child).stem == changed.variant
