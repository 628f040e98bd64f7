"""Makes an earlier run the starting point that the page compares with.

python -m benchmarks.splatting.baseline runs/splatting.json
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from benchmarks.common.report import write_json
from benchmarks.splatting.measure import BASELINE, PHASES
from benchmarks.splatting.page_tables import BACKWARD

KEPT = ("case", "surfels", "size", "spread", "forward_ms", "both_ms", *(f"{stage}_ms" for stage in PHASES))


def baseline(result: dict[str, Any]) -> dict[str, Any]:
    """What is kept of a run: times of every case, and of the training step by stage."""
    stages = {}
    for name, stage in result["step"]["stages"].items():
        ms = dict(stage["stages_ms"])
        ms["other backward"] = sum(ms.pop(key, 0.0) for key in BACKWARD)
        stages[name] = {"step_ms": stage["step_ms"], "launches": stage["launches"], "stages_ms": ms}
    step = result["step"]
    about = f"A training step at {step['surfels']} surfels and {step['size']}², and every case, milliseconds."
    cases = [{key: row[key] for key in KEPT} for row in result["rows"]]
    return {"about": about, "machine": result["machine"], "stages": stages, "cases": cases}


if __name__ == "__main__":
    write_json(BASELINE, baseline(json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))))
