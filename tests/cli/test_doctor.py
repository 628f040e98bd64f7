"""`refgs doctor`'s report, on this machine and for installations that lack something."""

from __future__ import annotations

import dataclasses
import json
import sys
from pathlib import Path

import pytest

from mi_refgs import llvm
from mi_refgs.cli import doctor
from mi_refgs.fitting import cost_model
from tests.helpers import run_process


@pytest.fixture(scope="module")
def report() -> doctor.Report:
    return doctor.examine()


def test_doctor_finds_this_machine_usable(report: doctor.Report) -> None:
    assert report.problems == ()
    assert report.usable
    assert report.llvm_version is not None and int(report.llvm_version.split(".")[0]) >= llvm.MINIMUM_MAJOR
    assert report.simd_width in (1, 4, 8, 16)
    assert report.threads >= 1


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux has a process map")
def test_doctor_names_the_llvm_library(report: doctor.Report) -> None:
    assert report.llvm_path is not None and "libLLVM" in report.llvm_path


def test_doctor_json_has_every_field(report: doctor.Report) -> None:
    loaded = json.loads(json.dumps(report.to_dict()))
    assert loaded["usable"] is True
    assert set(loaded) == {"usable"} | {field.name for field in dataclasses.fields(report)}


def test_text_states_each_problem_with_its_remedy(report: doctor.Report) -> None:
    broken = dataclasses.replace(
        report,
        llvm_version=None,
        llvm_path=None,
        problems=(llvm.Problem("no LLVM was found", "install one"),),
    )
    assert not broken.usable
    text = broken.to_text()
    assert "no LLVM was found" in text and "install one" in text
    assert "Everything that is needed is here" not in text


def test_unusable_llvm_is_a_problem_without_cuda(monkeypatch: pytest.MonkeyPatch) -> None:
    trouble = llvm.Problem("no LLVM was found", "install one")
    monkeypatch.setattr(llvm, "problem", lambda: trouble)
    report = doctor.examine()
    assert report.problems == (() if report.cuda else (trouble,))


def test_failing_kernel_is_a_problem(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "_PROBE", "import os; os.abort()")
    report = doctor.examine()
    assert not report.usable
    assert "trial kernel failed" in report.problems[0].what


def test_hanging_kernel_is_a_problem(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "_PROBE", "import time; time.sleep(60)")
    monkeypatch.setattr(doctor, "PROBE_TIMEOUT", 0.2)
    assert "took longer" in doctor.examine().problems[0].what


def test_doctor_reports_missing_library() -> None:
    done = run_process(
        "-m", "mi_refgs", "doctor", environment={llvm.ENVIRONMENT_VARIABLE: "/none/libLLVM.so"}
    )
    assert done.returncode == 1
    assert "PROBLEM: DRJIT_LIBLLVM_PATH=/none/libLLVM.so does not exist" in done.stdout
    assert f"unset {llvm.ENVIRONMENT_VARIABLE}" in done.stdout


def test_doctor_lists_measured_speeds(
    report: doctor.Report, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(cost_model.FOLDER_VARIABLE, str(tmp_path))
    assert "none measured yet" in dataclasses.replace(report, speeds=cost_model.summary()).to_text()
    for threads in (1, 2):
        cost_model.kept({"threads": threads}, lambda: cost_model.Speed({"all": [1.0, 2.0]}, 0.0, 0.0))
    text = dataclasses.replace(report, speeds=cost_model.summary()).to_text()
    assert "1 measured with 1 threads" in text and "1 measured with 2 threads" in text
    assert f"in {tmp_path}, which may be removed to measure them anew" in text
