"""The small instance of `python -m benchmarks.survival`: a few kills of a real process, a short soak."""

from __future__ import annotations

import json

from tests.helpers import run_process


def test_killed_fit_resumes() -> None:
    """Two SIGKILLs, one of them while a checkpoint is written, and a SIGTERM, at the moments of seed 1."""
    done = run_process("-W", "error", "-m", "benchmarks.survival", "kill", "--times", 2, "--seed", 1)
    assert done.returncode == 0, done.stdout + done.stderr[-3000:]
    result = json.loads(done.stdout)
    assert result["resumed"] == 2 and result["most_iterations_lost"] <= result["checkpoint_every"]
    outcomes = [json.loads(line) for line in done.stderr.splitlines() if line.startswith("{")]
    assert [outcome["signal"] for outcome in outcomes] == ["SIGKILL", "SIGKILL", "SIGTERM"]
    assert outcomes[1]["while_writing"] and outcomes[2]["reached"] > outcomes[1]["reached"] - 4
