"""`refgs doctor`'s report, on this machine and for installations that lack something."""

import json
from typing import Any

import pytest

from mi_refgs import llvm
from mi_refgs.cli import doctor
from tests.helpers import run_process


@pytest.fixture(scope="module")
def report() -> dict[str, Any]:
    return doctor.examine()


def test_doctor_finds_this_machine_usable(report: dict[str, Any]) -> None:
    assert report["usable"] is True and report["problems"] == []
    assert int(report["llvm"].split(".")[0]) >= llvm.MINIMUM_MAJOR and report["threads"] >= 1
    assert json.loads(json.dumps(report)) == report
    assert "Everything that is needed is here" in doctor.text(report)


def test_unusable_llvm_is_a_problem_without_cuda(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(llvm, "problem", lambda: llvm.Problem("no LLVM was found", "install one"))
    report = doctor.examine()
    said = ("no LLVM was found\n  type:  install one" in doctor.text(report), len(report["problems"]))
    assert said == ((False, 0) if report["cuda"] else (True, 1))


@pytest.mark.parametrize(
    ("code", "words"),
    [("import os; os.abort()", "trial kernel failed"), ("import time; time.sleep(60)", "took longer")],
)
def test_failing_kernel_is_a_problem(code: str, words: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "_PROBE", code)
    if "sleep" in code:
        monkeypatch.setattr(doctor, "PROBE_TIMEOUT", 0.2)
    report = doctor.examine()
    assert not report["usable"] and words in report["problems"][0]["what"]


def test_doctor_reports_missing_library() -> None:
    environment = {llvm.ENVIRONMENT_VARIABLE: "/none/libLLVM.so"}
    done = run_process("-m", "mi_refgs", "doctor", environment=environment)
    assert done.returncode == 1
    assert "PROBLEM: DRJIT_LIBLLVM_PATH=/none/libLLVM.so does not exist" in done.stdout
    assert f"unset {llvm.ENVIRONMENT_VARIABLE}" in done.stdout
