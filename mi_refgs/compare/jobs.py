"""What a comparison has to do: one job, with a run folder of its own, for each data set, method and seed."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mi_refgs.errors import InputError
from mi_refgs.evaluation.evaluate import read_metrics
from mi_refgs.files import read_json
from mi_refgs.fitting.whole import read_views, sized
from mi_refgs.methods.method import About, DataOptions, Method
from mi_refgs.methods.read import load
from mi_refgs.runs.run import Run

RUNS = "runs"
"""Folder of a comparison with its runs: runs/<data>/<variant>/seed<k>."""
SETTINGS, JOB, FAILED = "compare.json", "job.json", "failed.json"
"""Files: what all jobs of a comparison share; in a run folder, its job, and why it failed."""
MAX_SEED = 2**31 - 1


@dataclass(frozen=True)
class Job:
    """One fit and its evaluation; plain values only, so that it can travel to another process."""

    folder: str  # of the run, absolute
    data: str  # folder of the data set, absolute
    variant: str  # a shipped method's name or the absolute path of a .toml
    seed: int
    preset: str
    settings: tuple[str, ...]  # key=value
    mitsuba_variant: str
    threads: int | None  # None: every core

    @property
    def run(self) -> Run:
        """The run folder."""
        return Run(self.folder)

    @property
    def title(self) -> str:
        """Data set, variant and seed, for people."""
        return f"{Path(self.data).name} × {Path(self.variant).stem} × seed {self.seed}"

    def method(self, terms: Sequence[str] = ()) -> Method:
        """The method to run, with these of its terms; raises InputError as `load` and `sized` do."""
        method = load(self.variant, self.preset, [*self.settings, f"seed={self.seed}"], terms)
        return sized(method, Path(self.data))

    def write(self) -> None:
        """Write the job into its run folder; raises InputError if that is impossible."""
        try:
            Path(self.folder).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(
                f"{self.folder}: output: cannot be created ({error.strerror}); choose a writable folder"
            ) from error
        self.run.write_json(JOB, dataclasses.asdict(self))

    @staticmethod
    def read(folder: Path) -> Job:
        """The job of a run folder; raises InputError if it is none."""
        content = read_json(folder / JOB)
        try:
            content["settings"] = tuple(content["settings"])
            return Job(**content)
        except (KeyError, TypeError) as error:
            raise InputError(f"{folder / JOB}: not a job ({error}); remove the file") from error


def plan(
    folder: Path,
    data: Sequence[Path],
    variants: Sequence[str],
    seeds: Sequence[int],
    preset: str,
    settings: Sequence[str],
    mitsuba_variant: str,
    threads: int | None,
) -> list[Job]:
    """The jobs of a comparison in `folder`, checked: every data set has test views, every method loads.

    Seeds vary slowest, so that a comparison that is cut short has each method once. Raises InputError for a
    data set or a method that cannot be used, two of one name, and runs that were made with other settings.
    """
    _unique((absolute(path).name for path in data), "DATA", "give the folders different names")
    _unique((Path(variant).stem for variant in variants), "--variants", "name each once")
    _unique((str(seed) for seed in seeds), "--seeds", "give each once")
    for seed in seeds:
        if not 0 <= seed <= MAX_SEED:
            raise InputError(f"--seeds: {seed} is out of range; give whole numbers from 0 to {MAX_SEED}")
    if any(setting.partition("=")[0].strip() == "seed" for setting in settings):
        raise InputError("--set: seed: a comparison takes its seeds from --seeds; drop it here")
    jobs = [
        Job(
            folder=str(folder.resolve() / RUNS / absolute(path).name / Path(variant).stem / f"seed{seed}"),
            data=str(absolute(path)),
            variant=str(Path(variant).resolve()) if variant.endswith(".toml") else variant,
            seed=seed,
            preset=preset,
            settings=tuple(settings),
            mitsuba_variant=mitsuba_variant,
            threads=threads,
        )
        for seed in seeds
        for path in data
        for variant in variants
    ]
    require_settings(folder, preset, settings)
    _require_test_views(jobs)
    for job in jobs:
        require_same(job)
    return jobs


def _require_test_views(jobs: Iterable[Job]) -> None:
    """Raise InputError for a data set whose test views cannot be read as its jobs will read them."""
    read: set[tuple[str, DataOptions]] = set()
    for job in jobs:
        method = job.method()
        if (job.data, method.data) not in read:
            read_views(method, Path(job.data), "test", truth=False)
            read.add((job.data, method.data))


def require_settings(folder: Path, preset: str, settings: Sequence[str]) -> None:
    """Raise InputError if `folder` holds a comparison with another preset or other settings."""
    if not (folder / SETTINGS).is_file():
        return
    before = read_json(folder / SETTINGS)
    for option, now in (("preset", preset), ("set", list(settings))):
        if (then := before.get(option)) != now:
            raise InputError(
                f"{folder / SETTINGS}: --{option}: the comparison was begun with {_words(then)}, "
                f"not {_words(now)}; repeat that, or choose another -o"
            )


def require_same(job: Job) -> None:
    """Raise InputError if the job's folder holds a run of another method or other data."""
    if not job.run.exists():
        job.method()
        return
    made = job.run.method()
    # Neither what it is called nor where its file lies changes a run; the terms are what the run has chosen.
    before, now = (
        _flat(dataclasses.replace(method, about=About(), file=""))
        for method in (made, job.method(made.terms))
    )
    differing = sorted(key for key in before.keys() | now.keys() if before.get(key) != now.get(key))
    if differing:
        key = differing[0]
        raise InputError(
            f"{job.folder}/config.toml: {key}: the run was made with {before.get(key)}, and now it would be "
            f"{now.get(key)}; choose another -o, or remove that run"
        )
    try:
        data = job.run.dataset()
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{job.folder}/dataset.json: cannot be read ({error}); remove that run, or choose another -o"
        ) from error
    if data.resolve() != Path(job.data).resolve():
        raise InputError(
            f"{job.folder}/dataset.json: path: the run was fitted to {data}, not to {job.data}; choose "
            "another -o, or remove that run"
        )


def finished(job: Job) -> bool:
    """Whether the run was trained to its end, and has metrics of its last checkpoint on the job's data."""
    run = job.run
    if not run.exists() or not (saved := run.checkpoints()):
        return False
    metrics = read_metrics(run)
    last = run.method().iterations
    return (
        metrics is not None
        and metrics.get("iterations") == last == int(saved[-1].stem)
        and metrics.get("dataset") == job.data
    )


def jobs_in(folder: Path) -> list[Job]:
    """The jobs of all runs in a comparison's folder."""
    return [Job.read(path.parent) for path in (folder / RUNS).glob(f"*/*/*/{JOB}")]


def absolute(path: Path) -> Path:
    """The path from the root, without dots; a link keeps its own name, which is the scene's."""
    return Path(os.path.abspath(path))


def _unique(names: Iterable[str], option: str, remedy: str) -> None:
    seen: set[str] = set()
    for name in names:
        if name in seen:
            raise InputError(f"{option}: '{name}' stands there twice; {remedy}")
        seen.add(name)


def _flat(value: Any, prefix: str = "") -> dict[str, Any]:
    """Dotted keys → leaves of nested dataclasses and dictionaries."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    if not isinstance(value, dict):
        return {prefix: value}
    flat: dict[str, Any] = {}
    for name, inner in value.items():
        flat |= _flat(inner, f"{prefix}.{name}" if prefix else name)
    return flat


def _words(value: Any) -> str:
    return " ".join(map(str, value)) or "nothing" if isinstance(value, list) else str(value)
