"""Print the table of all benchmarks; exit 1 when a ratio falls below what it is held to."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path


def main(arguments: list[str] | None = None) -> int:
    """Run the benchmarks and print them one by one."""
    from benchmarks import table

    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="these alone: " + ", ".join(table.names()))
    parser.add_argument("--json", action="store_true", help="one JSON document on stdout instead of the table")
    parser.add_argument("--out", type=Path, metavar="FILE", help="write that document to this file, too")
    given = parser.parse_args(arguments)
    unknown = [name for name in given.names if name not in table.names()]
    if unknown:
        parser.error(f"no benchmark {unknown[0]!r}, expected of {', '.join(table.names())}")
    return table.printed(given.names or table.names(), as_json=given.json, out=given.out)


if __name__ == "__main__":
    sys.exit(main())
