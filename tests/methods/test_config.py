"""Methods as data: every shipped file loads, presets scale it, and anything unknown is refused by name."""

from __future__ import annotations

import dataclasses
import functools
import math
import typing
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mi_refgs import methods
from mi_refgs.errors import InputError
from mi_refgs.fitting import refine
from mi_refgs.fitting.train import Trainer
from mi_refgs.methods.build import build, by_kind, by_name, plain, scaled
from mi_refgs.methods.ranges import at_least
from mi_refgs.methods.window import ITERATIONS, Window
from mi_refgs.registry import Registry
from mi_refgs.shade.shading import Shading
from mi_refgs.surfels.table import Surfels
from tests.helpers import refused
from tests.scenes.highlight import ball


@pytest.mark.parametrize("variant", methods.names())
@pytest.mark.parametrize("preset", methods.PRESETS)
def test_shipped_methods_load_and_read_back(variant: str, preset: str, tmp_path: Path) -> None:
    method = methods.load(variant, preset)
    assert method.iterations == methods.PRESETS[preset].iterations == method.stages()[-1][1].until
    path = tmp_path / "config.toml"
    path.write_text(methods.dump(method))
    assert methods.load_resolved(path) == method


@pytest.mark.parametrize("losses", [{}, {"normal": methods.LossWeight(0.5)}])
def test_a_loss_that_a_run_lacks_stays_absent(losses: dict[str, methods.LossWeight], tmp_path: Path) -> None:
    method = dataclasses.replace(methods.load("ref_gaussian"), loss=losses)
    path = tmp_path / "config.toml"
    path.write_text(methods.dump(method))
    assert methods.load_resolved(path) == method


def test_presets_scale_the_whole_schedule() -> None:
    quick, standard = methods.load("ref_gaussian", "quick"), methods.load("ref_gaussian", "standard")
    factor = standard.iterations / quick.iterations
    for name, stage in quick.stage.items():
        assert standard.stage[name].until == pytest.approx(stage.until * factor, abs=factor)
    assert quick.refine.densify is not None and standard.refine.densify is not None
    assert standard.refine.densify.until == pytest.approx(quick.refine.densify.until * factor, abs=factor)


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
    assert (short.iterations, short.surfels.count, short.surfels.max_count) == (500, 750, 1000)
    assert methods.load(short.file, short.preset, short.assignments) == short


@pytest.mark.parametrize("preset", ["", "fast", "500", "500:", "0:10", "5e2:10", "1:2:3", "-5:10"])
def test_other_presets_are_refused(preset: str) -> None:
    with pytest.raises(InputError, match="--preset"):
        methods.load("ref_gaussian", preset)


