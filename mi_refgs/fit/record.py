"""The run folder: readable without this package, written atomically, resumable.

config.toml  dataset.json  metrics.jsonl  checkpoints/  previews/      written while it is fitted
surfels.ply  envmap.exr  mesh.ply  scene.xml  model.json               by `fit.export`
metrics.json  contact_sheet.png  eval/                                 by `fit.evaluate`
"""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.device import upload_tensor
from mi_refgs.errors import InputError
from mi_refgs.files import write_bytes
from mi_refgs.fit.config import Method, dump, load_resolved

CHECKPOINTS_KEPT = 2
"""One could be enough, since a checkpoint appears only when complete; two survive a disk that lies."""

PARAMS = "params/"
"""What the names of parameters begin with in a checkpoint."""


def tensors(state: Mapping[str, np.ndarray], prefix: str) -> dict[str, Any]:
    """The tensors of a checkpoint whose names begin with a prefix, by the rest of their names."""
    return {
        name.removeprefix(prefix): upload_tensor(value)
        for name, value in state.items()
        if name.startswith(prefix)
    }


class Run:
    """A run folder."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)

    def create(self, method: Method, dataset: str) -> None:
        """Start a run; raises InputError if the folder holds one already or cannot be written."""
        if (self.path / "config.toml").exists():
            raise InputError(
                f"{self.path}: holds a run already; add --resume to go on with it, or choose another -o"
            )
        try:
            for folder in ("checkpoints", "previews"):
                (self.path / folder).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(
                f"{self.path}: cannot be created ({error.strerror}); choose a writable folder with -o"
            ) from error
        write_bytes(self.path / "dataset.json", json.dumps({"path": dataset}).encode())
        write_bytes(self.path / "config.toml", dump(method).encode())

    def method(self) -> Method:
        """The resolved method; raises InputError if this is no run folder."""
        if not (self.path / "config.toml").is_file():
            raise InputError(
                f"{self.path}: config.toml: missing; give the folder that `refgs train -o` wrote"
            )
        return load_resolved(self.path / "config.toml")

    def dataset(self) -> Path:
        """Folder of the data set that the run was fitted to."""
        return Path(json.loads((self.path / "dataset.json").read_text())["path"])

    # ---------------- checkpoints ----------------

    def checkpoints(self) -> list[Path]:
        """Complete checkpoints, oldest first."""
        return sorted((self.path / "checkpoints").glob("[0-9]*.npz"))

    def save_checkpoint(self, iteration: int, state: dict[str, np.ndarray]) -> None:
        """Save a state, then drop all but the newest CHECKPOINTS_KEPT."""
        buffer = io.BytesIO()
        np.savez(buffer, **state)  # type: ignore[arg-type]
        write_bytes(self.path / "checkpoints" / f"{iteration:07d}.npz", buffer.getvalue())
        for old in self.checkpoints()[:-CHECKPOINTS_KEPT]:
            old.unlink()

    def load_checkpoint(self) -> dict[str, np.ndarray] | None:
        """The newest readable checkpoint, or None if there is none yet."""
        for path in reversed(self.checkpoints()):
            try:
                with np.load(path) as archive:
                    return {name: archive[name] for name in archive.files}
            except (OSError, ValueError, EOFError):
                continue
        return None

    # ---------------- logs ----------------

    def log(self, line: dict[str, Any]) -> None:
        """Append one JSON line to metrics.jsonl."""
        with (self.path / "metrics.jsonl").open("a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")

    def truncate_log(self, iteration: int) -> None:
        """Drop the lines after `iteration`, which a resumed run writes again."""
        path = self.path / "metrics.jsonl"
        if path.exists():
            lines = [line for line in path.read_text().splitlines() if line.endswith("}")]
            kept = [line for line in lines if json.loads(line)["iteration"] <= iteration]
            write_bytes(path, "".join(f"{line}\n" for line in kept).encode())

    def write_json(self, name: str, content: dict[str, Any]) -> None:
        """Write a JSON file of the run."""
        write_bytes(self.path / name, (json.dumps(content, indent=2) + "\n").encode())
