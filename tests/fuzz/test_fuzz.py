"""The fuzzer: a few files of every reader, and that each kind of failure is seen."""

from __future__ import annotations

import random
import time
from pathlib import Path
from typing import Any

import pytest

from benchmarks.fuzz import MEBIBYTES, worker
from benchmarks.fuzz.mutate import mutate
from benchmarks.fuzz.readers import READERS, Reader
from mi_refgs.errors import InputError

FILES, SEED = 40, 7

pytestmark = pytest.mark.filterwarnings("ignore")


@pytest.mark.parametrize("name", READERS)
def test_mutated_files_are_read_or_refused(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(worker, "SECONDS", 60)  # the machine may do other things
    monkeypatch.chdir(tmp_path)
    reader = READERS[name]
    samples = reader.samples(tmp_path)
    found = [
        worker.outcome(reader, tmp_path, worker.mutated(reader, samples, SEED, i)) | {"index": i}
        for i in range(FILES)
    ]
    assert not [item for item in found if item["result"] not in ("right", "refused")]
    assert name == "log" or any(item["result"] == "refused" for item in found)
    assert name == "dataset" or any(item["result"] == "right" for item in found)


def broken(read: Any) -> Reader:
    return Reader("planted", "", lambda folder: [b"a"], lambda folder, data: read(folder))


def escape(folder: Path) -> None:
    worker.Watch.hook("open", (str(folder / "inside"), "w", 0))
    assert not worker.Watch.seen
    worker.Watch.hook("open", (str(folder.parent / "outside"), "r", 0))


def refuse(folder: Path) -> None:
    raise InputError(f"{folder}: field: no")


@pytest.mark.parametrize(
    ("read", "result"),
    [
        (lambda folder: None, "right"),
        (refuse, "refused"),
        (lambda folder: [][0], "exception"),
        (lambda folder: b"\1" * (MEBIBYTES + 100 << 20), "memory"),
        (lambda folder: time.sleep(30), "hang"),
        (escape, "escape"),
        (lambda folder: worker.Watch.hook("pickle.find_class", ("os", "system")), "escape"),
    ],
)
def test_failures_are_detected(
    read: Any, result: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(worker, "SECONDS", 1 if result == "hang" else 60)
    assert worker.outcome(broken(read), tmp_path, b"")["result"] == result


def test_same_seed_makes_same_file(tmp_path: Path) -> None:
    reader = READERS["transforms"]
    samples = reader.samples(tmp_path)
    files = [[worker.mutated(reader, samples, seed, i) for i in range(20)] for seed in (1, 1, 2)]
    assert files[0] == files[1] != files[2]
    assert len({*files[0]}) > 15


def test_structures_are_changed(tmp_path: Path) -> None:
    """Every kind of mutation makes files that differ from their sample."""
    for name in ("transforms", "method", "scene", "ply"):
        reader = READERS[name]
        sample = reader.samples(tmp_path)[0]
        made = {mutate(sample, [sample], reader.kind, random.Random(i)) for i in range(50)}
        assert len(made) > 40
