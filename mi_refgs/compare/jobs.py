"""The jobs of a comparison: one per data set, method and seed, each with its own run folder. Files of a
comparison beside its runs: compare.json (settings), table.json and table.md."""

import contextlib
import dataclasses
import itertools
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mi_refgs import __version__
from mi_refgs.errors import InputError, require_between
from mi_refgs.evaluation.evaluate import read_metrics
from mi_refgs.evaluation.scores import SCORES
from mi_refgs.fitting.decide import differences
from mi_refgs.io.files import read_json, write_json
from mi_refgs.io.ownership import RUN, own_folder
from mi_refgs.io.progress import command_line
from mi_refgs.methods.method import DataOptions, Method
from mi_refgs.methods.read import load
from mi_refgs.runs.run import Run
from mi_refgs.runs.views import changed, measured_views, read_views, sized

RUNS = "runs"  # runs/<data>/<method>/seed<k>
SETTINGS = "compare.json"
JOB, FAILED = "job.json", "failed.json"  # of a run folder: its job, and why it failed
MAX_SEED = 2**31 - 1


@dataclass(frozen=True, kw_only=True)
class Job:
    """One fit and its evaluation, in values that can be sent to another process."""

    folder: str  # of the run, absolute
    data: str  # folder of the data set, absolute
    variant: str  # the method: a name of the package's, or the absolute path of a .toml
    seed: int
    preset: str  # this and what follows have all jobs of a comparison in common
    settings: tuple[str, ...] = ()  # KEY=VALUE
    mitsuba_variant: str = "llvm_ad_rgb"
    threads: int | None = None  # None: every core
    plugins: tuple[str, ...] = ()  # absolute paths of files to run before

    @property
    def run(self) -> Run:
        return Run(self.folder)

    @property
    def name(self) -> str:
        return Path(self.variant).stem

    @property
    def title(self) -> str:
        return f"{Path(self.data).name} × {self.name} × seed {self.seed}"

    def method(self) -> Method:
        """Load the method; raises InputError as `load` and `sized` do."""
        method = load(self.variant, self.preset, [*self.settings, f"seed={self.seed}"])
        return sized(method, Path(self.data))[0]

    def write(self) -> None:
        """Write the job into its run folder; raises InputError where that is impossible."""
        own_folder(self.run.path, RUN)
        self.run.write_json(JOB, dataclasses.asdict(self))

    @staticmethod
    def read(folder: Path) -> "Job":
        """Read the job of a run folder; raises InputError for another file."""
        content = read_json(folder / JOB)
        try:
            lists = {name: tuple(content.get(name, ())) for name in ("settings", "plugins")}
            return Job(**content | lists | {"folder": str(folder.resolve())})  # it may have been moved
        except (KeyError, TypeError) as error:
            raise InputError(f"not a job ({error})", folder / JOB, remedy="remove the file") from error


def plan(
    folder: Path, data: Sequence[Path], methods: Sequence[str], seeds: Sequence[int], **shared: Any
) -> list[Job]:
    """Plan and check the jobs of a comparison, with what they share; seeds vary slowest. Raises InputError
    for data without test views, methods that do not load, equal names, and other settings than before."""
    data = [Path(os.path.abspath(path)) for path in data]  # a link keeps its own name
    for option, names, remedy in (
        ("DATA", [path.name for path in data], "give the folders different names"),
        ("--methods", [Path(method).stem for method in methods], "name each once"),
        ("--seeds", [str(seed) for seed in seeds], "give each once"),
    ):
        if twice := [name for name in names if names.count(name) > 1]:
            raise InputError(f"'{twice[0]}' is given twice", option, remedy=remedy)
    for seed in seeds:
        require_between(seed, "--seeds", 0, MAX_SEED)
    if any(setting.partition("=")[0].strip() == "seed" for setting in shared.get("settings", ())):
        raise InputError("a comparison takes its seeds from --seeds", "--set", "seed", "drop it here")
    jobs = []
    for seed, path, method in itertools.product(seeds, data, methods):
        run = str(folder.resolve() / RUNS / path.name / Path(method).stem / f"seed{seed}")
        variant = str(Path(method).resolve()) if method.endswith(".toml") else method
        jobs.append(Job(folder=run, data=str(path), variant=variant, seed=seed, **shared))
    before = settings_of(folder)
    for option, now in (("preset", jobs[0].preset), ("set", list(jobs[0].settings))):
        if (then := before.get(option, now)) != now:
            what = f"the comparison was begun with {then}, not {now}"
            raise InputError(what, folder / SETTINGS, f"--{option}", "repeat that, or choose another -o")
    _require_test_views(folder, jobs)
    for job in jobs:
        require_same(job)
    return jobs


