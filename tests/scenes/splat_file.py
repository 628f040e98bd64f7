"""A ball of Gaussians as a PLY file of another program, and small imports of it that are fitted."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mi_refgs.methods.read import PRESETS
from mi_refgs.reconstruction import relightable_import
from tests.helpers import unit
from tests.scenes.layouts import ply_bytes

COUNT, RADIUS = 300, 0.5
SIZE, VIEWS = 32, {"train": 6, "test": 2}
PRESET = "6:100"


def ball_columns(**values: float) -> dict[str, np.ndarray]:
    """Opaque Gaussians on a sphere, coloured by their normals; values of the first one may be others."""
    direction = unit(np.random.default_rng(0).normal(size=(COUNT, 3)))
    columns = dict(zip("xyz", RADIUS * direction.T, strict=True))
    columns |= {f"f_dc_{i}": c for i, c in enumerate(direction.T)}
    columns |= {f"scale_{i}": np.full(COUNT, np.log(0.06)) for i in range(3)}
    columns |= {f"rot_{i}": np.full(COUNT, float(i == 0)) for i in range(4)}
    columns["opacity"] = np.full(COUNT, 4.0)
    for name, value in values.items():
        columns[name][0] = value
    return {name: column.astype(np.float32) for name, column in columns.items()}


def write_ball(path: Path, **values: float) -> Path:
    path.write_bytes(ply_bytes(ball_columns(**values)))
    return path


def render_few_views(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make imports render few small views."""
    small = {"standard": replace(PRESETS["standard"], pixels=SIZE**2)}
    monkeypatch.setattr(relightable_import, "PRESETS", small)
    monkeypatch.setattr(relightable_import, "VIEWS", VIEWS)
