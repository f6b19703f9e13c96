"""Record: what one method said about one data set, in the same form for all methods; kept as JSON.

Records never hold an answer: they are made before the answers are opened.
"""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
CACHE = HERE / "cache"


@dataclass(frozen=True)
class Ranked:
    """One candidate, best first in its list. Candidates of one class share a class_id."""

    effect: str
    equation: str
    class_id: str = ""
    form: str = ""
    p: float = math.nan
    gain: float = math.nan


@dataclass(frozen=True)
class Share:
    """A share F of the gap that is closed, with its interval, for one effect."""

    effect: str
    F: float
    low: float
    high: float


@dataclass(frozen=True)
class Record:
    """verdict: "effect", "none of these" or "no measurable gap". chosen: labels as the method
    gives them. first_class: candidates that are not told apart from the first, with it, as (effect,
    equation). confidence: what the confidence set holds, None where the method claims no effect or
    has no such set. estimates: parameters before and after."""

    id: str
    method: str
    digest: str
    verdict: str
    ranked: tuple[Ranked, ...] = ()
    chosen: tuple[tuple[str, str], ...] = ()  # (effect, equation)
    first_class: tuple[tuple[str, str], ...] = ()
    confidence: tuple[tuple[str, str], ...] | None = None
    p_detect: float = math.nan
    shares: tuple[Share, ...] = ()
    seconds: float = math.nan
    mode: str = ""
    model_text: str = ""
    estimates: dict[str, dict[str, Any]] = field(default_factory=dict)
    failed: str = ""

    def text(self) -> str:
        return json.dumps(_plain(asdict(self)), indent=1, sort_keys=True) + "\n"


def parse(text: str) -> Record:
    """The record in a JSON text."""
    raw = json.loads(text, parse_constant=float)
    raw["ranked"] = tuple(Ranked(**_numbers(r)) for r in raw["ranked"])
    raw["shares"] = tuple(Share(**_numbers(s)) for s in raw["shares"])
    for key in ("chosen", "first_class"):
        raw[key] = tuple(map(tuple, raw[key]))
    if raw["confidence"] is not None:
        raw["confidence"] = tuple(map(tuple, raw["confidence"]))
    return Record(**_numbers(raw))


NUMBERS = ("p", "gain", "F", "low", "high", "p_detect", "seconds")


def _numbers(raw: dict[str, Any]) -> dict[str, Any]:
    return {k: math.nan if v is None and k in NUMBERS else v for k, v in raw.items()}


def _plain(value: Any) -> Any:
    """JSON without NaN: missing numbers are null; infinite ones keep their name."""
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    if isinstance(value, float) and math.isnan(value):
        return None
    return value


def path_of(id: str, method: str, digest: str) -> Path:
    """Where the record of a method, by the digest of its code and of the set, is kept."""
    return CACHE / method / digest[:12] / f"{id}.json"


def keep(record: Record) -> None:
    path = path_of(record.id, record.method, record.digest)
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(".part")
    part.write_text(record.text())
    part.replace(path)  # whole or not at all


def from_report(id: str, digest: str, report: Any) -> Record:
    """The record of a GapReport."""
    causes = report.causes
    ranked = tuple(
        Ranked(
            str(row.effect),
            str(row.equation),
            str(row.class_id),
            str(row.form),
            float(row.p),
            float(row.gain_refit if not math.isnan(row.gain_refit) else row.gain_screen),
        )
        for row in causes.itertuples()
    )
    shares = tuple(
        Share(str(row.effect), float(row.F), float(row.F_low), float(row.F_high))
        for row in report.closed.itertuples()
    )
    return Record(
        id,
        "diagnose" if report.mode == "full" else f"diagnose-{report.mode}",
        digest,
        report.verdict,
        ranked,
        chosen_of(report.chosen, ranked),
        first_class := first_class_of(report, ranked),
        first_class if report.verdict == "effect" else None,
        float(report.detection["p"].min()) if len(report.detection) else math.nan,
        shares,
        float(report.seconds),
        report.mode,
        report.model_text,
        report.estimates,
    )


def chosen_of(labels: list[str], ranked: tuple[Ranked, ...]) -> tuple[tuple[str, str], ...]:
    """(effect, equation) of labels "effect" or "effect on equation"; of the first, the best
    ranked equation of that effect."""
    found = []
    for label in labels:
        exact = [r for r in ranked if label in (f"{r.effect} on {r.equation}", r.effect)]
        if exact:
            found.append((exact[0].effect, exact[0].equation))
        else:
            effect, _, equation = label.partition(" on ")
            found.append((effect, equation))
    return tuple(found)


def first_class_of(report: Any, ranked: tuple[Ranked, ...]) -> tuple[tuple[str, str], ...]:
    """The first candidate and those of its class, in both tables of the report."""
    if not ranked:
        return ()
    first = ranked[0]
    members = {(r.effect, r.equation) for r in ranked if r.class_id == first.class_id}
    classes = report.classes
    same = classes[classes["class_id"].astype(str) == first.class_id]
    members |= {(str(r.effect), str(r.equation)) for r in same.itertuples()}
    return tuple(sorted(members | {(first.effect, first.equation)}))