def test_a_preset_scales_every_number_of_iterations(tmp_path: Path) -> None:
    path = tmp_path / "long.toml"
    path.write_text(
        "iterations = 4000\n[light]\n[stage.first]\nuntil = 1000\n[stage.last]\nuntil = 4000\n"
        "[refine.propagate]\nwhen = {start = 0, until = 4000, every = 100}\nhold = 200\n"
        "[loss]\nsmooth = { weight = 1, until = 3000 }\n"
        "[data]\ncoarse = [{ until = 1000, block = 2, least = 400 }, { until = 400, block = 4 }]\n"
    )
    method = methods.load(str(path), "quick")
    assert method.iterations == 2000 and [stage.until for _, stage in method.stages()] == [500, 2000]
    assert method.refine.propagate is not None
    assert (method.refine.propagate.hold, method.loss["smooth"].until) == (100, 1500)
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
    waiting: list[Any] = [methods.Method]
    for kind in waiting:
        hints = typing.get_type_hints(kind) if dataclasses.is_dataclass(kind) and kind is not Window else {}
        for field in dataclasses.fields(kind) if hints else ():
            counts = field.name in names or field.name.endswith(("_start", "_rise", "_until"))
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
        expected = [None, *np.diff(due).tolist()]
        assert [window.since(i) for i in due] == expected[: len(due)]


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
[mesh]
extract = { start = 1_111, until = 5_001, every = 567 }
[refine]
densify = { start = 200, until = 3_001, every = 130 }
reset = { start = 0, until = 1_999, every = 444 }
propagate = { when = { start = 0, until = 2_601, every = 650 } }
"""
"""Few of these numbers are whole, or multiples of each other, once a preset has scaled them."""


EVENTS = {
    "ref_gaussian": dict(degree=2, densify=14, reset_opacity=1, mesh=8),
    "ref_gaussian_paper": dict(
        degree=3, densify=48, reset_opacity=8, propagate_normals=16, mesh=16, restart=1
    ),
    "many": dict(degree=3, densify=22, reset_opacity=4, propagate_normals=4, mesh=7, restart=1),
}
"""Numbers of events that differ between methods."""


@pytest.mark.parametrize("variant", EVENTS)
def test_every_preset_has_the_same_events_in_the_same_order(
    variant: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What a trainer does over the whole fit, its steps left out."""
    (tmp_path / "many.toml").write_text(MANY_EVENTS)
    path = str(tmp_path / "many.toml") if variant == "many" else variant
    done: list[str] = []

    def recorder(name: str, result: Callable[[Surfels], Any]) -> Callable[..., Any]:
        def record(surfels: Surfels, *_: object, **__: object) -> Any:
            done.append(name)
            return result(surfels)

        return record

    def same(surfels: Surfels) -> refine.TableEdit:
        rows = np.arange(surfels.count, dtype=np.uint32)
        return refine.TableEdit(surfels, rows, rows < 0)

    monkeypatch.setattr(refine, "densify_and_prune", recorder("densify", same))
    for name in ("reset_opacity", "propagate_normals", "restart"):
        monkeypatch.setattr(refine, name, recorder(name, lambda surfels: surfels))
    monkeypatch.setattr(Trainer, "extract_mesh", lambda self, cameras: done.append("mesh"))
    monkeypatch.setattr(Trainer, "_gradient_step", lambda *_: None)
    monkeypatch.setattr(Shading, "resolve", staticmethod(functools.cache(Shading.resolve)))
    sequences = {}
    for preset in methods.PRESETS:
        method = methods.load(path, preset, ["surfels.count=20", "surfels.max_count=20", "light.height=8"])
        trainer = Trainer(method, ball())
        done.clear()
        while trainer.iteration < method.iterations:
            degree = trainer.setup.sh_degree(trainer.iteration)
            trainer.step()
            done += ["degree"] * (trainer.setup.sh_degree(trainer.iteration) - degree)
        sequences[preset] = list(done)
    assert sequences["quick"] == sequences["standard"] == sequences["paper"]
    assert Counter(sequences["quick"]) == EVENTS[variant]


def test_assignments_are_applied_unscaled() -> None:
    changes = ["loss.ssim=0.3", "mesh.resolution=64", "refine.densify.until=7"]
    method = methods.load("ref_gaussian", "quick", changes)
    assert method.mesh is not None and method.refine.densify is not None
    assert (method.loss["ssim"].weight, method.mesh.resolution, method.refine.densify.until) == (0.3, 64, 7)


STAGE = "iterations = 10\n[stage.a]\nuntil = 10\n"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (f"{STAGE}[loss.smooth]\nend = 1", ["loss.smooth: unknown key 'end'"]),
        (f"{STAGE}[loss]\nsmooth = true", ["loss.smooth: expected a table", "True"]),
        ("iterations = 10\n[stage.a]\nuntil = 'x'", ["until", "expected int"]),
        (f"{STAGE}at = 'voxel'", ["'voxel' is not allowed", "surfel"]),
        ("iterations = 10", ["missing key 'stage'"]),
        ("[stage.a]\nuntil = 10", ["missing key 'iterations'"]),
        ("iterations = [", ["not valid TOML"]),
        (
            f"{STAGE}[refine]\nreset = {{start = 0, until = 9, every = 0}}",
            ["refine.reset", "'every' above 0"],
        ),
        (f"{STAGE}[data]\ncoarse = [{{until = 5, block = 1}}]", ["data.coarse.block: 1", "2 or more"]),
        (f"{STAGE}[data]\ncrop = 4000", ["data.crop: 4000", "4,096 or more"]),
        (f"{STAGE}[light]\nevery = 0", ["light.every: 0", "1 or more"]),
        (f"{STAGE}[cameras]\nrate = -1", ["cameras.rate: -1", "0 or more"]),
        (f"{STAGE}[cameras]\ncorrections = 'maybe'", ["cameras.corrections: 'maybe'", "judged or on or off"]),
    ],
)
def test_bad_files_are_named(text: str, words: list[str], tmp_path: Path) -> None:
    path = tmp_path / "own.toml"
    path.write_text(text)
    refused(lambda: methods.load(str(path)), "own.toml", *words)


