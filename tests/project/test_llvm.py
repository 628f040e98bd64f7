"""The choice of libLLVM; imports are tried in fresh processes, since Dr.Jit loads a library only once."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from mi_refgs import llvm
from tests.helpers import run_process

SYSTEM = Path("/usr/lib/x86_64-linux-gnu")
OLD = [SYSTEM / "libLLVM-14.so.1", SYSTEM / "libLLVM-15.so.1", SYSTEM / "libLLVM-16.so.1"]

RENDER = """
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
import drjit as dr
x = dr.minimum(dr.arange(mi.Float, 4), dr.opaque(mi.Float, 2))
assert x[3] == 2
print("rendered with", dr.detail.llvm_version()[0])
"""


def run(*arguments: object, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run a fresh Python in which nobody chose a libLLVM but through `environment`."""
    return run_process(*arguments, environment={llvm.ENVIRONMENT_VARIABLE: None, **environment})


def last_line(text: str) -> str:
    return text.strip().splitlines()[-1]


@pytest.fixture
def usable() -> Path:
    """The library that this machine would use."""
    library = llvm.find_library()
    assert library is not None
    return library


# ---------- Versions ----------


@pytest.mark.parametrize(
    ("path", "version"),
    [
        ("/none/lib/libLLVM-14.so.1", (14,)),
        ("/none/lib/libLLVM-15.0.6.so", (15, 0, 6)),
        ("/none/lib/libLLVM.so.19.1", (19, 1)),
        ("/none/lib/libLLVM-19.so", (19,)),
        ("/none/lib/libLLVM.so", None),
        ("/none/lib/libLLVMCore.so", None),
        ("/none/llvm-18/lib/libLLVM.so", (18,)),
        ("/opt/none/llvm@20/lib/libLLVM.dylib", (20,)),
        ("/opt/none/Cellar/llvm/19.1.7/lib/libLLVM.dylib", (19, 1, 7)),
    ],
)
def test_named_version(path: str, version: tuple[int, ...] | None) -> None:
    assert llvm.named_version(Path(path)) == version


def test_named_version_follows_links(tmp_path: Path) -> None:
    """A link's own name may lie; the file that it points to decides."""
    target = tmp_path / "libLLVM-15.so.1"
    target.touch()
    link = tmp_path / "libLLVM.so.19.1"
    link.symlink_to(target)
    assert llvm.named_version(link) == (15,)


def test_loaded_version(usable: Path, tmp_path: Path) -> None:
    version = llvm.loaded_version(usable)
    assert version is not None and version[0] >= llvm.MINIMUM_MAJOR
    broken = tmp_path / "libLLVM.so.99.1"
    broken.write_bytes(b"no library")
    assert llvm.loaded_version(broken) is None


# ---------- The search ----------


def test_find_takes_the_newest_that_loads(usable: Path, tmp_path: Path) -> None:
    (tmp_path / "libLLVM.so.99.1").write_bytes(b"newest, but no library")
    (tmp_path / "libLLVM-14.so.1").write_bytes(b"too old to be opened")
    (tmp_path / "libLLVM.so").symlink_to(usable)
    (tmp_path / "libLLVM-dangling.so").symlink_to(tmp_path / "libLLVM.so.98.1")
    assert llvm.find_library([tmp_path / "absent", tmp_path]) == usable


def test_find_prefers_the_highest_version(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(llvm, "loaded_version", llvm.named_version)
    for name in (
        "libLLVM-17.so.1",
        "libLLVM.so.20.1",
        "libLLVM.so.19.1",
        "libLLVM-18.so.1",
        "libLLVM-9.so.1",
    ):
        (tmp_path / name).touch()
    assert llvm.find_library([tmp_path]) == tmp_path / "libLLVM.so.20.1"


def test_find_finds_nothing(tmp_path: Path) -> None:
    (tmp_path / "libLLVM-16.so.1").write_bytes(b"too old")
    assert llvm.find_library([tmp_path]) is None


def test_find_rejects_a_library_with_a_false_name(tmp_path: Path) -> None:
    """The library itself is asked for its version; 15 cannot even answer."""
    old = next((path for path in OLD if path.exists()), None)
    if old is None:
        pytest.skip("no libLLVM older than 17 is installed")
    shutil.copy(old, tmp_path / "libLLVM.so.19.1")  # a link would be followed to its true name
    assert llvm.find_library([tmp_path]) is None


def test_search_folders_are_of_this_architecture() -> None:
    folders = llvm.search_folders()
    assert folders
    assert not [folder for folder in folders if "i386" in str(folder)]


# ---------- Import in a fresh process ----------


def test_import_chooses_a_usable_library(usable: Path) -> None:
    done = run("-c", "import mi_refgs" + RENDER)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout.split()[-1]) >= llvm.MINIMUM_MAJOR


