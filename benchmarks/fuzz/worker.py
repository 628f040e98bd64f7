"""The process that reads: one line of JSON for each file, so that its parent sees where it ended."""

from __future__ import annotations

import argparse
import json
import os
import random
import re
import resource
import signal
import sys
import tempfile
import time
import traceback
import warnings
from pathlib import Path
from typing import Any

import psutil

from benchmarks.common.timing import forget_peak, peak_bytes
from benchmarks.fuzz import MEBIBYTES, SECONDS
from benchmarks.fuzz.mutate import mutate
from benchmarks.fuzz.readers import READERS, Reader
from mi_refgs.errors import InputError

CODE = ("pickle.find_class", "os.system", "os.exec", "subprocess.Popen", "socket.connect", "urllib.Request")
"""Audit events of code run from a file, or of a network."""
ADDRESS_SPACE = 4 * MEBIBYTES
"""Mebibytes beyond what the process has mapped, after which memory is refused."""


class HangError(BaseException):
    """The alarm rang."""


def mutated(reader: Reader, samples: list[bytes], seed: int, index: int) -> bytes:
    """File `index` of a reader; the first ones are the samples, unchanged."""
    if index < len(samples):
        return reader.finish(samples[index])
    rng = random.Random(f"{seed} {reader.name} {index}")
    data = mutate(rng.choice(samples), samples, reader.kind, rng)
    return reader.finish(data) if rng.random() < 0.5 else data


def outcome(reader: Reader, folder: Path, data: bytes) -> dict[str, Any]:
    """Read one file; `result` is "right", "refused" or what went wrong."""
    began, before = time.perf_counter(), forget_peak()
    Watch.folder, Watch.seen = (folder if reader.inside else None), []
    before_alarm = signal.signal(signal.SIGALRM, _ring)
    signal.alarm(SECONDS)
    found: dict[str, Any] = {"result": "right"}
    try:
        reader.read(folder, data)
    except InputError as error:
        out_of_memory = any(isinstance(cause, MemoryError) for cause in (error.__cause__, error.__context__))
        found = {"result": "memory" if out_of_memory else "refused", "what": _kind(str(error))}
    except HangError:
        found = {"result": "hang"}
    except BaseException as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        where = f"{type(error).__name__} in {Path(last.filename).name}:{last.lineno}"
        found = {"result": "exception", "what": where, "message": str(error)[:300]}
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before_alarm)
        Watch.folder = None
    found["seconds"] = round(time.perf_counter() - began, 4)
    found["mebibytes"] = round((peak_bytes() - before) / 2**20, 1)
    if Watch.seen:
        found |= {"result": "escape", "what": Watch.seen[0]}
    elif found["mebibytes"] > MEBIBYTES:
        found["result"] = "memory"
    return found


class Watch:
    """What the interpreter did while a file was read."""

    folder: Path | None = None
    seen: list[str] = []  # noqa: RUF012
    library = tuple(
        {sys.prefix, sys.base_prefix, str(Path(__file__).resolve().parents[2]), "/proc", "/sys", "/dev"}
    )

    @classmethod
    def hook(cls, event: str, arguments: tuple[Any, ...]) -> None:
        if event in CODE:
            cls.seen.append(event)
        if event == "open" and cls.folder is not None and isinstance(arguments[0], str):
            path = os.path.abspath(arguments[0])
            writes = isinstance(arguments[1], str) and any(mode in arguments[1] for mode in "wax+")
            if not path.startswith((str(cls.folder), *(() if writes else cls.library))):
                cls.seen.append(f"opened {path[:80]}")


def _ring(*_: object) -> None:
    raise HangError


def _kind(message: str) -> str:
    """The field that a message names, without what differs from file to file."""
    parts = re.sub(r"\d+", "#", re.sub(r"^(/[^:]*|refgs|surfels|EnvironmentLight): ", "", message)).split(
        ": "
    )
    return ": ".join(parts[:2])[:60].encode("ascii", "replace").decode()


def main() -> None:
    """Read the files `first` to `last` of a reader."""
    parser = argparse.ArgumentParser()
    for name in ("reader", "seed", "first", "last"):
        parser.add_argument(name, type=str if name == "reader" else int)
    options = parser.parse_args()
    # Libraries may print: the lines of the protocol have a descriptor of their own.
    lines = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    warnings.simplefilter("ignore")
    reader = READERS[options.reader]
    with tempfile.TemporaryDirectory(prefix="fuzz") as place:
        folder = Path(place).resolve() / "data"
        folder.mkdir()
        os.chdir(folder)
        samples = reader.samples(folder)
        for sample in samples:  # compiles and imports what reading needs
            outcome(reader, folder, reader.finish(sample))
        limit = psutil.Process().memory_info().vms + (ADDRESS_SPACE << 20)
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
        sys.addaudithook(Watch.hook)
        for index in range(options.first, options.last):
            found = outcome(reader, folder, mutated(reader, samples, options.seed, index))
            print(json.dumps({"index": index} | found), file=lines, flush=True)


if __name__ == "__main__":
    main()
