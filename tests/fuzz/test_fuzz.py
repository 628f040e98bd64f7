"""Mutated files of every reader are read or refused: no other exception, no hang, no code, little memory."""

from __future__ import annotations

import random
import re
import signal
import sys
from pathlib import Path

import numpy as np
import pytest

from mi_refgs.errors import InputError
from tests.fuzz.mutate import mutate
from tests.fuzz.readers import READERS
from tests.helpers import slow

SEED, SECONDS, MEBIBYTES = 7, 60, 500
CODE = ("pickle.find_class", "os.system", "os.exec", "subprocess.Popen", "socket.connect", "urllib.Request")
"""Audit events of code run from a file, or of a network."""
events: list[str] = []
sys.addaudithook(lambda event, _: events.append(event) if event in CODE else None)

pytestmark = pytest.mark.filterwarnings("ignore")


def _ring(*_: object) -> None:
    raise TimeoutError


def peak() -> int:
    """Largest memory of this process, MiB."""
    return int(re.findall(r"VmHWM:\s+(\d+)", Path("/proc/self/status").read_text())[0]) // 1024


@pytest.mark.parametrize("files", [6, slow(400)])
@pytest.mark.parametrize("name", READERS)
def test_mutated_files_are_read_or_refused(name: str, files: int, tmp_path: Path) -> None:
    """SEED and the index of a file make it again."""
    reader, found = READERS[name], {"right": 0, "refused": 0}
    reader.make(tmp_path)
    whole = {path: path.read_bytes() for path in sorted(tmp_path.glob(reader.mutated))}
    for path in whole:
        [*reader.read(path)]  # the samples are accepted
    signal.signal(signal.SIGALRM, _ring)
    for index in range(files):
        rng = random.Random(f"{SEED} {index}")
        path = rng.choice([*whole])
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
    assert files < 400 or (found["refused"] and (found["right"] or name == "run-data"))
