"""Hard cases against a float64 reference.

    python -m benchmarks.stability                     the page docs/stability.md, in 15 minutes on 2 cores
    python -m benchmarks.stability --quick -o out      without large cases, fits, the method's own error
    python -m benchmarks.stability --only light -o out cases whose name contains a word; repeatable

Writes stability.md, stability.csv and stability.json to the output folder; without -o, the page goes to docs/
and the two others to runs/. The exit code is 1 if a case fails.
"""

from __future__ import annotations

import sys

from benchmarks.common.report import make_parser, write_reports
from benchmarks.stability.run import failures, measure, page


def main(arguments: list[str] | None = None) -> int:
    """Measure, and write the reports; exit code 1 where a case fails, 2 for bad input."""
    parser = make_parser("stability", __doc__)
    parser.add_argument("--quick", action="store_true", help="what every test run can afford")
    parser.add_argument("--only", metavar="WORD", action="append", default=[], help="cases named so")
    options = parser.parse_args(arguments)
    result = {}

    def run() -> dict:
        result.update(measure(options.quick, options.only, options.quiet))
        return result

    code = write_reports("stability", options, run, lambda *_: None, page)
    failed = failures(result) if result else []
    for line in failed:
        print(line, file=sys.stderr)
    return code or int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
