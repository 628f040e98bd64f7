"""The recipe of an event in CONTRIBUTING.md, followed line by line: it can be copied."""

from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

import mi_refgs
from mi_refgs import methods
from mi_refgs.data.dataset import read_dataset
from mi_refgs.fitting.state import TableEdit
from mi_refgs.fitting.train import Trainer
from mi_refgs.methods.extensions import EVENTS
from mi_refgs.methods.fields import at_least
from mi_refgs.surfels.table import Surfels
from tests.helpers import refused
from tests.scenes.highlight import require_same_state, step_to
from tests.scenes.tiny import METHOD, SETTINGS, write_data, write_method


@dataclass(frozen=True)
class Clone(mi_refgs.Event[Trainer]):
    """Copies the surfels that cause the largest error, a little beside."""

    name: ClassVar[str] = "clone"

    when: methods.Window
    share: float = field(default=0.1, metadata=at_least(0))  # fraction of the surfels

    def require(self, attributes: Collection[str]) -> None:
        if "radiance_sh" not in attributes:
            raise mi_refgs.InputError("needs radiance_sh", remedy="add it")

    def observes(self, trainer: Trainer) -> bool:
        return trainer.iteration < self.when.until

    def due(self, trainer: Trainer) -> bool:
        return self.when.due(trainer.iteration)

    def apply(self, trainer: Trainer) -> None:
        trainer.check()
        table, rng = trainer.fit.tables[0], trainer.setup.rng(trainer.iteration, self.name)
        worst = np.argsort(-table.error_sum.numpy())[: round(self.share * table.surfels.count)]
        raw = {name: np.concatenate([x, x[worst]]) for name, x in table.surfels.to_numpy().items()}
        parent = np.concatenate([np.arange(table.surfels.count), worst]).astype(np.uint32)
        fresh = np.arange(len(parent)) >= table.surfels.count
        raw["position"][fresh] += rng.normal(0, 0.01, (fresh.sum(), 3)).astype(np.float32)
        table.apply(TableEdit(Surfels.from_numpy(raw), parent, fresh))
        table.clear()


@pytest.fixture
def file(tmp_path: Path) -> Iterator[str]:
    mi_refgs.register_event(Clone)
    table = "[event.clone]\nwhen = { start = 0, until = 1_000, every = 500 }\nshare = 0.2\n"
    yield str(write_method(tmp_path, METHOD + table))
    EVENTS.unregister("clone")


def test_a_registered_event_happens(file: str, tmp_path: Path, one_thread: None) -> None:
    """On its window, which presets scale, with its history in checkpoints."""
    assert methods.load(file, "1000:100").event["clone"] == Clone(methods.Window(0, 500, 250), 0.2)
    every_third = ["event.clone.when={ start = 0, until = 6, every = 3 }"]
    method = methods.load(file, "quick", [*SETTINGS, *every_third])
    data = read_dataset(write_data(tmp_path / "data", truth=False), "train", truth=False)
    trainer = step_to(Trainer(method, data), 2)
    assert trainer.surfels.count == 80 and trainer.fit.tables[0].error_sum.numpy().any()
    assert step_to(trainer, 3).surfels.count == 96
    again = Trainer(method, data, state=trainer.fit.arrays())
    require_same_state(step_to(trainer, 6), step_to(again, 6))
    assert again.surfels.count == 115

    # Rows that move take the mesh's nearest surfels with them; parents that do not exist are refused.
    again.fit.occluder.vertex_surfels = object()  # type: ignore[assignment]
    table, rows = again.fit.tables[0], np.arange(115, dtype=np.uint32)
    table.apply(TableEdit(again.surfels, rows[::-1].copy(), np.zeros(115, bool)))
    assert again.fit.occluder.vertex_surfels is None
    for parent in (rows + 1, rows[:-1]):
        wrong = TableEdit(again.surfels, parent, np.zeros(115, bool))
        refused(partial(table.apply, wrong), "115 surfels", "parent")


def test_other_tables_are_refused(file: str) -> None:
    refused(lambda: methods.load(file, "quick", ["event.clone.share=-1"]), "event.clone.share", "0 or more")
    refused(lambda: methods.load(file, "quick", ["event.clones={}"]), "'clones' is unknown", "densify")
    attributes = ["surfels.attributes=['albedo', 'metallic', 'roughness']", "surfels.degree={}"]
    refused(
        lambda: methods.load(file, "quick", [*attributes, "stage.deferred.diffuse='irradiance'"]),
        "event.clone: needs radiance_sh",
    )
