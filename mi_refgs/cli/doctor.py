"""`refgs doctor`: state of the installation or of a data set, problems, and the command that solves each."""

import importlib.metadata
import platform
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional

from mi_refgs import llvm
from mi_refgs.cli.command import Common, Flag, Result, optional
from mi_refgs.errors import InputError

PROBE_TIMEOUT = 60.0  # time limit of the trial kernel in seconds; it usually takes half a second

EXTRAS = {
    "lpips": "lpips", "capture": "pycolmap", "view": "viser", "export": "xatlas", "splats": "gaussforge",
    "cluster": "dask",
}  # fmt: skip
"""Extra of pyproject.toml that a command requires → a distribution that it installs."""

# Runs in a separate process, because an LLVM that cannot compile this kernel aborts instead of raising.
_PROBE = """
import mi_refgs, drjit as dr, mitsuba as mi
mi.set_variant("llvm_ad_rgb")
assert dr.minimum(dr.arange(mi.Float, 64), dr.opaque(mi.Float, 2))[63] == 2
"""


def examine() -> dict[str, Any]:
    """Examine the installation, with one small kernel in another process; versions are None if missing."""
    import drjit as dr

    cuda, version = bool(dr.has_backend(dr.JitBackend.CUDA)), dr.detail.llvm_version()
    problem = llvm.problem()
    if problem is None:
        if failure := _failure():
            problem = llvm.Problem(f"a trial kernel failed under LLVM {version[0]}: {failure}", llvm.REMEDY)
    elif cuda:
        problem = None
    return {
        "usable": problem is None,  # whether fitting and rendering can run here
        "python": platform.python_version(),
        **{name: _version(name) for name in ("mi_refgs", "mitsuba", "drjit")},
        "llvm": ".".join(str(part) for part in version) if version[0] > 0 else None,
        "cuda": cuda,
        "threads": int(dr.thread_count()),
        "extras": {name: _version(distribution) for name, distribution in EXTRAS.items()},
        "problems": [] if problem is None else [problem._asdict()],
    }


def text(report: dict[str, Any]) -> str:
    """Return the report as text: one line per part, then the problems."""
    parts = {name: report[name] or "missing" for name in ("mi_refgs", "python", "mitsuba", "drjit", "llvm")}
    parts["cuda"] = "available" if report["cuda"] else "not available (not needed)"
    parts["threads"] = report["threads"]
    for name, installed in report["extras"].items():
        parts[name] = installed or f'not installed (optional: pip install "mi_refgs[{name}]")'
    lines = [f"{name:<10}{value}" for name, value in parts.items()]
    lines += [f"PROBLEM: {each['what']}\n  type:  {each['remedy']}" for each in report["problems"]]
    return "\n".join([*lines, *(["Everything that is needed is here."] if report["usable"] else [])])


def _version(distribution: str) -> str | None:
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return None


def _failure() -> str | None:
    """Why a kernel fails in a new process; None if it runs."""
    command = [sys.executable, "-c", _PROBE]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=PROBE_TIMEOUT, check=False)
    except subprocess.TimeoutExpired:
        return f"it took longer than {PROBE_TIMEOUT:.0f} s"
    last = (done.stderr.strip().splitlines() or ["no message"])[-1]
    return None if done.returncode == 0 else f"exit status {done.returncode}, {last}"


@dataclass(frozen=True, kw_only=True)
class Doctor:
    """Exit code 1 means that the installation is unusable, 2 that a fit refuses the data.

    example:
      refgs doctor data/glossy"""

    data: Annotated[Positional[Path | None], optional("DATA")] = None
    """data set to examine instead of the installation"""
    masks: Flag = False  # write masks of images whose background has one colour into the data set
    common: Common = Common()

    def run(self) -> Result:
        if self.data is not None:
            from mi_refgs.data import checks, survey

            if self.masks:
                survey.write_masks(self.data)
            found = survey.survey(self.data)
            refused = any(check["result"] == checks.REFUSED for check in found["checks"].values())
            return Result(found, survey.survey_text(found), 2 if refused else 0)
        if self.masks:
            raise InputError("no data set is given", "--masks", remedy="name its folder")
        report = examine()
        return Result(report, text(report), 0 if report["usable"] else 1)