def settings_of(folder: Path) -> dict[str, Any]:
    """Return the settings of the comparison in a folder; none if there is no comparison."""
    return read_json(folder / SETTINGS) if (folder / SETTINGS).is_file() else {}


def begin(folder: Path, planned: Sequence[Job], workers: int, arguments: Sequence[str]) -> None:
    """Write the settings of the comparison and the jobs, which are rows of the table from now on."""
    own_folder(folder, "compare")
    for job in planned:
        job.write()
    before = settings_of(folder)
    about = {
        "data": list(dict.fromkeys([*before.get("data", []), *(job.data for job in planned)])),
        "variants": list(dict.fromkeys([*before.get("variants", []), *(job.name for job in planned)])),
        "preset": planned[0].preset,
        "set": list(planned[0].settings),
        "workers": workers,
        "command": command_line(*arguments),
        "version": __version__,
    }
    write_json(folder / SETTINGS, about, indent=2)


def _require_test_views(folder: Path, jobs: Iterable[Job]) -> None:
    """Raise InputError for test views that cannot be read, or that jobs and runs read in different sizes."""
    read: dict[tuple[str, DataOptions], list[int]] = {}
    sizes: dict[str, dict[str, list[int]]] = {}
    for job in jobs_in(folder):
        with contextlib.suppress(InputError):  # a row that says why
            if (metrics := finished(job)) is not None:
                sizes.setdefault(job.data, {})[job.title] = metrics["image_size"]
    for job in jobs:
        method = job.method()
        if (key := (job.data, method.data)) not in read:
            view = measured_views(method, Path(job.data), truth=False).views[0]
            read[key] = [view.width, view.height]
        sizes.setdefault(job.data, {})[job.title] = read[key]
    for path, found in sizes.items():
        require_one_size(path, found, "give all methods one data.downscale, as --set data.downscale=1 does")


def require_one_size(where: str, sizes: Mapping[str, list[int]], remedy: str) -> None:
    """Raise InputError for runs of different image sizes: the PSNR of one fit differs by decibels."""
    named = {tuple(size): name for name, size in sizes.items()}
    if len(named) > 1:
        each = ", ".join(f"{name} with {size[0]} × {size[1]} pixels" for size, name in named.items())
        raise InputError(f"{each}: scores of different sizes do not compare", where, "image sizes", remedy)


def require_same(job: Job) -> None:
    """Raise InputError if the job's folder has a run of another method or other data."""
    if not job.run.exists():
        return
    remedy = "choose another -o, or remove that run"
    for key, (before, now) in differences(job.run, job.method()).items():
        what = f"the run was made with {before}, and --methods, --preset or --set would make it {now}"
        raise InputError(what, f"{job.folder}/config.toml", key, remedy)
    data = job.run.dataset()
    if data is None or data.resolve() != Path(job.data).resolve():
        what = f"the run was fitted to {data or 'unknown data'}, not to {job.data}"
        raise InputError(what, f"{job.folder}/dataset.json", "DATA", remedy)
    if other := changed(read_views(job.method(), data, "train", truth=False), job.run.images()):
        what = f"{len(other)} images or cameras are not as when {job.folder} began"
        raise InputError(what, job.data, other[0], f"restore them, {remedy}")


def finished(job: Job) -> dict[str, Any] | None:
    """Return the metrics of a run that is trained to its end and whose last checkpoint is evaluated on the
    job's data; None of any other."""
    run = job.run
    if not run.exists() or not (saved := run.checkpoints()):
        return None
    metrics, last = read_metrics(run) or {}, run.method().iterations
    evaluated = metrics.get("iterations") == last == int(saved[-1].stem) and metrics.get("samples") == 1
    same = Path(metrics.get("dataset", "")).resolve() == Path(job.data).resolve()  # either may be a link
    return metrics if evaluated and same and {score.key for score in SCORES} <= metrics.keys() else None


def jobs_in(folder: Path) -> list[Job]:
    """Return the jobs of all runs in the folder of a comparison."""
    return [Job.read(path.parent) for path in (folder / RUNS).glob(f"*/*/*/{JOB}")]
