"""Every test starts under one variant with Dr.Jit's defaults, and leaves nothing behind for the next one."""

import gc
import os
import shutil
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

from tests.simple_kernels import set_options

# isort: split
import mi_refgs  # first: it chooses the libLLVM that Dr.Jit loads

# isort: split
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, settings

from mi_refgs.cli import main
from tests.scenes.known import write_known_data, write_known_run
from tests.scenes.tiny import train_command, write_data, write_method

set_options()

# The same examples in every run. Kernels are compiled in the first, so there is no deadline; failures are not
# simplified, since examples are mostly seeds.
settings.register_profile(
    "mi_refgs",
    max_examples=8,
    derandomize=True,
    database=None,
    deadline=None,
    phases=[Phase.explicit, Phase.generate],
    suppress_health_check=[HealthCheck.too_slow],
)
settings.register_profile("thorough", settings.get_profile("mi_refgs"), max_examples=400, derandomize=False)
settings.load_profile("mi_refgs")

VARIANT = os.environ.get("MI_REFGS_TEST_VARIANT", "llvm_ad_rgb")
THREADS = max(dr.thread_count(), 2)  # Mitsuba must be able to read EXR files
LONGEST = """
    tutorials additive_gradients viewer_page option_pairs docs train routes variants reflectance_models bsdf
    sensor_derivatives traced_light poses compare dataset own_files gallery profile packaging config
""".split()
"""The slowest files test_*.py, in this order: run first, so that no process ends long before the other."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the longest files; the others keep their order."""
    rank = {f"test_{name}.py": place for place, name in enumerate(LONGEST)}
    items.sort(key=lambda item: rank.get(item.path.name, len(rank)))


def pytest_collection_finish() -> None:
    """Modules and tests stay until the end: the collection after each test need not look at them again."""
    mi.set_variant(VARIANT)  # for fixtures of modules, which are made before those of tests
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session")
def known(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """day.exr, dusk.exr, the data set `data` of two balls under them, and a perfect reconstruction `run`."""
    folder = tmp_path_factory.mktemp("known")
    write_known_run(write_known_data(folder), folder / "run")
    return folder


@pytest.fixture(scope="module")
def balls(known: Path) -> mi_refgs.Reconstruction:
    """That run."""
    return mi_refgs.load(known / "run")


@pytest.fixture(autouse=True)
def llvm_ad_rgb() -> Iterator[None]:
    """Set variant and threads; afterwards wait for kernels, restore variant and flags, return memory."""
    mi.set_variant(VARIANT)
    if dr.thread_count() != THREADS:  # a command was run with --threads
        dr.set_thread_count(THREADS)
    yield
    gc.collect()
    if mi.variant() != "scalar_rgb":
        dr.sync_thread()
    mi.set_variant(VARIANT)
    dr.kernel_history_clear()
    dr.flush_malloc_cache()
    dr.set_flag(dr.JitFlag.Default, True)


@pytest.fixture
def rng() -> np.random.Generator:
    """Random numbers that are the same in every run."""
    return np.random.default_rng(20261121)


@pytest.fixture
def set_threads() -> Iterator[Callable[[int], None]]:
    """Set the number of Dr.Jit's threads, for this test."""
    yield dr.set_thread_count
    dr.sync_thread()
    dr.set_thread_count(THREADS)


@pytest.fixture
def one_thread(set_threads: Callable[[int], None]) -> None:
    """Run Dr.Jit on one thread: floating-point sums by scatter are then bitwise the same in every run."""
    set_threads(1)


@pytest.fixture
def heard_interrupts() -> Iterator[None]:
    """Python's own answer to Ctrl-C, which a process in the background is started to ignore."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tiny data set."""
    return write_data(tmp_path_factory.mktemp("data") / "ball")


@pytest.fixture(scope="module")
def method(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tiny method."""
    return write_method(tmp_path_factory.mktemp("method"))


@pytest.fixture(scope="module")
def finished(data: Path, method: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of the two; do not change it."""
    run = tmp_path_factory.mktemp("runs") / "run"
    assert main(train_command(data, run, method)) == 0
    return run


@pytest.fixture
def run(finished: Path, tmp_path: Path) -> Path:
    """A copy of the finished run, to be spoilt."""
    return shutil.copytree(finished, tmp_path / "run")
