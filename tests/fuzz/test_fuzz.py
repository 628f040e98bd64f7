"""Mutated files of every reader are read or refused: no other exception, no hang, no code, little memory."""

from __future__ import annotations

import random
import re
import signal
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mi_refgs.errors import InputError
from tests.fuzz.mutate import mutate
from tests.fuzz.readers import READERS, Reader

SEED, SECONDS, MEBIBYTES = 7, 60, 500
CODE = ("pickle.find_class", "os.system", "os.exec", "subprocess.Popen", "socket.connect", "urllib.Request")
"""Audit events of code run from a file, or of a network."""
events: list[str] = []
sys.addaudithook(lambda event, _: events.append(event) if event in CODE else None)

pytestmark = pytest.mark.filterwarnings("ignore")


def fuzz(reader: Reader, folder: Path, files: int, seed: int = SEED) -> dict[str, int]:
    """Number of files that were read, and refused; `seed` and index of a file make it again."""
    reader.make(folder)
    paths = sorted(folder.glob(reader.mutated))
    whole = {path: path.read_bytes() for path in paths}
    for path in paths:
        [*reader.read(path)]  # the samples are accepted
    found = {"right": 0, "refused": 0}
    signal.signal(signal.SIGALRM, _ring)
    for index in range(files):
        rng = random.Random(f"{seed} {index}")
        path = rng.choice(paths)
        others = [data for other, data in whole.items() if other.suffix == path.suffix]
        path.write_bytes(mutate(whole[path], others, path.suffix == ".json", rng))
        events.clear()
        Path("/proc/self/clear_refs").write_text("5")  # the peak is counted anew
        before = peak()
        signal.alarm(SECONDS)
        try:
            arrays = [np.asarray(array) for array in reader.read(path)]
            assert all(np.isfinite(array).all() for array in arrays), f"not finite, file {index}"
            found["right"] += 1
        except InputError:
            found["refused"] += 1
        finally:
            signal.alarm(0)
        assert peak() - before < MEBIBYTES and not events, f"file {index}: {peak() - before} MB, {events}"
        path.write_bytes(whole[path])
    return found


def _ring(*_: object) -> None:
    raise TimeoutError


def peak() -> int:
    """Largest memory of this process, MiB."""
    return int(re.findall(r"VmHWM:\s+(\d+)", Path("/proc/self/status").read_text())[0]) // 1024


@pytest.mark.parametrize("name", READERS)
def test_mutated_files_are_read_or_refused(name: str, tmp_path: Path) -> None:
    fuzz(READERS[name], tmp_path, 6)


@pytest.mark.slow
@pytest.mark.parametrize("name", READERS)
def test_many_mutated_files_are_read_or_refused(name: str, tmp_path: Path) -> None:
    found = fuzz(READERS[name], tmp_path, 400)
    assert found["refused"] and (found["right"] or name == "run-data")


def _reader(read: Any) -> Reader:
    return Reader(lambda folder: (folder / "a").write_bytes(b"a"), "a", read)


def test_failures_are_detected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tests.fuzz.test_fuzz.SECONDS", 1)
    calls = [
        (lambda _: [np.nan], AssertionError),
        (lambda path: [][0] if path.read_bytes() != b"a" else [], IndexError),
        (lambda path: signal.pause() if path.read_bytes() != b"a" else [], TimeoutError),
        (lambda _: [sys.audit("os.system", b"x")][:0], AssertionError),  # type: ignore[func-returns-value]
    ]
    for read, kind in calls:
        with pytest.raises(kind):
            fuzz(_reader(read), tmp_path, 8)
