"""The method and data set that a reconstruction was fitted with, and their cameras."""

import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from mi_refgs.data.dataset import Dataset
from mi_refgs.data.region import Region
from mi_refgs.errors import InputError
from mi_refgs.formats import Shot
from mi_refgs.formats.orbits import shots_around
from mi_refgs.methods.method import Method
from mi_refgs.runs.run import CAMERAS, EXPOSURE, Run
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.runs.views import read_views, warn_of_changes, with_poses, with_region
from mi_refgs.splat import Camera

EDITS = "edit.json"


@dataclass(frozen=True)
class Provenance:
    """A method and, where it is known, the data set that it was fitted to, with its region of interest."""

    method: Method
    data: Path | None = None
    region: Region | None = None  # in images without alpha
    edits: tuple[dict[str, Any], ...] = ()  # made since, in order: the records of `editing.change.edit`
    records: dict[str, Any] = field(default_factory=dict)
    """Corrections of the fit by file: of its cameras and of the exposure."""
    images: dict[str, str] = field(default_factory=dict)  # digests of those that it was fitted to
    offset: Sequence[float] | None = None  # subtracted from positions of its data set, if that is known

    @staticmethod
    def of(run: Run) -> "Provenance":
        """Read a run folder; raises InputError if it is none, or has a record that cannot be used."""
        made = run.record(EDITS).get("edits", [])
        records = {name: record for name in (CAMERAS, EXPOSURE) if (record := run.record(name))}
        known = run.dataset(), run.region(), tuple(made), records, run.images(), run.offset()
        return Provenance(run.method(), *known)

    def with_data(self, folder: Path | None) -> "Provenance":
        """Replace the data set, unless `folder` is None; raises InputError for a path that is no folder."""
        if folder is not None and not folder.is_dir():
            raise InputError("no such folder", folder, "--data", "give the folder of a data set")
        return self if folder is None else replace(self, data=folder, images={})

    @property
    def has_data(self) -> bool:
        return self.data is not None and self.data.is_dir()

    def views(self, split: str, truth: bool = True) -> Dataset:
        """Read a split of the data set; raises InputError for one that is unknown, missing or unreadable."""
        if self.data is None or not self.has_data:
            gone = "its data set is unknown" if self.data is None else f"{self.data} is gone"
            raise InputError(gone, "views", split, "use cameras(), or restore the data set")
        views = read_views(self.method, self.data, split, truth)
        warn_of_changes(views, self.method, self.images)
        views = views.relative_to(self.offset)
        return with_poses(with_region(views, self.region), self.records.get(CAMERAS, {}))

    def shots(self, trained: TrainedScene, *splits: str) -> list[Shot]:
        """Return the named cameras of some splits, without images; around the surfels without a data set. Of
        several splits one that cannot be read is left out, with a warning."""
        if self.data is None or not self.has_data:
            return [shot for shot in shots_around(trained.surfels) if shot.split in splits]
        relative, shots = (lambda path: Path(os.path.relpath(path, self.data))), list[Shot]()
        for split in splits:
            try:
                data = read_views(self.method, self.data, split, truth=False)
            except InputError as error:
                if len(splits) == 1:
                    raise
                warnings.warn(f"{split} views are left out: {error}", RuntimeWarning, stacklevel=3)
                continue
            if split == "train":
                warn_of_changes(data, self.method, self.images)
            data = data.relative_to(self.offset)
            for view in with_poses(data, self.records.get(CAMERAS, {})).views:
                if (file := view.file) is not None:  # paths are relative to the data set
                    mask = file.mask and replace(file.mask, path=relative(file.mask.path))
                    file = replace(file, path=relative(file.path), mask=mask)
                shots.append(Shot(view.name, split, view.camera(), file))
        return shots or replace(self, data=None).shots(trained, *splits)

    def first_camera(self, trained: TrainedScene) -> Camera:
        """Return the camera of the first view; without a data set, the first around the surfels."""
        return self.shots(trained, "test", "train")[0].camera
