"""Print the table of all benchmarks; exit 1 when a ratio falls below what it is held to."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path


def main(arguments: list[str] | None = None) -> int:
    """Run the benchmarks and print them one by one."""
    for library in ("OPENBLAS", "OMP", "MKL"):  # one thread for everyone; to be said before numpy is loaded
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")
    from benchmarks import table

    known = table.names()
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("--only", action="append", choices=known, help="run this one alone; may be given again")
    parser.add_argument("--json", type=Path, help="write the table to this file, too")
    given = parser.parse_args(arguments)
    done, lost = [], []
    for name in given.only or known:
        for row in table.rows_of(name):
            done.append(row)
            lost += table.short(row)
            print(*table.lines(row), sep="\n", flush=True)
            if given.json:
                given.json.write_text(table.as_json(done) + "\n")
    for line in lost:
        print(f"below what it is held to: {line}", file=sys.stderr)
    return 1 if lost else 0


if __name__ == "__main__":
    sys.exit(main())
