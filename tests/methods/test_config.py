"""Methods as data: every shipped file loads, presets scale it, and anything unknown is refused by name."""

import dataclasses
import functools
import math
import typing
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from mi_refgs import methods
from mi_refgs.errors import InputError
from mi_refgs.fitting.events.densify import Densify
from mi_refgs.fitting.events.mesh import ExtractMesh
from mi_refgs.fitting.events.propagate import Propagate
from mi_refgs.fitting.train import Trainer
from mi_refgs.io.files import resource_dir
from mi_refgs.methods.build import scaled
from mi_refgs.methods.extensions import EVENTS as REGISTERED
from mi_refgs.methods.fields import ITERATIONS, Window
from mi_refgs.shade.shading import Shading
from tests.helpers import refused
from tests.scenes.highlight import ball
from tests.scenes.tiny import write_method

FOLDER = resource_dir("scenes")
OF_SCENES = [str(path.relative_to(FOLDER).with_suffix("")) for path in (FOLDER / "paper").rglob("*.toml")]


@pytest.mark.parametrize("variant", [*methods.names(), *sorted(OF_SCENES)])
@pytest.mark.parametrize("preset", methods.PRESETS)
def test_shipped_methods_load_and_read_back(variant: str, preset: str, tmp_path: Path) -> None:
    method = methods.load(variant, preset)
    assert methods.load(method.file, preset) == method  # as a fit does that tries terms
    assert method.iterations == methods.PRESETS[preset].iterations == method.stages()[-1][1].until
    path = tmp_path / "config.toml"
    for losses in (method.loss, {"normal": methods.LossWeight(0.5)}, {}):  # one that a run lacks stays absent
        fitted = dataclasses.replace(method, loss=losses)
        path.write_text(methods.dump(fitted))
        assert methods.load_resolved(path) == fitted


def test_a_preset_of_numbers_scales_as_a_named_one() -> None:
    """With the numbers of `quick`, the method is that of `quick`; other ones survive a reload by its name."""
    quick = methods.PRESETS["quick"]
    assert quick.surfels == 0.75 * quick.max_surfels
    named, numbers = (
        dataclasses.replace(methods.load("ref_gaussian", preset), preset="")
        for preset in ("quick", f"{quick.iterations}:{quick.max_surfels}")
    )
    assert named == numbers
    short = methods.load("auto", "500:1000")
    assert methods.load(short.file, short.preset, short.assignments) == short


@pytest.mark.parametrize("preset", ["", "fast", "500", "500:", "0:10", "5e2:10", "1:2:3", "-5:10"])
def test_other_presets_are_refused(preset: str) -> None:
    refused(lambda: methods.load("ref_gaussian", preset), "--preset")


def test_a_preset_scales_every_number_of_iterations(tmp_path: Path) -> None:
    path = write_method(
        tmp_path,
        "iterations = 4000\n[light]\n[stage.first]\nuntil = 1000\n[stage.last]\nuntil = 4000\n"
        "[event.propagate]\nwhen = {start = 0, until = 4000, every = 100}\nhold = 200\n"
        "[loss]\nsmooth = { weight = 1, until = 3000 }\n"
        "[data]\ncoarse = [{ until = 1000, block = 2, least = 400 }, { until = 400, block = 4 }]\n",
    )
    method = methods.load(str(path), "quick")
    assert method.iterations == 2000 and [stage.until for _, stage in method.stages()] == [500, 2000]
    propagate = method.event["propagate"]
    assert isinstance(propagate, Propagate) and (propagate.hold, method.loss["smooth"].until) == (100, 1500)
    assert [method.data.block_at(i, 1600) for i in (1, 200, 201, 500, 501)] == [4, 4, 2, 2, 1]
    assert [method.data.block_at(i, 1599) for i in (1, 200, 201, 501)] == [4, 4, 1, 1]