def test_unknown_names_list_the_known_ones() -> None:
    with pytest.raises(InputError, match="ref_gaussian"):
        methods.load("no_such_method")
    with pytest.raises(InputError, match="standard"):
        methods.load("ref_gaussian", "slow")


def test_extends_changes_only_what_it_says(tmp_path: Path) -> None:
    child = tmp_path / "child.toml"
    child.write_text('extends = "ref_gaussian"\n[loss]\nssim = 0.5\n')
    base, changed = methods.load("ref_gaussian"), methods.load(str(child))
    assert changed.loss == base.loss | {"ssim": methods.LossWeight(0.5)}
    assert dataclasses.replace(changed, loss=base.loss, name=base.name, file=base.file) == base
    assert changed.name == "child"


@pytest.mark.parametrize("base", methods.names())
def test_extends_takes_every_shipped_method_and_own_files(base: str, tmp_path: Path) -> None:
    """A shipped method that extends another one, and an own file beside or below the one that names it."""
    (tmp_path / "below").mkdir()
    (tmp_path / "below" / "own.toml").write_text(f'extends = "{base}"\n[loss]\nssim = 0.5\n')
    grandchild = tmp_path / "grandchild.toml"
    grandchild.write_text('extends = "below/own.toml"\ndrop = ["refine"]\n[loss]\nnormal = 0.3\n')
    shipped, changed = methods.load(base), methods.load(str(grandchild))
    normal = dataclasses.replace(shipped.loss["normal"], weight=0.3)
    assert changed.loss == shipped.loss | {"ssim": methods.LossWeight(0.5), "normal": normal}
    assert changed.refine.densify is None and changed.refine.reset is None
    same = dataclasses.replace(changed, loss=shipped.loss, refine=shipped.refine, name=base, file=base)
    assert same == shipped


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('extends = "own.toml"', ["own.toml: extends: the file extends itself", "break"]),
        ('extends = "other.toml"', ["own.toml: extends: the file extends itself"]),
        ('extends = "gone.toml"', ["own.toml: extends: gone.toml: no such method", "ref_gaussian"]),
        ('extends = "ref_gausian"', ["own.toml: extends: ref_gausian: no such method", "ref_gaussian"]),
        ("extends = 3", ["own.toml: extends: expected a name", "3"]),
        ('extends = "ref_gaussian"\ndrop = "mesh"', ["own.toml: drop: expected a list"]),
        ('extends = "ref_gaussian"\ndrop = ["seed.x"]', ["own.toml: drop: no key 'seed.x'"]),
        ('drop = ["mesh"]', ["own.toml: extends: expected a name", "None"]),
        ('extends = "wrong.toml"', ["wrong.toml: not valid TOML"]),
    ],
)
def test_wrong_extends_are_named(text: str, words: list[str], tmp_path: Path) -> None:
    (tmp_path / "own.toml").write_text(text + "\n")
    (tmp_path / "other.toml").write_text('extends = "own.toml"\n')
    (tmp_path / "wrong.toml").write_text("[")
    refused(lambda: methods.load(str(tmp_path / "own.toml")), *words)


def test_an_unknown_primitive_is_refused() -> None:
    chosen = methods.load("ref_gaussian", "quick", ["surfels.primitive='gaussian'"])
    assert chosen.surfels.columns("scale") == 3
    for table in ("surfels", "surroundings"):
        with pytest.raises(InputError, match=rf"{table}\.primitive: 'ball' is unknown; use surfel or gauss"):
            methods.load("ref_gaussian", "quick", [f"{table}.primitive='ball'"])


