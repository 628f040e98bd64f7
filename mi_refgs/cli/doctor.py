"""`refgs doctor`: state of the installation or of a data set, problems, and the command that solves each."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import re
import subprocess
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional

from mi_refgs import __version__, llvm
from mi_refgs.cli.command import Common, Result, optional

PROBE_TIMEOUT = 60.0
"""Time limit of the trial kernel in seconds; it usually takes half a second."""

EXTRAS = {
    "lpips": "lpips",
    "flip": "flip-evaluator",
    "capture": "pycolmap",
    "view": "viser",
    "export": "xatlas",
}
"""Extra of pyproject.toml that a command requires → a distribution that it installs."""

# Runs in a separate process, because an LLVM that cannot compile this kernel aborts instead of raising.
_PROBE = """
import mi_refgs, drjit as dr, mitsuba as mi
from mi_refgs.kernels.device import simd_width
mi.set_variant("llvm_ad_rgb")
assert dr.minimum(dr.arange(mi.Float, 64), dr.opaque(mi.Float, 2))[63] == 2
print(simd_width())
"""


def examine() -> dict[str, Any]:
    """Examine the installation; runs one small kernel in a separate process (about 0.5 s).

    Versions are None for missing parts. Each of `problems` says `what` it is, and a `remedy`.
    """
    import drjit as dr

    cuda, version = bool(dr.has_backend(dr.JitBackend.CUDA)), dr.detail.llvm_version()
    problem, width = llvm.problem(), None
    if problem is None:
        width, failure = _probe()
        if failure:
            what = f"a trial kernel failed under LLVM {version[0]}: {failure}"
            problem = llvm.Problem(what, llvm.REMEDY)
    elif cuda:
        problem = None
    return {
        "usable": problem is None,  # whether fitting and rendering can run here
        "mi_refgs": __version__,
        "python": platform.python_version(),
        "platform": f"{platform.system()} {platform.machine()}",
        "mitsuba": _version("mitsuba"),
        "drjit": _version("drjit"),
        "llvm_version": ".".join(str(part) for part in version) if version[0] > 0 else None,
        "llvm_path": _loaded_library(),
        "cuda": cuda,
        "threads": int(dr.thread_count()),
        "simd_width": width,
        "kernel_cache": os.environ.get("DRJIT_CACHE_DIR", str(Path.home() / ".drjit")),
        "extras": {name: _version(distribution) for name, distribution in EXTRAS.items()},
        "problems": [] if problem is None else [asdict(problem)],
    }


def text(report: dict[str, Any]) -> str:
    """Return the report as text: one line per part, then the problems."""
    version, width = report["llvm_version"], report["simd_width"]
    found = {
        "mi_refgs": report["mi_refgs"],
        "Python": f"{report['python']} on {report['platform']}",
        "Mitsuba": report["mitsuba"] or "missing",
        "Dr.Jit": report["drjit"] or "missing",
        "LLVM": f"{version} ({report['llvm_path']})" if version else "missing",
        "CUDA": "available" if report["cuda"] else "not available (not needed)",
        "threads": report["threads"],
        "SIMD width": f"{width} floats" if width else "unknown",
        "kernel cache": report["kernel_cache"],
    }
    for name, installed in report["extras"].items():
        found[name] = installed or f'not installed (optional: pip install "mi_refgs[{name}]")'
    lines = [f"{name:<13}{value}" for name, value in found.items()]
    lines += [f"PROBLEM: {each['what']}\n  type:  {each['remedy']}" for each in report["problems"]]
    return "\n".join([*lines, *(["Everything that is needed is here."] if report["usable"] else [])])


def _version(distribution: str) -> str | None:
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return None


def _loaded_library() -> str | None:
    """Return the libLLVM of this process from its memory map (Linux), else the one in the environment."""
    maps = Path("/proc/self/maps")
    if maps.exists():
        found = re.findall(r"/\S*libLLVM[^\s/]*", maps.read_text())
        named = os.path.realpath(os.environ.get(llvm.ENVIRONMENT_VARIABLE, ""))
        return named if named in found else next(iter(found), None)
    return os.environ.get(llvm.ENVIRONMENT_VARIABLE)


def _probe() -> tuple[int | None, str | None]:
    """Run one kernel in a new process; returns the SIMD width in floats and the failure, None each."""
    try:
        done = subprocess.run(
            [sys.executable, "-c", _PROBE], capture_output=True, text=True, timeout=PROBE_TIMEOUT, check=False
        )
    except subprocess.TimeoutExpired:
        return None, f"it took longer than {PROBE_TIMEOUT:.0f} s"
    if done.returncode == 0:
        return int(done.stdout), None
    last = (done.stderr.strip().splitlines() or ["no message"])[-1]
    return None, f"exit status {done.returncode}, {last}"


@dataclass(frozen=True, kw_only=True)
class Doctor:
    """Exit code 1 means that the installation is unusable.

    example:
      refgs doctor data/glossy
    """

    data: Annotated[Positional[Path | None], optional("DATA")] = None
    """data set to examine instead of the installation"""
    common: Common = Common()

    def run(self) -> Result:
        """Examine the data set or the installation."""
        if self.data is not None:
            from mi_refgs.data.survey import survey, survey_text

            found = survey(self.data)
            return Result(found, survey_text(found))
        report = examine()
        return Result(report, text(report), 0 if report["usable"] else 1)
