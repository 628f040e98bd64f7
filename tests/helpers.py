"""Helpers of several tests: refused input, vectors, light levels, fresh processes, imports of a source."""

import ast
import contextlib
import io
import os
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any, get_type_hints

import drjit as dr
import mitsuba as mi
import numpy as np
import OpenEXR
import pytest
from tyro.conf import Suppress

from mi_refgs.cli import COMMANDS, command_class, main
from mi_refgs.data.dataset import Dataset, read_dataset
from mi_refgs.data.images import Pixels
from mi_refgs.data.view import View
from mi_refgs.errors import InputError

ROOT = Path(__file__).parents[1]


def refused(action: Sequence[object] | Callable[[], object], *words: object) -> str:
    """Require that a command (its arguments) or a call refuses its input; the message contains all `words`.

    A command exits with code 2, prints nothing on stdout, and names the remedy in one sentence. A call raises
    an InputError, or an error of Mitsuba that it caused."""
    if callable(action):
        with pytest.raises(Exception) as info:
            action()
        causes: list[BaseException] = [info.value]
        while causes[-1].__cause__ is not None:
            causes.append(causes[-1].__cause__)
        assert any(isinstance(cause, InputError) or "InputError" in str(cause) for cause in causes), causes
        assert not any(isinstance(cause, MemoryError) for cause in causes), causes
        message = " ← ".join(map(str, causes))
    else:
        out, err = io.StringIO(), io.StringIO()
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code = main([str(argument) for argument in action])
        assert code == 2 and not out.getvalue() and "Traceback" not in err.getvalue(), err.getvalue()
        lines = [line for line in err.getvalue().splitlines() if line.startswith("refgs: ")]
        message = next(line for line in reversed(lines) if "warning" not in line)
        assert "; " in message or "such as" in message, message
    for word in words:
        assert str(word) in message, message
    return message


def read_exr(path: Path) -> dict[str, np.ndarray]:
    """All channels of an EXR file by name, float32 (H, W) each."""
    with OpenEXR.File(str(path), separate_channels=True) as file:
        return {name: channel.pixels.astype(np.float32) for name, channel in file.channels().items()}


def contents(folder: Path) -> dict[str, bytes]:
    """The files of a folder, by their paths in it."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


def command_names() -> list[str]:
    return [name for group in COMMANDS.values() for name in group]


def command_options(command: str | type) -> list[str]:
    kind = command_class(command)[0] if isinstance(command, str) else command
    hints, found = get_type_hints(kind, include_extras=True), []
    for field in fields(kind):
        if is_dataclass(field.default):
            found += command_options(type(field.default))  # a group of options
        else:
            marks = hints[field.name].__metadata__ if hasattr(hints[field.name], "__metadata__") else ()
            if Suppress in marks:
                continue
            [name] = [mark.name for mark in marks if getattr(mark, "name", None)] or [field.name]
            found.append(name if "Positional" in str(marks) else f"--{name.replace('_', '-')}")
    return found


def slow(*values: Any) -> Any:
    """A case that is left out unless tests are asked for with `-m slow`."""
    return pytest.param(*values, marks=pytest.mark.slow)


AXES = np.concatenate([np.eye(3), -np.eye(3)])


def unit(d: np.ndarray) -> np.ndarray:
    """Rows of length 1."""
    return d / np.linalg.norm(d, axis=-1, keepdims=True)


def vector(d: np.ndarray) -> "mi.Vector3f":
    """(N, 3) array → mi.Vector3f."""
    return mi.Vector3f(np.ascontiguousarray(np.asarray(d).T, dtype=np.float32))


def emitted(emitter: Any, directions: np.ndarray) -> np.ndarray:
    """Radiance (N, 3) of a distant emitter from directions (N, 3) of any length."""
    si = dr.zeros(mi.SurfaceInteraction3f, len(directions))
    si.wi = -vector(unit(directions))
    return emitter.eval(si).numpy().T


def with_grad(x: Any, tangent: Any = None) -> Any:
    """The same array, or arrays, with derivatives; `tangent` is that of forward mode."""
    dr.enable_grad(x)
    if tangent is not None:
        dr.set_grad(x, tangent)
    return x


def level_maps(light: Any) -> list[np.ndarray]:
    """The levels of a prefiltered light as float64 maps (h, 2h, 3)."""
    flat = np.array(light.levels, np.float64).reshape(-1, 4)[:, :3]
    return [flat[first : first + 2 * h * h].reshape(h, 2 * h, 3) for first, h in light.operator.shapes]


def arrays_of(frame: Any) -> dict[str, np.ndarray]:
    """Every array of a frame by its name."""
    arrays = {**vars(frame), **frame.maps, **({} if frame.terms is None else vars(frame.terms))}
    known = {name: x for name, x in arrays.items() if x is not None and name not in ("maps", "terms")}
    return {name: np.array(x, np.float64) for name, x in known.items()}


def read_loaded(*arguments: Any, **options: Any) -> Dataset:
    """`read_dataset` with all views loaded."""
    data = read_dataset(*arguments, **options)
    return replace(data, views=tuple(view.load() for view in data.views))


def with_pixels(view: View, **changed: Any) -> View:
    """The view, loaded, with another `image` or `alpha`."""
    view = view.load()
    return replace(view, pixels=Pixels(view.image, view.alpha)._replace(**changed))


def run_process(
    *arguments: object,
    program: object = sys.executable,
    folder: Path = ROOT,
    package: Path = ROOT,
    environment: Mapping[str, str | None] | None = None,
    seconds: float = 300,
) -> subprocess.CompletedProcess[str]:
    """Run a program, by default Python, in a fresh process, with these variables, or without where None."""
    variables = {**os.environ, "PYTHONPATH": str(package), **(environment or {})}
    return subprocess.run(
        [str(program), *map(str, arguments)],
        cwd=folder,
        env={name: value for name, value in variables.items() if value is not None},
        capture_output=True,
        text=True,
        timeout=seconds,
        check=False,
    )


def completed(*arguments: object, **options: Any) -> str:
    """What a program prints in a fresh process, with the options of `run_process`; it has to succeed."""
    done = run_process(*arguments, **options)
    assert done.returncode == 0, (done.stdout + done.stderr)[-4000:]
    return done.stdout


def run_python(code: str, *arguments: object, folder: Path, package: Path = ROOT) -> str:
    """What `code` prints in a fresh process with warnings as errors, which finds mi_refgs below `package`."""
    return completed("-W", "error", "-c", code, *arguments, folder=folder, package=package).strip()


def imported_packages(source: str) -> set[str]:
    """First names of everything that `source` imports absolutely."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and not node.level:
            found.add((node.module or "").partition(".")[0])
    return found


def check_slopes(
    name: str, gradient: np.ndarray, values: Any, value: Callable[[str, int, Any], float], rng: Any
) -> None:
    """Gradients (N, …) of an input against one-sided differences of `value(name, point, x)` at random steps.

    Where the two sides disagree, a kink is near and the point is left out: at most a fifth of them."""
    ε, checked = 1e-6, 0
    for k, slopes in enumerate(gradient):
        x = values[k]
        step = rng.normal(size=np.shape(x))
        middle = value(name, k, x)
        left = (middle - value(name, k, x - ε * step)) / ε
        right = (value(name, k, x + ε * step) - middle) / ε
        if abs(left - right) > 1e-2 * (1 + abs(left)):
            continue
        checked += 1
        slope = float(np.sum(slopes * step))
        assert abs(slope - 0.5 * (left + right)) < 5e-3 * (1 + abs(slope)), f"{name} of point {k}"
    assert checked > 0.8 * len(gradient), name