def test_only_declared_fields_are_scaled() -> None:
    """A field that is called like one that counts iterations stays what it is; nothing is lost below it."""

    @dataclasses.dataclass(frozen=True)
    class Other:
        until: int = 8
        hold: int = dataclasses.field(default=8, metadata=ITERATIONS)
        after: dict[str, Window] = dataclasses.field(default_factory=lambda: {"a": Window(0, 8, 2)})

    assert scaled(Other(), 0.5) == Other(8, 4, {"a": Window(0, 4, 1)})
    assert scaled(Other(hold=0), 0.5).hold == 0 and scaled(Other(hold=1), 0.1).hold == 1


def test_every_number_of_iterations_is_declared() -> None:
    """The intervals of checkpoints, previews and logs are of the run, not of its schedule."""
    names = {"start", "rise", "until", "hold", "after", "trial", "iterations"}
    waiting: list[Any] = [methods.Method, *REGISTERED.values()]
    for kind in waiting:
        hints = typing.get_type_hints(kind) if dataclasses.is_dataclass(kind) and kind is not Window else {}
        for field in dataclasses.fields(kind) if hints else ():
            counts = field.name in names and "int" in str(hints[field.name])
            assert (ITERATIONS.items() <= field.metadata.items()) == counts, f"{kind.__name__}.{field.name}"
        waiting += [part for hint in hints.values() for part in (hint, *typing.get_args(hint))]
        waiting += [] if hints else typing.get_args(kind)


def test_stages_and_windows_meet_without_gap_or_overlap() -> None:
    method = methods.load("ref_gaussian", "quick")
    names = [method.stage_at(i)[0] for i in range(1, method.iterations + 1)]
    order = [name for name, _ in method.stages()]
    assert sorted(set(names), key=names.index) == order
    assert [names[stage.until - 1] for _, stage in method.stages()] == order
    window = methods.Window(2, 8, 3)
    assert [i for i in range(12) if window.due(i)] == [3, 6]
    assert [window.since(i) for i in (3, 4, 6, 7, 9, 20)] == [None, 1, 3, 1, 3, 14]