def test_usable_choice_of_user_is_kept(usable: Path, tmp_path: Path) -> None:
    mine = tmp_path / "libmine.so"  # a name without a version: only the library can tell
    mine.symlink_to(usable)
    code = "import os, mi_refgs\nprint(os.environ['DRJIT_LIBLLVM_PATH'])"
    done = run("-c", code, DRJIT_LIBLLVM_PATH=str(mine))
    assert done.stdout.strip() == str(mine), done.stderr


@pytest.mark.parametrize("old", OLD, ids=lambda path: path.name)
def test_old_choice_of_user_is_refused(old: Path) -> None:
    if not old.exists():
        pytest.skip(f"{old.name} is not installed")
    done = run("-c", "import mi_refgs" + RENDER, DRJIT_LIBLLVM_PATH=str(old))
    assert done.returncode == 1
    assert last_line(done.stderr).startswith("ImportError")
    version = llvm.named_version(old)
    assert version is not None
    assert f"is LLVM {version[0]}" in done.stderr and "unset DRJIT_LIBLLVM_PATH" in done.stderr
    assert "LLVM ERROR" not in done.stderr


def test_missing_choice_of_user_is_refused() -> None:
    done = run("-c", "import mi_refgs" + RENDER, DRJIT_LIBLLVM_PATH="/none/libLLVM.so")
    assert done.returncode == 1
    assert "RuntimeWarning: DRJIT_LIBLLVM_PATH" in done.stderr
    assert "/none/libLLVM.so does not exist" in done.stderr


@pytest.mark.parametrize("old", OLD[:2], ids=lambda path: path.name)
def test_loaded_old_library_is_refused(old: Path) -> None:
    """Mitsuba came first and took an old library: it cannot be corrected, but reported."""
    if not old.exists():
        pytest.skip(f"{old.name} is not installed")
    first = f"import os\nos.environ['DRJIT_LIBLLVM_PATH'] = '{old}'\nimport mitsuba\n"
    done = run("-c", first + "del os.environ['DRJIT_LIBLLVM_PATH']\nimport mi_refgs" + RENDER)
    assert done.returncode == 1
    assert "import mi_refgs before mitsuba" in done.stderr


NONE_FOUND = """
import importlib.util, os, sys
os.environ["DRJIT_LIBLLVM_PATH"] = "/none/libLLVM.so"
import drjit as dr
del os.environ["DRJIT_LIBLLVM_PATH"]
from pathlib import Path
glob = Path.glob
Path.glob = lambda self, pattern: [] if "LLVM" in pattern else glob(self, pattern)
"""


@pytest.mark.parametrize("program", ["/home/me/refgs.py", "/somewhere/bin/refgs", "/home/me/fit.py"])
def test_without_a_library_every_program_starts_and_llvm_is_refused(program: str) -> None:
    """Whatever the program is called: the import succeeds with the sentence, an LLVM variant does not."""
    code = (
        NONE_FOUND
        + f"sys.argv = ['{program}', 'doctor']"
        + """
import mi_refgs, mitsuba as mi
mi.set_variant("scalar_rgb")
try:
    mi.set_variant("llvm_ad_rgb")
except ImportError:
    print("llvm is refused")
"""
    )
    done = run("-c", code)
    assert done.stdout.splitlines()[-1] == "llvm is refused", done.stderr
    assert "RuntimeWarning: Dr.Jit found no usable libLLVM" in done.stderr and llvm.REMEDY in done.stderr


def test_cuda_requires_no_library() -> None:
    code = (
        NONE_FOUND
        + """
real = dr.has_backend
dr.has_backend = lambda backend: backend == dr.JitBackend.CUDA or real(backend)
import mi_refgs
"""
    )
    done = run("-c", code)
    assert done.returncode == 0 and "Warning" not in done.stderr


def test_old_library_with_cuda_is_refused_with_the_variant() -> None:
    """LLVM 15 would abort at the first kernel: the switch to the variant already raises."""
    old = SYSTEM / "libLLVM-15.so.1"
    if not old.exists():
        pytest.skip("libLLVM-15.so.1 is not installed")
    code = (
        "import drjit as dr\nreal = dr.has_backend\ndr.has_backend = lambda backend: True\nimport mi_refgs"
        + RENDER
    )
    done = run("-c", code, DRJIT_LIBLLVM_PATH=str(old))
    assert done.returncode == 1
    assert "is LLVM 15" in last_line(done.stderr)


# ---------- As a script, before anything is installed ----------


def test_script_prints_the_library(usable: Path) -> None:
    done = run("-I", "-S", llvm.__file__)
    assert (done.returncode, done.stdout.strip()) == (0, str(usable))


def test_script_prints_the_problem() -> None:
    done = run("-I", "-S", llvm.__file__, DRJIT_LIBLLVM_PATH="/none/libLLVM.so")
    assert done.returncode == 1
    assert "does not exist" in done.stdout
