"""Time to an answer: questions as users have them, by ssmppl and by what they would take instead.

    python -m bench.answers [question ...] [--repeats K] [--limit SECONDS]

Each question is asked in a process of its own. There every program answers once, which compiles or
loads what is compiled; then K times in turns, each time with another seed, and medians are told:
seconds on the clock and, in brackets, of the processor, which tell more where the machine does
other work. A first answer of more than a minute of the processor counts, and is the only one; of
`--repeats 0` all first ones count.
Beside the times stand the last answers, the goal, and what is wrong with ssmppl's: each answer is
held against an exact one or another program's (`bench/questions/`), and warnings count.

Others are asked where they are installed: the extra `peers`, statsmodels and hmmlearn of the extra
`check`, and R with its package TMB (Debian's r-cran-tmb). What is missing is said.

The table goes to bench/ANSWERS.md, its figures to docs/figures/answers.csv for the page on
performance; with questions for arguments, only their rows are replaced.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import subprocess
import sys
import time
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from .questions import counts, discrete, linear, other, pendulum, varves
from .questions.question import OWN, Answer, Question, Run, Unavailable
from .table import machine, text, versions

HERE = Path(__file__).parent
PAGE = HERE / "ANSWERS.md"
TABLE = HERE.parent / "docs" / "figures" / "answers.csv"
HEADER = ("key", "question", "program", "unit", "figure", "by processor", "first, s",
          "first by processor, s", "runs", "goal", "answer", "faults")  # fmt: skip
QUESTIONS: dict[str, Question] = {
    q.key: q for m in (varves, pendulum, linear, discrete, counts, other) for q in m.QUESTIONS
}
BY = ("figure", "by processor")
LONG = 60.0  # seconds of the processor of a first answer that is not asked for again
MARK = "answer: "  # before what a process has to say


# --- in the process of one question --------------------------------------------------------------


def ask(question: Question, repeats: int) -> None:
    """Put the question to all programs in turns, and print what each run said, as JSON."""
    runs: dict[str, Run] = {}
    for program in reversed(question.programs):  # ssmppl last: it may not come to an end
        try:
            runs[program.name] = program.prepare()
        except (Unavailable, ImportError) as error:
            _tell(program.name, missing=str(error))
    for turn in range(repeats + 1):
        for name in list(runs):
            seconds = _ask_once(name, runs[name], turn)
            if seconds is None or (turn == 0 and seconds > LONG):
                del runs[name]


def _ask_once(name: str, run: Run, turn: int) -> float | None:
    """Print one run; its seconds of the processor, None where it failed."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        began, before = time.perf_counter(), _processor()
        try:
            answer = run(turn)
        except Exception as error:
            _tell(name, failed=f"{type(error).__name__}: {error}")
            return None
        wall, processor = time.perf_counter() - began, max(_processor() - before, 1e-9)
    said = [str(w.message).splitlines()[0] for w in caught if issubclass(w.category, UserWarning)]
    if answer.seconds is not None:  # of the processor in proportion, unless the program says
        share = processor / wall
        wall = answer.seconds
        processor = wall * share if answer.processor is None else answer.processor
    _tell(name, turn=turn, wall=wall, processor=processor, warned=list(dict.fromkeys(said)),
          answer=asdict(answer))  # fmt: skip
    return processor


def _processor() -> float:
    """Seconds of this process and of those that it has waited for."""
    return time.process_time() + sum(os.times()[2:4])


def _tell(name: str, **what: Any) -> None:
    print(MARK + json.dumps({"program": name, **what}), flush=True)


# --- around it -----------------------------------------------------------------------------------


def asked(question: Question, repeats: int, limit: float) -> list[dict[str, Any]]:
    """What the programs said of a question, in a process that has `limit` seconds."""
    command = [sys.executable, "-m", "bench.answers", question.key, "--repeats", str(repeats),
               "--here"]  # fmt: skip
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=HERE.parent) as process:
        try:
            out, _ = process.communicate(timeout=limit)
        except subprocess.TimeoutExpired:
            process.kill()
            out, _ = process.communicate()
    said = [json.loads(line.removeprefix(MARK)) for line in out.splitlines()
            if line.startswith(MARK)]  # fmt: skip
    if not any(s["program"] == OWN for s in said):
        how = f"no answer after {limit:g} s" if process.returncode < 0 else "the process ended"
        said.append({"program": OWN, "failed": how})
    return said


def rows_of(question: Question, said: list[dict[str, Any]]) -> list[dict[str, str]]:
    """Its rows of the table, ssmppl's first."""
    answers = {p.name: [s for s in said if s["program"] == p.name] for p in question.programs}
    last = {
        name: _answer(runs[-1]) for name, runs in answers.items() if "answer" in (runs or [{}])[-1]
    }
    faults = _faults(question, answers[OWN], {n: a for n, a in last.items() if n != OWN})
    rows = []
    for program in question.programs:
        runs = [s for s in answers[program.name] if "answer" in s]
        others = [s for s in answers[program.name] if "answer" not in s]
        first, runs = runs[:1], [s for s in runs if s["turn"]] or runs
        row = dict.fromkeys(HEADER, "") | {
            "key": question.key, "question": question.text, "program": program.name,
            "unit": f"{question.rate} / s" if question.rate else "s", "runs": str(len(runs)),
            "goal": f"{question.goal:g}" if program.name == OWN else "",
            "answer": str(last.get(program.name, "")),
        }  # fmt: skip
        if runs:
            row["figure"], row["by processor"] = (
                f"{np.median([_figure(question, s, by) for s in runs]):.4g}"
                for by in ("wall", "processor")
            )
            row["first, s"] = f"{first[0]['wall']:.4g}"
            row["first by processor, s"] = f"{first[0]['processor']:.4g}"
        for s in others:
            row["answer"] = f"missing: {s['missing']}" if "missing" in s else s["failed"]
        if program.name == OWN:
            row["faults"] = "; ".join(faults)
        rows.append(row)
    return rows


