"""Run the diagnosis on the data sets alone; what is done is kept, so that it can be resumed.

    python -m bench.gap.run [--half tuning] [--cell one-50] [--subset ci] [--mode full]
        [--ids t000 c013] [--workers 2] [--limit 10] [--minutes 60]

A record stands under the digest of the method (the text of `ssmppl`) and of its set: a change of
either makes it anew. Of the plan only ids are used here, to select; the answers are not opened.
"""

from __future__ import annotations

import argparse
import math
import time
import traceback
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import ssmppl as ssm
from bench.gap.plan import CELLS, SPLIT, entries
from bench.gap.records import Record, from_report, keep, parse, path_of
from bench.gap.sealing import digest, file_digest
from ssmppl.modelfile import load_model, read_csv

HERE = Path(__file__).parent
SETS = HERE / "sets"
MODELS = HERE / "systems"


def method_digest() -> str:
    """Of the text of the package, and so of every constant of the method."""
    folder = Path(ssm.__file__).parent
    paths = sorted(folder.rglob("*.py"))
    names = "\n".join(str(p.relative_to(folder)) for p in paths).encode()
    return digest(names, *(p.read_bytes() for p in paths))


def selected(
    half: str | None = None,
    cell: str | None = None,
    subset: str | None = None,
    ids: list[str] | None = None,
) -> list[str]:
    """Ids of the sets asked for, in the order of the plan."""
    return [
        e.id
        for e in entries()
        if half in (None, e.half)
        and cell in (None, e.cell)
        and (subset != "ci" or e.ci)
        and (not ids or e.id in ids)
    ]


def diagnosed(
    id: str, mode: str = "full", method: str | None = None, diagnose: Callable | None = None
) -> Record:
    """The record of one set, kept or made now; a failure is kept as one, with its traceback.

    diagnose : in place of `ssm.diagnose`, for tests.
    """
    folder = SETS / id
    both = digest(
        (method or method_digest()).encode(),
        mode.encode(),
        file_digest(folder / "data.csv", folder / "model.py").encode(),
    )
    name = "diagnose" if mode == "full" else f"diagnose-{mode}"
    path = path_of(id, name, both)
    if path.exists():
        return parse(path.read_text())
    verb: Any = diagnose or ssm.diagnose
    began = time.perf_counter()
    try:
        model = load_model(str(folder / "model.py"))
        report = verb(model, read_csv(folder / "data.csv"), mode=mode, progress=False, seed=1)
        record = from_report(id, both, report)
    except Exception:
        seconds = time.perf_counter() - began
        record = Record(
            id, name, both, "no measurable gap", seconds=seconds, failed=traceback.format_exc()
        )
    keep(record)
    return record


def _before(stop: float, id: str, mode: str, method: str) -> Record | None:
    return diagnosed(id, mode, method) if time.time() < stop else None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--half", choices=list(SPLIT["halves"]))
    parser.add_argument("--cell", choices=CELLS)
    parser.add_argument("--subset", choices=["ci"])
    parser.add_argument("--ids", nargs="*")
    parser.add_argument("--mode", default="full", choices=["full", "fast"])
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--limit", type=int, help="stop after so many sets")
    parser.add_argument("--minutes", type=float, default=math.inf,
                        help="begin no set after so many minutes")  # fmt: skip
    options = parser.parse_args()
    ids = selected(options.half, options.cell, options.subset, options.ids)
    missing = [id for id in ids if not (SETS / id / "data.csv").exists()]
    if missing:
        print(f"{len(missing)} sets are not made: run python -m bench.gap.generate")
    ids = [id for id in ids if id not in missing][: options.limit]
    method = method_digest()
    print(f"method {method[:12]}, {len(ids)} sets, {options.mode} mode", flush=True)
    stop = time.time() + 60.0 * options.minutes
    with ProcessPoolExecutor(options.workers) as pool:
        jobs = [pool.submit(_before, stop, id, options.mode, method) for id in ids]
        for k, job in enumerate(jobs):
            r = job.result()
            if r is None:
                continue
            first = f"{r.ranked[0].effect} on {r.ranked[0].equation}" if r.ranked else ""
            what = r.failed.splitlines()[-1] if r.failed else f"{r.verdict}: {first}"
            print(f"{k + 1}/{len(jobs)} {r.id} {r.seconds:6.1f} s  {what}", flush=True)


if __name__ == "__main__":
    main()
