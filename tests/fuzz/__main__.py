"""`python -m tests.fuzz CASES [--root R] [--workers W] [--output FOLDER]`: many random cases.

Worker processes take models in turn. One that dies, or takes longer than `--limit` seconds over a
case, is noted as a crash or a hang with the model's text, and replaced. What failed lies in the
output folder, with the command that runs the one model again: `python -m tests.fuzz --only NUMBER`.
With `--table` the counts go into a CSV file, in place of those that it holds of the same root; an
interrupt or `kill` ends the hunt early and counts what was done.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import queue
import resource
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tests.fuzz.block import CALLS, cases, recipe_of

MODELS_EACH = 40  # of one worker process


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("cases", type=int, nargs="?", default=1_000)
    parser.add_argument("--root", type=int, default=1, help="of all random numbers")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--limit", type=float, default=120.0, help="seconds for one case")
    parser.add_argument("--output", type=Path, default=Path("build/fuzz"))
    parser.add_argument("--calls", type=int, default=CALLS, help="of each model")
    parser.add_argument("--table", type=Path, help="a CSV file of root, call, outcome, count")
    parser.add_argument("--only", type=int, help="this model alone, its outcomes printed")
    parser.add_argument("--first", type=int, default=0, help=argparse.SUPPRESS)
    parser.add_argument("--step", type=int, default=0, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.only is not None:
        return _alone(given.root, given.only, given.calls)
    if given.step:
        _work(given)
        return 0
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    return Hunt(given).run()


def _alone(root: int, number: int, calls: int) -> int:
    recipe, _ = recipe_of(root, number)
    print(recipe.text, f"\n# fault: {recipe.fault or 'none'}\n")
    failed = 0
    with tempfile.TemporaryDirectory() as folder:
        for k, outcome in enumerate(cases(root, number, Path(folder), calls)):
            print(f"{k:3} {outcome.verb}: {outcome.kind}\n    {outcome.detail[-2000:]}")
            failed += outcome.failed
    return int(failed > 0)


def _work(given: argparse.Namespace) -> None:
    """A worker: a line of JSON before each model, after each case, and at the end."""
    first, step = given.first, given.step
    with tempfile.TemporaryDirectory() as folder:
        for number in range(first, first + step * MODELS_EACH, step):
            _say({"model": number})
            for outcome in cases(given.root, number, Path(folder), given.calls):
                _say({"verb": outcome.verb, "kind": outcome.kind, "detail": outcome.detail})
            _say(
                {"ended": number, "mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024}
            )


def _say(what: dict[str, Any]) -> None:
    print("@" + json.dumps(what), flush=True)


@dataclass
class Worker:
    """A process, the model that it is at, and when it last said something."""

    first: int
    process: subprocess.Popen[str]
    model: int = -1
    heard: float = field(default_factory=time.monotonic)


class Hunt:
    """Keeps the workers going until enough cases have run."""

    def __init__(self, given: argparse.Namespace):
        self.given = given
        self.counts: Counter[tuple[str, str]] = Counter()
        self.failures: list[dict[str, Any]] = []
        self.models, self.mib = 0, 0
        self.lines: queue.Queue[tuple[int, subprocess.Popen[str], str | None]] = queue.Queue()
        self.workers: dict[int, Worker] = {}

    @property
    def done(self) -> int:
        return sum(self.counts.values())

    def run(self) -> int:
        begun = said = time.monotonic()
        for k in range(self.given.workers):
            self._start(k, k)
        with contextlib.suppress(KeyboardInterrupt):
            while self.done < self.given.cases:
                with contextlib.suppress(queue.Empty):
                    self._hear(*self.lines.get(timeout=1.0))
                for k, worker in self.workers.items():
                    if time.monotonic() - worker.heard > self.given.limit:
                        self._lost(k, "HANG", f"no answer within {self.given.limit:g} s")
                if time.monotonic() - said > 30:
                    said = time.monotonic()
                    print(f"{self.done} cases, {self.models} models, {len(self.failures)} failed, "
                          f"{said - begun:.0f} s", flush=True)  # fmt: skip
        for worker in self.workers.values():
            worker.process.kill()
        self._report(time.monotonic() - begun)
        return int(bool(self.failures))

    def _start(self, k: int, first: int) -> None:
        command = [sys.executable, "-m", "tests.fuzz", "--root", str(self.given.root)]
        command += ["--first", str(first), "--step", str(self.given.workers)]
        command += ["--calls", str(self.given.calls)]
        process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, errors="replace"
        )
        self.workers[k] = Worker(first, process)
        threading.Thread(target=self._read, args=(k, process), daemon=True).start()

    def _read(self, k: int, process: subprocess.Popen[str]) -> None:
        errors: list[str] = []
        tail = threading.Thread(target=lambda: errors.extend(process.stderr or ()), daemon=True)
        tail.start()
        for line in process.stdout or ():
            if line.startswith("@"):
                self.lines.put((k, process, line[1:]))
        code = process.wait()
        tail.join(timeout=5)
        text = "".join(errors[-30:])
        self.lines.put((k, process, None if code == 0 else f"!exit code {code}\n{text}"))

    def _hear(self, k: int, process: subprocess.Popen[str], line: str | None) -> None:
        worker = self.workers[k]
        if worker.process is not process:
            return  # the last words of one that was given up
        worker.heard = time.monotonic()
        if line is None:
            self._start(k, worker.first + MODELS_EACH * self.given.workers)
        elif line.startswith("!"):
            self._lost(k, "CRASH", line[1:])
        else:
            said = json.loads(line)
            if "model" in said:
                worker.model = said["model"]
                self.models += 1
            elif "ended" in said:
                self.mib = max(self.mib, said["mib"])
            else:
                self._count(worker.model, said)

    def _lost(self, k: int, kind: str, detail: str) -> None:
        worker = self.workers[k]
        self._count(worker.model, {"verb": "process", "kind": kind, "detail": detail})
        next_one = max(worker.model, worker.first) + self.given.workers
        old = worker.process
        self._start(k, next_one)
        old.kill()

    def _count(self, model: int, said: dict[str, Any]) -> None:
        self.counts[said["verb"], said["kind"]] += 1
        if said["kind"].isupper():
            self.failures.append({"model": model, **said})
            folder = self.given.output
            folder.mkdir(parents=True, exist_ok=True)
            recipe, _ = recipe_of(self.given.root, model)
            text = f"{said['verb']}: {said['kind']}\n{said['detail']}\n\n{recipe.text}"
            text += f"\n# python -m tests.fuzz --root {self.given.root} --only {model}\n"
            name = f"{said['kind'].replace(' ', '_').lower()}_{self.given.root}_{model}.txt"
            (folder / name).write_text(text)

    def _report(self, seconds: float) -> None:
        kinds = sorted(
            {kind for _, kind in self.counts}, key=lambda k: (k != "result", k.isupper(), k)
        )
        verbs = sorted({verb for verb, _ in self.counts})
        rows = [["call", *kinds]]
        rows += [[v, *(str(self.counts[v, k]) for k in kinds)] for v in verbs]
        rows.append(["all", *(str(sum(self.counts[v, k] for v in verbs)) for k in kinds)])
        if self.given.table:
            self._keep(self.given.table)
        widths = [max(len(r[c]) for r in rows) for c in range(len(rows[0]))]
        for row in rows:
            print("  ".join(cell.rjust(w) for cell, w in zip(row, widths, strict=True)))
        print(f"{self.done} cases on {self.models} models in {seconds:.0f} s, "
              f"{len(self.failures)} failed; at most {self.mib} MiB in a process")  # fmt: skip

    def _keep(self, table: Path) -> None:
        root = f"{self.given.root},"
        old = table.read_text().splitlines()[1:] if table.exists() else []
        rows = [row for row in old if not row.startswith(root)]
        rows += [f"{root}{verb},{kind},{n}" for (verb, kind), n in sorted(self.counts.items())]
        rows += [f"{root}(models),written,{self.models}", f"{root}(memory),MiB at most,{self.mib}"]
        table.write_text("\n".join(["root,call,outcome,count", *rows]) + "\n")


if __name__ == "__main__":
    sys.exit(main())