@settings(deadline=None)
@given(
    st.integers(0, 500),
    st.integers(0, 3000),
    st.integers(1, 400),
    st.sampled_from([2_000 / 6_000, 4_000 / 6_000, 50_000 / 6_000, 1.0]) | st.floats(0.1, 20),
)
def test_a_scaled_window_keeps_its_events(start: int, length: int, every: int, factor: float) -> None:
    """The k-th event of the file is the k-th of the preset, at its own time times the factor, rounded."""
    until = start + length
    events = [k for k in range(1, until // every + 1) if k * every > start]
    window = scaled(methods.Window(start, until, every), factor)
    last = math.ceil(factor * until) + 1
    assert window.count(last) == len(events)
    due = [i for i in range(last + 1) if window.due(i)]
    if factor * every >= 1:
        np.testing.assert_allclose(due, [factor * every * k for k in events], atol=0.5 + 1e-6)
        assert [window.since(i) for i in due] == [None, *np.diff(due).tolist()][: len(due)]


MANY_EVENTS = """
iterations = 7_000
[surfels]
attributes = ["radiance_sh", "albedo", "metallic", "roughness"]
sh_raise = { start = 0, until = 1_000, every = 333 }
[light]
[stage.one]
until = 1_111
at = "surfel"
diffuse = "irradiance"
[stage.two]
until = 7_000
restart = ["metallic"]
[event]
mesh.when = { start = 1_111, until = 5_001, every = 567 }
densify.when = { start = 200, until = 3_001, every = 130 }
reset_opacity.when = { start = 0, until = 1_999, every = 444 }
propagate.when = { start = 0, until = 2_601, every = 650 }
"""
"""Few of these numbers are whole, or multiples of each other, once a preset has scaled them."""


def test_every_preset_has_the_same_events(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What a trainer does over the whole fit, its steps left out."""
    path, done = write_method(tmp_path, MANY_EVENTS), list[str]()
    for kind in REGISTERED.values():
        monkeypatch.setattr(kind, "apply", lambda event, trainer: done.append(event.name))
    monkeypatch.setattr(Propagate, "due", Propagate._grows)
    monkeypatch.setattr(Trainer, "gradient_step", lambda *_: None)
    monkeypatch.setattr(Shading, "resolve", staticmethod(functools.cache(Shading.resolve)))
    sequences = {}
    for preset in methods.PRESETS:
        small = ["surfels.count=20", "surfels.max_count=20", "light.height=8"]
        method = methods.load(str(path), preset, small)
        trainer = Trainer(method, ball())
        done.clear()
        while trainer.iteration < method.iterations:
            degree = trainer.setup.sh_degree(trainer.iteration)
            trainer.step()
            done += ["degree"] * (trainer.setup.sh_degree(trainer.iteration) - degree)
        sequences[preset] = list(done)
    assert sequences["quick"] == sequences["standard"] == sequences["paper"]
    expected = dict(degree=3, densify=22, reset_opacity=4, propagate=4, mesh=7, restart=1)
    assert Counter(sequences["quick"]) == expected


def test_assignments_are_applied_unscaled() -> None:
    changes = ["loss.ssim=0.3", "event.mesh.resolution=64", "event.densify.when.until=7"]
    method = methods.load("ref_gaussian", "quick", changes)
    mesh, densify = method.event["mesh"], method.event["densify"]
    assert isinstance(mesh, ExtractMesh) and isinstance(densify, Densify)
    assert (method.loss["ssim"].weight, mesh.resolution, densify.when.until) == (0.3, 64, 7)
    assert "mesh" not in methods.load("ref_gaussian", "quick", ["event.mesh=false"]).event
    methods.load("ref_gaussian", "quick", ["event.cameras=false"])  # it has none


STAGE = "iterations = 10\n[stage.a]\nuntil = 10\n"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (f"{STAGE}[loss.smooth]\nend = 1", ["loss.smooth: unknown key 'end'"]),
        (f"{STAGE}[loss]\nsmooth = true", ["loss.smooth: expected a table", "True"]),
        ("iterations = 10\n[stage.a]\nuntil = 'x'", ["until", "expected int"]),
        (f"{STAGE}at = 'voxel'", ["'voxel' is not allowed", "surfel"]),
        ("iterations = 10", ["missing key 'stage'"]),
        ("iterations = [", ["not valid TOML"]),
        (f"{STAGE}[event.mesh]\nwhen = {{start = 0, until = 9, every = 0}}", ["mesh.when", "above 0"]),
        (f"{STAGE}[data]\ncoarse = [{{until = 5, block = 1}}]", ["data.coarse.block: 1", "2 or more"]),
        (f"{STAGE}[event.cameras]\nafter = -1", ["event.cameras.after: -1", "0 or more"]),
        (f"{STAGE}[event.camera]", ["event: 'camera' is unknown", "cameras"]),
        ('extends = "own.toml"', ["extends: the file extends itself", "break"]),
        ('extends = "other.toml"', ["extends: the file extends itself"]),
        ('extends = "gone.toml"', ["extends: gone.toml: no such method", "ref_gaussian"]),
        ("extends = 3", ["extends: expected a name", "3"]),
        ('extends = "ref_gaussian"\ndrop = "event"', ["drop: expected a list"]),
        ('extends = "ref_gaussian"\ndrop = ["seed.x"]', ["drop: no key 'seed.x'"]),
        ('drop = ["event"]', ["extends: expected a name", "None"]),
        ('extends = "wrong.toml"', ["wrong.toml: not valid TOML"]),
    ],
)
def test_bad_files_are_named(text: str, words: list[str], tmp_path: Path) -> None:
    for name, content in {"own": text, "other": 'extends = "own.toml"', "wrong": "["}.items():
        (tmp_path / f"{name}.toml").write_text(content + "\n")
    refused(lambda: methods.load(str(tmp_path / "own.toml")), f"{tmp_path}", *words)


def test_extends_changes_only_what_it_says(tmp_path: Path) -> None:
    """An own file that extends one below it, which extends a shipped one."""
    (tmp_path / "below").mkdir()
    (tmp_path / "below" / "own.toml").write_text('extends = "auto"\n[loss]\nssim = 0.5\n')
    child = tmp_path / "child.toml"
    child.write_text('extends = "below/own.toml"\ndrop = ["event.densify"]\n[loss]\nnormal = 0.3\n')
    base, changed = methods.load("auto"), methods.load(str(child))
    normal = dataclasses.replace(base.loss["normal"], weight=0.3)
    assert changed.loss == base.loss | {"ssim": methods.LossWeight(0.5), "normal": normal}
    assert changed.event == {name: x for name, x in base.event.items() if name != "densify"}
    same: dict[str, Any] = dict(loss=base.loss, event=base.event, name=base.name, file=base.file)
    assert changed.name == "child" and dataclasses.replace(changed, **same) == base


def test_a_purpose_is_one_files_own(tmp_path: Path) -> None:
    """`--for` finds one method; a file that extends it is for something else."""
    assert methods.for_purpose("relighting") == "relighting"
    purposes = [methods.load(name).about.purpose for name in methods.names()]
    assert sorted(filter(None, purposes)) == ["photographs", "relighting"]
    own = write_method(tmp_path, 'extends = "relighting"\n[about]\nname = "mine"\n')
    assert methods.load(str(own)).about.purpose == ""
    for word in ("", "speed"):
        with pytest.raises(InputError, match=r"--for.*relighting"):
            methods.for_purpose(word)


@pytest.mark.parametrize(
    ("assignment", "words"),
    [
        ("stage.deferred.rates.tint=2.0", "stage.deferred.rates: 'tint' is unknown"),
        ("stage.deferred.rates.metallic=-1.0", "stage.deferred.rates: -1.0 is out of range"),
        ("surfels.attributes=['metallic', 'roughness']", "albedo"),
        ("loss.normal.rise=-5", r"loss\.normal\.rise: -5 is out of range; give 0 or more"),
        ("losses.ssim=1", "--set: unknown key 'losses'"),
        ("event.densfy=false", "--set: event: 'densfy' is unknown; did you mean densify"),
        ("seed=-1", "seed: -1 is out of range"),
        ("log_every=0", "log_every: 0 is out of range; give 1 or more"),
        ("preview_every=0", "preview_every: 0"),
        ("checkpoint_every=0", "checkpoint_every: 0"),
        ("rates.light=-1.0", r"rates\.light: -1"),
        ("rates.decay=0.0", r"rates\.decay: 0"),
        ("rates.attribute.position=-1.0", r"rates\.attribute: -1"),
        ("light.radiance=-3.0", r"light\.radiance: -3"),
        ("light={kind='constant', radiance=0.0}", r"light\.radiance: 0"),
        ("loss", "--set: loss: expected key=value"),
        ("iterations.x=1", "--set: iterations.x: 'iterations' is not a table"),
        ("surroundings.count=0", r"surroundings\.count: .*; give"),
        ("surfels.primitive='ball'", r"surfels\.primitive: 'ball' is unknown; use surfel or gauss"),
        ("light.kind='tv'", r"light\.kind: 'tv' is unknown; use learnt"),
        ("light=3", "light: expected a table, found 3"),
        ("stage.deferred.visibility_rays=0", "visibility_rays"),
    ],
)
def test_bad_settings_are_named(assignment: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        methods.load("relighting", "quick", [assignment])


def test_a_method_limits_what_presets_allow() -> None:
    """Presets that allow more start as `quick`; presets that allow fewer, and settings, count."""
    for preset, counts in {"standard": (15_000, 20_000), "500:1000": (750, 1000)}.items():
        surfels = methods.load("auto", preset).surfels
        assert (surfels.count, surfels.max_count) == counts
    assert methods.load("auto", "standard", ["surfels.max_count=50000"]).surfels.max_count == 50_000
    assert methods.load("ref_gaussian", "standard").surfels.max_count == 40_000
    few = methods.load("photographs", "quick")
    assert few.surroundings is not None and few.surfels.count == few.surroundings.count == 15_000