def test_a_purpose_is_one_files_own(tmp_path: Path) -> None:
    """`--for` finds one method; a file that extends it is for something else."""
    assert methods.for_purpose("relighting") == "relighting"
    purposes = [methods.load(name).about.purpose for name in methods.names()]
    assert sorted(filter(None, purposes)) == ["photographs", "relighting"]
    own = tmp_path / "own.toml"
    own.write_text('extends = "relighting"\n[about]\nname = "mine"\n')
    assert methods.load(str(own)).about.purpose == ""
    for word in ("", "speed"):
        with pytest.raises(InputError, match=r"--for.*relighting"):
            methods.for_purpose(word)


SURROUNDINGS = dict(count=0, degree=4, max_count=-1)
"""Values out of range."""


@pytest.mark.parametrize(
    ("assignment", "words"),
    [
        ("stage.deferred.rates.tint=2.0", "stage.deferred.rates: 'tint' is unknown"),
        ("stage.deferred.rates.metallic=-1.0", "stage.deferred.rates: -1.0 is out of range"),
        ("stage.deferred.rates.light=nan", "out of range"),
        ("surfels.from_images=['metallic']", "metallic"),
        ("surfels.attributes=['metallic', 'roughness']", "albedo"),
        ("refine.grow=-0.1", r"refine\.grow: -0\.1"),
        ("loss.ssim=1.5", r"loss\.ssim\.weight: 1.5 is out of range; give a number from 0 to 1"),
        ("loss.normal=-0.1", r"loss\.normal\.weight: -0.1 is out of range; give 0 or more"),
        *((f"loss.normal.{key}=-5", rf"loss\.normal\.{key}: -5") for key in ("start", "rise", "until")),
        ("losses.ssim=1", "--set: unknown key 'losses'"),
        ("loss", "--set: loss: expected key=value"),
        ("iterations.x=1", "--set: iterations.x: 'iterations' is not a table"),
        *(
            (f"surroundings.{key}={value}", rf"surroundings\.{key}: .*; give")
            for key, value in SURROUNDINGS.items()
        ),
    ],
)
def test_bad_settings_are_named(assignment: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        methods.load("relighting", "quick", [assignment])


@pytest.mark.parametrize("change", [".loss.normal=0.7", "={loss={normal=0.7}}"])
def test_a_component_has_its_assigned_changes(tmp_path: Path, change: str) -> None:
    """They reach the trial, and a run of it is resumed by the same assignment."""
    assigned = [f"select.component.surfels_2x.change{change}"]
    made = methods.load("auto", "quick", assigned, ["surfels_2x"])
    assert made.loss["normal"].weight == 0.7 != methods.load("auto", "quick", assigned).loss["normal"].weight
    (tmp_path / "config.toml").write_text(methods.dump(made))
    assert not methods.differences(methods.load_resolved(tmp_path / "config.toml"), made)


def test_nothing_is_assigned_to_what_a_component_drops() -> None:
    """Settings of the light or a stage do not bring them back, nor change what a component decides."""
    settings = [
        "stage.deferred.samples=4",
        "stage.initial.rates={opacity=0.1}",
        "light.height=64",
        "light.every=1",
    ]
    settings += ["mesh.resolution=64", "rates.attribute.albedo=0.1", "surfels.initial.metallic=0.5"]
    settings += ["surfels.degree.radiance_sh=1"]
    plain = methods.load("auto", "quick", [], ["colour_alone"])
    made = methods.load("auto", "quick", settings, ["colour_alone"])
    assert dataclasses.replace(made, assignments=()) == plain and made.light is None is made.mesh
    assert methods.load("auto", "quick", settings).stage["deferred"].samples == 4
    made = methods.load("auto", "quick", ["loss.normal=0.7", "surfels.capacity=3"], ["surfels_2x"])
    assert made.loss["normal"].weight == 0.7 and made.surfels.capacity == 2


def test_trials_begin_with_no_more_surfels_than_the_selection_says() -> None:
    """Presets that allow more start as `quick`; presets that allow fewer, and settings, count."""
    counts = {
        preset: (method.surfels.count, method.surfels.max_count)
        for preset in ("quick", "standard", "paper", "500:1000")
        for method in [methods.load("auto", preset)]
    }
    assert counts == dict.fromkeys(("quick", "standard", "paper"), (15_000, 20_000)) | {
        "500:1000": (750, 1000)
    }
    assert methods.load("auto", "standard", ["surfels.max_count=50000"]).surfels.max_count == 50_000
    assert methods.load("ref_gaussian", "standard").surfels.max_count == 40_000


def test_components_keep_what_python_changed() -> None:
    """A `Method` that was changed is tried with its changes; those of a component come first."""
    method = methods.load("auto", "quick", ["loss.ssim=0.3"])
    rates = dataclasses.replace(method.rates, decay=0.7)
    own = dataclasses.replace(method.downscaled(3), seed=5, rates=rates, log_every=7)
    more = methods.with_components(own, ["surfels_2x"])
    assert (more.seed, more.log_every, more.data.downscale, more.rates) == (5, 7, 3, rates)
    assert more.surfels.capacity == 2 and more.loss["ssim"].weight == 0.3
    alone = methods.with_components(more, ["colour_alone"])
    assert alone.seed == 5 and alone.surfels.capacity == 1 and alone.light is None
    assert alone.rates == methods.load("auto", "quick", [], ["colour_alone"]).rates
    assert alone.data.downscale == 3 and alone.data.coarse != own.data.coarse
    assert methods.with_components(alone, []) == dataclasses.replace(own, rates=methods.load("auto").rates)


def test_a_stage_sets_every_shading_option() -> None:
    options = ["dominant=true", "visibility_rays=4", "antialias=true"]
    method = methods.load("ref_gaussian", "quick", [f"stage.deferred.{option}" for option in options])
    shading = method.stage["deferred"].shading
    assert shading.chosen() == ["dominant", "visibility_rays", "antialias"]
    for wrong in ("visibility_rays=0", "occlusion=true", "dominant=1"):
        with pytest.raises(InputError, match=wrong.partition("=")[0]):
            methods.load("ref_gaussian", "quick", [f"stage.deferred.{wrong}"])


@dataclasses.dataclass(frozen=True)
class Lamp:
    """A kind of thing, of which another one has no `height`."""

    name: typing.ClassVar = "lamp"
    height: int = dataclasses.field(default=4, metadata=ITERATIONS | at_least(2))


@dataclasses.dataclass(frozen=True)
class Bulb:
    name: typing.ClassVar = "bulb"
    on: Window = methods.method.AT_ONCE


KINDS = Registry[Any]("kind")
KINDS.register(Lamp)
KINDS.register(Bulb)


@dataclasses.dataclass(frozen=True)
class House:
    """Values that a registry builds: a table of each name, and a table of one kind."""

    room: dict[str, Any] = dataclasses.field(default_factory=dict, metadata=by_name(KINDS))
    hall: Any = dataclasses.field(default=None, metadata=by_kind(KINDS, "lamp"))


def test_a_registry_builds_tables() -> None:
    table = {"room": {"lamp": {"height": 8}, "bulb": {}}, "hall": {"kind": "bulb"}}
    house = build(House, table)
    assert house == House({"lamp": Lamp(8), "bulb": Bulb()}, Bulb())
    assert build(House, plain(house)) == house
    half = Bulb(Window(0, 1.5, 0.5))
    assert scaled(house, 0.5) == House({"lamp": Lamp(4), "bulb": half}, half)
    assert build(House, {"hall": {}}).hall == Lamp()
    refused(lambda: build(House, {"room": {"tv": {}}}), "room: 'tv' is unknown; use lamp or bulb")
    refused(lambda: build(House, {"hall": {"kind": "tv"}}), "hall.kind: 'tv' is unknown; use lamp or bulb")
    refused(
        lambda: build(House, {"room": {"lamp": {"height": 1}}}), "room.lamp.height: 1 is out of range; give 2"
    )
    refused(lambda: build(House, {"hall": 3}), "hall: expected a table, found 3")
