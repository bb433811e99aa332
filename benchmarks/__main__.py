"""Print the table of all benchmarks; exit 1 when a ratio falls below the one it is held to."""

from __future__ import annotations

import sys

from benchmarks import point_mass, sampling


def main() -> int:
    """Run every benchmark and print one line each."""
    table = [*sampling.rows(), *point_mass.rows()]
    print(f"{'work':34}{'unit':>8}{'terranav':>12}{'peer':>12}  {'ratio':>6}  peer")
    for row in table:
        figures = f"{row.per:>8}{row.ours_ns:>9.2f} ns{row.peer_ns:>9.2f} ns  {row.ratio:>5.1f}x"
        print(f"{row.work:34}{figures}  {row.peer} (at least {row.least_ratio:g}x)")
    slow = [row.work for row in table if row.ratio < row.least_ratio]
    if slow:
        print(f"below the ratio they are held to: {', '.join(slow)}", file=sys.stderr)
    return 1 if slow else 0


if __name__ == "__main__":
    sys.exit(main())
