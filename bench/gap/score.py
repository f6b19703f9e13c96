"""Open the answers and score the records: the table of measures with binomial intervals.

    python -m bench.gap.score [--half confirm] [--subset ci] [--methods diagnose aic correlation]
        [-o results.csv] [--require "false alarm" failed]

A rate misses its target if its 95% interval (Clopper and Pearson 1934) excludes it. Sets on which
a method failed count as wrong, never as absent; sets not yet run are left out and counted.
What counts:

- an effect is right if its name is one of the answer's names; that the equation is right too has a
  row of its own, and its class is right if some member of the first candidate's class is right;
- the confidence set is scored where the method claims an effect; its size counts effects, in
  whatever equation, since the classes list both;
- "falsely said": "none of these" on a set whose effects the catalogue has;
- both of two: each true effect is named by one of the chosen.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.gap.generate import ANSWERS, read_digests
from bench.gap.names import CHANGES, UNKNOWN
from bench.gap.plan import SPLIT, entries
from bench.gap.records import CACHE, Record, parse
from bench.gap.sealing import digest, unseal

HERE = Path(__file__).parent
NO_EFFECT = ("none", "none-start", "none-noise")


def clopper_pearson(hits: int, tries: int, level: float = 0.95) -> tuple[float, float]:
    """Exact binomial interval of a rate."""
    from scipy.stats import beta

    tail = (1 - level) / 2
    low = float(beta.ppf(tail, hits, tries - hits + 1)) if hits else 0.0
    high = float(beta.isf(tail, hits + 1, tries - hits)) if hits < tries else 1.0
    return low, high


@dataclass(frozen=True)
class Scored:
    """A record beside its opened answer."""

    record: Record
    answer: dict

    @property
    def cell(self) -> str:
        return self.answer["cell"]

    def names(self, k: int = 0) -> set[str]:
        return set(self.answer["effects"][k]["names"])

    def equations(self, k: int = 0) -> set[str]:
        return set(self.answer["effects"][k]["equations"])

    @property
    def right_first(self) -> bool:
        return bool(self.record.ranked) and self.record.ranked[0].effect in self.names()

    @property
    def right_equation(self) -> bool:
        return bool(self.record.ranked) and self.record.ranked[0].equation in self.equations()

    @property
    def right_class(self) -> bool:
        return self.right_first or any(e in self.names() for e, _ in self.record.first_class)

    @property
    def among_three(self) -> bool:
        distinct = list(dict.fromkeys(r.effect for r in self.record.ranked))
        return bool(self.names() & set(distinct[:3]))

    @property
    def held(self) -> bool:
        return any(effect in self.names() for effect, _ in self.record.confidence or ())

    @property
    def size(self) -> int:
        return len({effect for effect, _ in self.record.confidence or ()})

    @property
    def mechanism(self) -> bool:
        """Whether the truth is one effect of the catalogue, and a mechanism."""
        return bool(self.names()) and not self.names() & (UNKNOWN | CHANGES)

    @property
    def unknown_first(self) -> bool:
        """Whether the answer begins with what names no mechanism."""
        return bool(self.record.chosen) and self.record.chosen[0][0] in UNKNOWN

    @property
    def both(self) -> bool:
        chosen = {effect for effect, _ in self.record.chosen}
        return all(self.names(k) & chosen for k in range(len(self.answer["effects"])))

    def share(self, right: bool) -> float:
        """F of the true effect, or of the best-ranked one outside the class of the truth."""
        ids = {r.class_id for r in self.record.ranked if r.effect in self.names()}
        for r in self.record.ranked:
            is_right = r.effect in self.names()
            if is_right if right else not is_right and (not r.class_id or r.class_id not in ids):
                labels = (r.effect, f"{r.effect} on {r.equation}")
                found = [s.F for s in self.record.shares if s.effect in labels]
                if found or not right:
                    return found[0] if found else math.nan
        return math.nan


@dataclass(frozen=True)
class Row:
    """One measure of one method: a rate with its interval, or a median."""

    measure: str
    method: str
    value: float
    low: float
    high: float
    hits: int
    sets: int
    target: str

    @property
    def missed(self) -> bool:
        """Whether the 95% interval excludes the target."""
        sign, _, bound = self.target.partition(" ")
        if not bound or math.isnan(self.value) or math.isnan(self.low):
            return False
        if sign == "in":
            least, most = map(float, bound.split("-"))
            return self.high < least or self.low > most
        return self.high < float(bound) if sign == ">=" else self.low > float(bound)


def rate(measure: str, method: str, hits: Iterable[bool], target: str) -> Row:
    outcomes = list(hits)
    n, k = len(outcomes), sum(outcomes)
    low, high = clopper_pearson(k, n) if n else (math.nan, math.nan)
    return Row(measure, method, k / n if n else math.nan, low, high, k, n, target)


def median(measure: str, method: str, values: Iterable[float], target: str) -> Row:
    """Median with its distribution-free 95% interval from order statistics; NaN are left out."""
    from scipy.stats import binom

    finite = np.sort([v for v in values if not math.isnan(v)])
    n = len(finite)
    if n == 0:
        return Row(measure, method, math.nan, math.nan, math.nan, 0, 0, target)
    k = int(binom.ppf(0.025, n, 0.5))
    low, high = (finite[k - 1], finite[n - k]) if k >= 1 else (-math.inf, math.inf)
    return Row(measure, method, float(np.median(finite)), float(low), float(high), n, n, target)


SIMULATES = 1.2  # times the true model's error
Shares = dict[str, dict[str, float]]  # id -> numbers, as fresh.py and simulated.py write them


def measures(
    method: str, scored: Sequence[Scored], fresh: Shares | None = None,
    simulated: Shares | None = None,
) -> list[Row]:  # fmt: skip
    """All rows of one method."""

    def of(*cells: str) -> list[Scored]:
        return [s for s in scored if s.cell in cells]

    def both_levels(text: str, test: Callable[[Scored], bool], low: str, high: str) -> list[Row]:
        return [
            rate(f"{text}, 20 nats", method, map(test, of("one-20")), low),
            rate(f"{text}, 50 nats", method, map(test, of("one-50")), high),
        ]

    ones = of("one-20", "one-50")
    claims = [s for s in ones if s.record.confidence is not None]
    strong = [s for s in of("one-50") if s.record.confidence is not None]
    rows = [
        *both_levels("right effect first", lambda s: s.right_first, ">= 0.75", ">= 0.90"),
        *both_levels("its class first", lambda s: s.right_class, ">= 0.85", ">= 0.95"),
        rate("among the first three", method, (s.among_three for s in ones), ">= 0.95"),
        rate("right equation", method, (s.right_equation for s in ones), ">= 0.90"),
        rate("effect and equation", method, (s.right_first and s.right_equation for s in ones), ""),
        rate(
            "an unknown input or a noise law first, of mechanisms",
            method,
            (s.unknown_first for s in ones if s.mechanism),
            "<= 0.05",
        ),
        rate("confidence set holds the truth", method, (s.held for s in claims), ">= 0.95"),
        median("its size at 50 nats", method, (float(s.size) for s in strong), "<= 2"),
        rate("an effect detected, 20 nats", method, map(detected, of("one-20")), ""),
        rate("an effect detected, 50 nats", method, map(detected, of("one-50")), ""),
        rate("false alarm", method, map(detected, of(*NO_EFFECT)), "<= 0.07"),
    ]
    for cell in NO_EFFECT:
        rows.append(rate(f"false alarm, {cell}", method, map(detected, of(cell)), "<= 0.07"))
    rows += [
        rate("none of these found", method, map(says_none, of("outside-50")), ">= 0.70"),
        rate("none of these falsely said", method, map(says_none, of(*SPLIT_INSIDE)), "<= 0.10"),
        rate("both of two found", method, (s.both for s in of("two-50")), ">= 0.60"),
        median("F of the true effect, 20 nats", method,
               (true_share(s, fresh) for s in of("one-20")), ">= 0.80"),
        median("F of a wrong one, 20 nats", method,
               (s.share(False) for s in of("one-20")), "<= 0.05"),
        rate("interval covers F*", method, covers(ones, fresh or {}), "in 0.90-0.98"),
        rate(
            "simulates within 1.2 of the true model, class right",
            method,
            (simulated[s.record.id]["after"] <= SIMULATES for s in ones
             if simulated and s.right_class and s.record.id in simulated),
            ">= 0.80",
        ),
        rate("right effect first, arm", method, (s.right_first for s in of("arm")), ""),
        rate("its class first, arm", method, (s.right_class for s in of("arm")), ""),
        rate("right equation, arm", method, (s.right_equation for s in of("arm")), ""),
        rate("false alarm, arm-none", method, map(detected, of("arm-none")), ""),
        rate("failed", method, (bool(s.record.failed) for s in scored), "<= 0"),
        median("seconds", method, (s.record.seconds for s in scored), ""),
    ]  # fmt: skip
    return rows


SPLIT_INSIDE = ("one-20", "one-50", "two-50")


def by_system(scored: Sequence[Scored]) -> str:
    """Sets with one effect, all levels together, system by system: a table of hits."""
    tests: dict[str, Callable[[Scored], bool]] = {
        "first": lambda s: s.right_first, "class first": lambda s: s.right_class,
        "equation": lambda s: s.right_equation, "none of these, falsely": says_none,
        "not detected": lambda s: not detected(s),
    }  # fmt: skip
    ones = [s for s in scored if s.cell in ("one-20", "one-50", "arm")]
    lines = ["| system | sets | " + " | ".join(tests) + " |", "|---" * (len(tests) + 2) + "|"]
    for name in dict.fromkeys(s.answer["system"] for s in ones):
        own = [s for s in ones if s.answer["system"] == name]
        hits = " | ".join(str(sum(map(test, own))) for test in tests.values())
        lines.append(f"| {name} | {len(own)} | {hits} |")
    return "\n".join(lines)


def detected(s: Scored) -> bool:
    return s.record.verdict != "no measurable gap"


def says_none(s: Scored) -> bool:
    return s.record.verdict == "none of these"


def true_share(s: Scored, fresh: Shares | None) -> float:
    """F against the true model where `fresh.py` has it and the chosen effect is right."""
    again = (fresh or {}).get(s.record.id)
    chosen = {effect for effect, _ in s.record.chosen}
    if again is not None:
        return again["F"] if chosen & s.names() else math.nan
    return s.share(True)


def covers(scored: Iterable[Scored], fresh: Shares) -> list[bool]:
    """Whether the intervals hold F*; sets without a measurable gap have none."""
    held = []
    for s in scored:
        again = fresh.get(s.record.id)
        if again is not None and not any(map(math.isnan, (again["low"], again["F_star"]))):
            held.append(again["low"] <= again["F_star"] <= again["high"])
    return held


def opened(ids: Iterable[str]) -> dict[str, dict]:
    """The answers, each checked against its committed digest.

    Raises
    ------
    ValueError : an answer is not the one that was sealed.
    """
    known, answers = read_digests(), {}
    for id in ids:
        text = (ANSWERS / f"{id}.txt").read_text()
        if id not in known or known[id][1] != digest(text.encode()):
            raise ValueError(f"the answer of {id} differs from digests.csv")
        answers[id] = unseal(text)
    return answers


def records(method: str, code: str | None = None) -> dict[str, Record]:
    """The kept records of a method, by id: the newest of each, or those of one digest."""
    found: dict[str, tuple[float, Record]] = {}
    for path in sorted((CACHE / method).glob("*/*.json")):
        record, age = parse(path.read_text()), path.stat().st_mtime
        if code and not record.digest.startswith(code):
            continue
        if record.id not in found or found[record.id][0] < age:
            found[record.id] = age, record
    return {id: record for id, (_, record) in sorted(found.items())}


def table(rows: Sequence[Row], methods: Sequence[str]) -> str:
    """Measures down, methods across, in Markdown; a star where the target is missed."""
    lines = ["| measure | target | " + " | ".join(methods) + " |"]
    lines.append("|---" * (len(methods) + 2) + "|")
    for measure in dict.fromkeys(r.measure for r in rows):
        cells = []
        for method in methods:
            r = next(r for r in rows if (r.measure, r.method) == (measure, method))
            star = "*" if r.missed else ""
            cells.append(f"{r.value:.2f} [{r.low:.2f}, {r.high:.2f}] n={r.sets}{star}"
                         if r.sets else "-")  # fmt: skip
        target = next(r.target for r in rows if r.measure == measure)
        lines.append(f"| {measure} | {target} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> None:
    import pandas as pd

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--half", choices=list(SPLIT["halves"]))
    parser.add_argument("--subset", choices=["ci"])
    parser.add_argument("--methods", nargs="+", default=["diagnose"])
    parser.add_argument("--systems", action="store_true", help="hits system by system, too")
    parser.add_argument("-o", "--output", type=Path)
    parser.add_argument(
        "--require", nargs="*", default=[], help="measures whose missed target is an error"
    )
    options = parser.parse_args()
    ids = [
        e.id
        for e in entries()
        if options.half in (None, e.half) and (options.subset is None or e.ci)
    ]
    fresh, simulated = (
        json.loads(path.read_text()) if (path := CACHE / name).exists() else {}
        for name in ("fresh.json", "simulated.json")
    )
    rows: list[Row] = []
    systems: list[str] = []
    for method in options.methods:
        kept = {id: r for id, r in records(method).items() if id in ids}
        answers = opened(kept)
        print(f"{method}: {len(kept)} of {len(ids)} sets run")
        scored = [Scored(record, answers[id]) for id, record in kept.items()]
        rows += measures(method, scored, fresh.get(method, {}), simulated.get(method, {}))
        systems.append(f"\n{method}\n\n{by_system(scored)}")
    print(table(rows, options.methods))
    if options.systems:
        print("\n".join(systems))
    if options.output:
        frame = pd.DataFrame([{**vars(r), "missed": r.missed} for r in rows])
        frame.to_csv(options.output, index=False)
    lacking = [r for r in rows if r.measure in options.require and r.missed]
    unknown = set(options.require) - {r.measure for r in rows}
    if lacking or unknown:
        named = ", ".join([f"{r.method}: {r.measure}" for r in lacking] + sorted(unknown))
        raise SystemExit(f"missed, or no measure: {named}")


if __name__ == "__main__":
    main()
