"""`python -m examples.check [NAMES] [-o FILE]`: a table of the examples against other answers.

Each example's log-likelihood at stated parameters, and for some a posterior mean, beside the same
number by a program that shares no code with ssmppl: statsmodels' Kalman filter, hmmlearn's forward
algorithm, the package particles, or a point-mass filter in NumPy. What is not installed is named
and skipped; `pip install 'ssmppl[check]'` brings all of it. Exit code 1 if a row does not hold.
"""

from __future__ import annotations

import argparse
import importlib.util
import sys
from pathlib import Path

import pandas as pd

from examples.check import by_grid, by_kalman, by_particles
from examples.check.rows import CHECKS, EXAMPLES, Row

__all__ = ["by_grid", "by_kalman", "by_particles"]


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m examples.check", description=__doc__)
    parser.add_argument("examples", nargs="*", help="names of folders; all, if none is given")
    parser.add_argument("-o", "--output", type=Path, help="CSV file; none, if names are given")
    given = parser.parse_args()
    names = given.examples or sorted({c.example for c in CHECKS})
    unknown = set(names) - {c.example for c in CHECKS}
    if unknown:
        parser.error(f"no check of {', '.join(sorted(unknown))}")
    rows = []
    for one in (c for name in names for c in CHECKS if c.example == name):
        lacking = [p for p in one.needs if importlib.util.find_spec(p) is None]
        if lacking:
            print(f"{one.example}: skipped, not installed: {', '.join(lacking)}", file=sys.stderr)
            continue
        for row in one.run():
            rows.append(row)
            print(f"{row.example}: {row.quantity}", file=sys.stderr)
    if not rows:
        print("Nothing was checked.", file=sys.stderr)
        return 1
    found = table(rows)
    print(found.to_string(index=False))
    output = given.output or (
        None if given.examples else EXAMPLES.parent / "docs" / "figures" / "examples.csv"
    )
    if output is not None:
        found.to_csv(output, index=False, float_format="%.12g")
    failed = [row for row in rows if not row.holds]
    print(f"\n{len(rows)} rows, {len(failed)} of them do not hold.")
    return 1 if failed else 0


def table(rows: list[Row]) -> pd.DataFrame:
    """A line for each comparison."""
    return pd.DataFrame([
        {
            "example": row.example, "quantity": row.quantity, "by": row.by, "peer": row.peer,
            "ssmppl": row.ours.value, "other": row.theirs.value, "difference": row.difference,
            "error": row.error, "z": row.z, "holds": row.holds,
        }
        for row in rows
    ])  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
