"""The choice of libLLVM; imports are tried in fresh processes, since Dr.Jit loads a library only once."""

import subprocess
from pathlib import Path

import pytest

from mi_refgs import llvm
from tests.helpers import run_process

OLD = Path("/usr/lib/x86_64-linux-gnu/libLLVM-15.so.1")
RENDER = """
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
import drjit as dr
x = dr.minimum(dr.arange(mi.Float, 4), dr.opaque(mi.Float, 2))
assert x[3] == 2
print("rendered with", dr.detail.llvm_version()[0])
"""
NONE_FOUND = """
import os
os.environ["DRJIT_LIBLLVM_PATH"] = "/none/libLLVM.so"
import drjit as dr
del os.environ["DRJIT_LIBLLVM_PATH"]
from pathlib import Path
glob = Path.glob
Path.glob = lambda self, pattern: [] if "LLVM" in pattern else glob(self, pattern)
import mi_refgs, mitsuba as mi
mi.set_variant("scalar_rgb")
try:
    mi.set_variant("llvm_ad_rgb")
except ImportError:
    print("llvm is refused")
"""


def run(*arguments: object, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run a fresh Python in which nobody chose a libLLVM but through `environment`."""
    return run_process(*arguments, environment={llvm.ENVIRONMENT_VARIABLE: None, **environment})


@pytest.fixture
def usable() -> Path:
    """The library that this machine would use."""
    library = llvm.find_library()
    assert library is not None
    return library


def test_find_takes_the_newest_that_loads(usable: Path, tmp_path: Path) -> None:
    """Neither a file that is no library, nor one that is too old, nor a link to nothing."""
    (tmp_path / "libLLVM.so.99.1").write_bytes(b"newest, but no library")
    (tmp_path / "libLLVM-14.so.1").write_bytes(b"too old to be opened")
    assert llvm.loaded_version(tmp_path / "libLLVM.so.99.1") is None
    assert llvm.find_library([tmp_path / "absent", tmp_path]) is None
    (tmp_path / "libLLVM.so").symlink_to(usable)
    (tmp_path / "libLLVM-dangling.so").symlink_to(tmp_path / "libLLVM.so.98.1")
    assert llvm.find_library([tmp_path / "absent", tmp_path]) == usable


def test_find_prefers_the_highest_version(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(llvm, "loaded_version", llvm.named_version)
    assert llvm.named_version(Path("/none/llvm-18/lib/libLLVM.so")) == (18,)
    for name in ("libLLVM-17.so.1", "libLLVM.so.20.1", "libLLVM.so.19.1", "libLLVM-9.so.1"):
        (tmp_path / name).touch()
    assert llvm.find_library([tmp_path]) == tmp_path / "libLLVM.so.20.1"


def test_usable_choice_of_user_is_kept(usable: Path, tmp_path: Path) -> None:
    mine = tmp_path / "libmine.so"  # a name without a version: only the library can tell
    mine.symlink_to(usable)
    code = "import os, mi_refgs" + RENDER + "print(os.environ['DRJIT_LIBLLVM_PATH'])"
    done = run("-c", code, DRJIT_LIBLLVM_PATH=str(mine))
    assert done.stdout.splitlines()[-1:] == [str(mine)], done.stderr


@pytest.mark.skipif(not OLD.exists(), reason="no old libLLVM is installed")
@pytest.mark.parametrize(
    ("first", "words"),
    [
        ("", "is LLVM 15"),
        ("import os, mitsuba\ndel os.environ['DRJIT_LIBLLVM_PATH']\n", "import mi_refgs before mitsuba"),
    ],
)
def test_old_library_is_refused(first: str, words: str) -> None:
    """Chosen by the user, or taken by Mitsuba before: reported instead of an abort at the first kernel."""
    done = run("-c", first + "import mi_refgs" + RENDER, DRJIT_LIBLLVM_PATH=str(OLD))
    assert done.returncode == 1 and words in done.stderr and "LLVM ERROR" not in done.stderr


def test_without_a_library_import_succeeds_and_llvm_is_refused() -> None:
    done = run("-c", NONE_FOUND)
    assert done.stdout.splitlines()[-1] == "llvm is refused", done.stderr
    assert "RuntimeWarning: Dr.Jit found no usable libLLVM" in done.stderr and llvm.REMEDY in done.stderr


def test_script_prints_the_library_or_the_problem(usable: Path) -> None:
    """As a script, before anything is installed."""
    done = run("-I", "-S", llvm.__file__)
    assert (done.returncode, done.stdout.strip()) == (0, str(usable))
    done = run("-I", "-S", llvm.__file__, DRJIT_LIBLLVM_PATH="/none/libLLVM.so")
    assert done.returncode == 1 and "does not exist" in done.stdout