def _faults(
    question: Question, runs: list[dict[str, Any]], others: Mapping[str, Answer]
) -> list[str]:
    """What is wrong with ssmppl's answers of all turns, each said once, with how often."""
    found: dict[str, int] = {}
    for s in runs:
        if "answer" not in s:
            said = [s.get("failed", s.get("missing", ""))]
        else:
            said = question.faults(_answer(s), others) + [f"warns: {w}" for w in s["warned"]]
        for one in said:
            found[one] = found.get(one, 0) + 1
    return [f"{one} ({n} of {len(runs)} runs)" for one, n in found.items()]


def _answer(said: Mapping[str, Any]) -> Answer:
    return Answer(**said["answer"])


def _figure(question: Question, said: Mapping[str, Any], by: str) -> float:
    return said["answer"]["amount"] / said[by] if question.rate else said[by]


def markdown(rows: Iterable[Mapping[str, str]]) -> str:
    """The table as people read it; ratios are above 1 where ssmppl is better."""
    shown, own = [], {}
    for row in rows:
        if row["program"] == OWN:
            own = row
        figure = f"{row['figure']} ({row['by processor']}) {row['unit']}" if row["figure"] else ""
        ratio = ""
        if row is not own and row["figure"] and own["figure"]:
            ratio = "{:.2g} ({:.2g})".format(*(_ratio(own, row, by) for by in BY))
        goal = f"{row['goal']} {row['unit']}: {_met(row)}" if row is own else ""
        question = row["question"] if row is own else ""
        first = f"{row['first, s']} ({row['first by processor, s']}) s" if row["figure"] else ""
        shown.append(
            [question, row["program"], figure, first, ratio, goal, row["answer"], row["faults"]]
        )
    header = ["question", "program", "figure (by the processor)", "first answer of a process",
              "ssmppl is times as fast",
              "goal", "answer", "what is wrong"]  # fmt: skip
    return text(header, shown)


def _ratio(own: Mapping[str, str], row: Mapping[str, str], by: str) -> float:
    theirs, ours = float(row[by]), float(own[by])
    return theirs / ours if row["unit"] == "s" else ours / theirs


def _met(row: Mapping[str, str]) -> str:
    """Whether ssmppl's figure is within the goal: on the clock, or else by processor time."""
    for by, said in zip(BY, ("met", "met by the processor"), strict=True):
        if row[by]:
            figure, goal = float(row[by]), float(row["goal"])
            if figure <= goal if row["unit"] == "s" else figure >= goal:
                return said
    return "not met"


def kept() -> dict[str, list[dict[str, str]]]:
    """The rows of earlier runs, by question."""
    found: dict[str, list[dict[str, str]]] = {}
    if TABLE.exists():
        with TABLE.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file)
            if tuple(reader.fieldnames or ()) != HEADER:
                return {}  # of another version
            for row in reader:
                found.setdefault(row["key"], []).append(row)
    return found


def packages() -> list[str]:
    """Those of the programs that are installed."""
    out = ["numba", "numpy"]
    for name in dict.fromkeys(
        n for q in QUESTIONS.values() for p in q.programs for n in p.packages
    ):
        try:
            version(name)
        except PackageNotFoundError:
            continue
        out.append(name)
    return out


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(prog="python -m bench.answers")
    parser.add_argument("question", nargs="*", help=f"of: {', '.join(QUESTIONS)}; all unless given")
    parser.add_argument(
        "--repeats",
        type=int,
        default=3,
        help="answers that count (3); of 0 the first one of the process does",
    )
    parser.add_argument("--limit", type=float, default=1200.0, help="seconds for a question (1200)")
    parser.add_argument("--here", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args(arguments)
    unknown = [key for key in given.question if key not in QUESTIONS]
    if unknown or given.repeats < 0:
        parser.error(f"no such question: {', '.join(unknown)}" if unknown else "--repeats below 0")
    chosen = [QUESTIONS[key] for key in given.question or QUESTIONS]
    if given.here:
        for question in chosen:
            ask(question, given.repeats)
        return
    rows = {}
    for question in chosen:
        print(f"== {question.key}", file=sys.stderr, flush=True)
        rows[question.key] = rows_of(question, asked(question, given.repeats, given.limit))
        keep(kept() | {question.key: rows[question.key]})
    print(_about(), markdown([row for found in rows.values() for row in found]), sep="\n\n")


def keep(rows: Mapping[str, list[dict[str, str]]]) -> None:
    """Write the figures and the page, in the order of the questions."""
    ordered = [row for key in QUESTIONS for row in rows.get(key, ())]
    with TABLE.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, HEADER, lineterminator="\n")
        writer.writeheader()
        writer.writerows(ordered)
    title = "# Time to an answer\n\nWritten by `python -m bench.answers`."
    PAGE.write_text("\n\n".join([title, _about(), markdown(ordered)]) + "\n", encoding="utf-8")


def _about() -> str:
    return f"{machine()}. {versions(*packages())}."


if __name__ == "__main__":
    main(sys.argv[1:])
