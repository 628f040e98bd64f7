"""Mutated files of every reader are read or refused: no other exception, crash or hang, little memory."""

import random
import re
import signal
import sys
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from mi_refgs.errors import InputError
from tests.conftest import VARIANT
from tests.fuzz.mutate import mutate
from tests.fuzz.readers import READERS
from tests.helpers import ROOT, run_process

SEED, SECONDS, MEBIBYTES, MANY = 7, 60, 500, 1000
CODE = ("pickle.find_class", "os.system", "os.exec", "subprocess.Popen", "socket.connect", "urllib.Request")
"""Audit events of code run from a file, or of a network."""

pytestmark = pytest.mark.filterwarnings("ignore")


def _ring(*_: object) -> None:
    raise TimeoutError


def peak() -> int:
    """Largest memory of this process, MiB."""
    return int(re.findall(r"VmHWM:\s+(\d+)", Path("/proc/self/status").read_text())[0]) // 1024


def read_mutated(name: str, folder: Path, first: int, last: int) -> dict[str, int]:
    """Read files of these indices, which SEED makes again; returns how many were read and refused."""
    events: list[str] = []

    def hear(event: str, arguments: Any) -> None:
        if event in CODE and not re.search(r"exr_process\.py|gaussforge", str(arguments)):
            events.append(event)

    reader, found = READERS[name], {"read": 0, "refused": 0}
    reader.make(folder)
    whole = {path: path.read_bytes() for path in sorted(folder.glob(reader.mutated))}
    for path in whole:
        [*reader.read(path)]  # the samples are accepted
    sys.addaudithook(hear)
    signal.signal(signal.SIGALRM, _ring)
    for index in range(first, last):
        (folder / "index").write_text(str(index))
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
            found["read"] += 1
        except InputError:
            found["refused"] += 1
        finally:
            signal.alarm(0)
        assert peak() - before < MEBIBYTES and not events, f"file {index}: {peak() - before} MB, {events}"
        path.write_bytes(whole[path])
    return found


@pytest.mark.parametrize("name", READERS)
def test_mutated_files_are_read_or_refused(name: str, tmp_path: Path) -> None:
    read_mutated(name, tmp_path, 0, 6)


@pytest.mark.slow
@pytest.mark.parametrize("name", READERS)
def test_many_mutated_files(name: str, tmp_path: Path) -> None:
    """In processes of their own, of which each ends at the first file that it does not survive."""
    first, wrong, told = 0, [], ""
    while first < MANY:
        folder = tmp_path / str(first)
        folder.mkdir()
        command = ("-m", "tests.fuzz.test_fuzz", name, folder, first, MANY)
        done = run_process(*command, folder=ROOT)
        told, first = done.stdout, int((folder / "index").read_text()) + 1
        if done.returncode:
            wrong.append((first - 1, done.returncode, done.stderr[-300:]))
    print(name, told, wrong)
    assert not wrong


if __name__ == "__main__":
    mi.set_variant(VARIANT)
    print(read_mutated(sys.argv[1], Path(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4])))
