"""Four rivals on the same data: what people do today when a simulator does not match.

    python -m bench.gap.rivals [--methods correlation sparse aic loop] [--half confirm] [--ids t000]

`correlation`: the largest correlation of the standardised residuals with the catalogue's terms,
Bonferroni's p. `sparse`: sparse regression of the smoothed states' residuals on the same terms
(sequentially thresholded least squares, Brunton, Proctor and Kutz 2016, by pysindy; the threshold
is chosen on the last 30% of the rows). `aic`: the best AIC over all single refits (Akaike 1974);
whoever runs it gives the refits: `--refits module:function` names a function of a set's folder that
returns the base model's log-likelihood and a `Refit` for each (effect, equation). `loop`: the
effect with the largest correlation is added and the model refitted, again and again while the BIC
falls (`loop.py`).

The first three start from the model fitted to the screen and choose parts together, the first 70%
of the rows; `loop` fits all of them. All name effects in the catalogue's words. None of them tells
classes, so each candidate is one.
"""

from __future__ import annotations

import argparse
import math
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

import numpy as np

from bench.gap import arm
from bench.gap.fits import prepare
from bench.gap.loop import of_folder
from bench.gap.plan import CELLS, SPLIT, entries
from bench.gap.records import Ranked, Record, keep, parse, path_of
from bench.gap.run import SETS, method_digest, selected
from bench.gap.sealing import digest, file_digest
from bench.gap.terms import Residuals, Term, library

ALPHA = 0.05
FIT = 0.7  # share of the rows that fits use
THRESHOLDS = np.geomspace(0.02, 1.0, 15)  # of sparse regression, on standardised columns


# -- correlation
def correlation(terms: Sequence[Term]) -> tuple[str, float, tuple[Ranked, ...]]:
    """(verdict, p, ranking) by |r| sqrt(n), p two-sided by the normal law times the candidates."""
    from scipy.stats import norm

    best: dict[tuple[str, str], float] = {}
    for term in terms:
        z = term.z
        if z is None:
            z = _correlation(term.target, term.column) * math.sqrt(len(term.target))
        z = abs(z)
        key = (term.effect, term.equation)
        best[key] = max(best.get(key, 0.0), z)
    order = sorted(best, key=lambda key: -best[key])
    ps = {key: min(1.0, 2 * float(norm.sf(best[key])) * len(terms)) for key in order}
    ranked = tuple(Ranked(*key, str(k), p=ps[key]) for k, key in enumerate(order))
    p = ranked[0].p if ranked else 1.0
    return ("effect" if p < ALPHA else "no measurable gap"), p, ranked


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    if np.ptp(b) > 0:  # a constant is a term too, which centring would remove
        a, b = a - a.mean(), b - b.mean()
    size = math.sqrt(float(a @ a) * float(b @ b))
    return float(a @ b) / size if size > 0 else 0.0


# -- sparse regression
def sparse(terms: Sequence[Term], solver: Callable | None = None) -> tuple[str, tuple[Ranked, ...]]:
    """(verdict, ranking) by the share of a residual's variance that a kept term carries.

    For each equation the threshold with the least squared error on the last 30% of the rows; an
    effect is claimed where that beats no term at all. solver(columns, target, threshold) gives
    coefficients; None: pysindy's STLSQ.

    Raises
    ------
    ImportError : pysindy is not installed.
    """
    solver = solver or stlsq
    found: dict[tuple[str, str], float] = {}
    kept = False
    for equation in dict.fromkeys(t.residual for t in terms):
        group = [t for t in terms if t.residual == equation and t.moment == "mean"]
        group = [t for t in group if t.column.std() > 0]
        if not group:
            continue
        target = group[0].target / max(group[0].target.std(), 1e-300)
        columns = np.stack([t.column / np.sqrt(np.mean(t.column**2)) for t in group], axis=1)
        cut = int(FIT * len(target))
        plain, best, chosen = float(np.mean(target[cut:] ** 2)), math.inf, np.zeros(len(group))
        for threshold in THRESHOLDS:
            w = solver(columns[:cut], target[:cut], threshold)
            error = float(np.mean((target[cut:] - columns[cut:] @ w) ** 2))
            if error < best:
                best, chosen = error, w
        if best < plain and np.any(chosen):
            kept = True
        for term, w in zip(group, chosen, strict=True):
            key = (term.effect, term.equation)
            share = w**2 if best < plain else 0.0
            found[key] = max(found.get(key, 0.0), float(share))
    order = sorted(found, key=lambda key: -found[key])
    ranked = tuple(Ranked(*key, str(k), gain=found[key]) for k, key in enumerate(order))
    return ("effect" if kept else "no measurable gap"), ranked


def stlsq(columns: np.ndarray, target: np.ndarray, threshold: float) -> np.ndarray:
    """Coefficients by pysindy's sequentially thresholded least squares."""
    import warnings

    from pysindy import STLSQ  # type: ignore[import-not-found, unused-ignore]

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that a threshold leaves nothing
        solver = STLSQ(threshold=float(threshold), alpha=1e-3)
        solver.fit(columns, target[:, None])
    return np.asarray(solver.coef_)[0]


# -- information criterion
@dataclass(frozen=True)
class Refit:
    """A fit of the model with one effect: its log-likelihood and how many more parameters."""

    log_likelihood: float
    extra: int = 1


def aic(base: float, refits: Mapping[tuple[str, str], Refit]) -> tuple[str, tuple[Ranked, ...]]:
    """(verdict, ranking) by the fall of AIC/2 from the base model's: log-likelihood gained less
    parameters added. refits : (effect, equation) -> the best of its forms and shapes."""
    gain = {key: r.log_likelihood - base - r.extra for key, r in refits.items()}
    order = sorted(gain, key=lambda key: -gain[key])
    ranked = tuple(Ranked(*key, str(k), gain=gain[key]) for k, key in enumerate(order))
    found = bool(ranked) and ranked[0].gain > 0
    return ("effect" if found else "no measurable gap"), ranked


# -- running
Refits = Callable[[Path], tuple[float, Mapping[tuple[str, str], Refit]]]


def recorded(
    id: str, method: str, prepare: Callable[[Path], Residuals], refits: Refits | None = None
) -> Record:
    """The record of one rival on one set, kept or made now.

    prepare(folder) gives the residuals of the fitted model; refits(folder) gives (base
    log-likelihood, refits) for `aic`.
    """
    folder, here = SETS / id, Path(__file__).parent
    own = ("loop.py", "disturbances.py") if method == "loop" else ("rivals.py", "terms.py")
    code = digest(
        file_digest(*(here / name for name in own)).encode(),
        file_digest(folder / "data.csv", folder / "model.py").encode(),
        *([method_digest().encode()] if method == "loop" else []),
    )
    path = path_of(id, method, code)
    if path.exists():
        return parse(path.read_text())
    began, p, failed = time.perf_counter(), math.nan, ""
    verdict = "no measurable gap"
    ranked: tuple[Ranked, ...] = ()
    count = 2  # of the ranked ones that are chosen, where an effect is claimed
    try:
        if method == "aic" and refits is not None:
            verdict, ranked = aic(*refits(folder))
        elif method == "loop":
            verdict, ranked, count = of_folder(folder)
        else:
            terms = library(prepare(folder))
            if method == "correlation":
                verdict, p, ranked = correlation(terms)
            else:
                verdict, ranked = sparse(terms)
    except ImportError:
        raise
    except Exception:
        failed = traceback.format_exc()
    chosen = tuple((r.effect, r.equation) for r in ranked[:count]) if verdict == "effect" else ()
    first = ((ranked[0].effect, ranked[0].equation),) if ranked else ()
    record = Record(
        id,
        method,
        code,
        verdict,
        ranked,
        chosen,
        first,
        p_detect=p,
        seconds=time.perf_counter() - began,
        failed=failed,
    )
    keep(record)
    return record


def named(spec: str) -> Callable:
    """The function that 'module:function' names."""
    module, _, function = spec.partition(":")
    return getattr(import_module(module), function)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--methods", nargs="+", default=["correlation", "sparse"],
                        choices=["correlation", "sparse", "aic", "loop"])  # fmt: skip
    parser.add_argument("--refits", help="module:function, for aic")
    parser.add_argument("--half", choices=list(SPLIT["halves"]))
    parser.add_argument("--cell", choices=CELLS)
    parser.add_argument("--subset", choices=["ci"])
    parser.add_argument("--ids", nargs="*")
    options = parser.parse_args()
    if "aic" in options.methods and not options.refits:
        parser.error("aic needs --refits module:function")
    refits = named(options.refits) if options.refits else None
    ids = selected(options.half, options.cell, options.subset, options.ids)
    arms = {e.id for e in entries() if e.system == arm.NAME}  # no filter of their own
    for method in options.methods:
        for id in ids:
            if method != "aic" and id in arms:
                continue
            if not (SETS / id / "data.csv").exists():
                print(f"{id} is not made: run python -m bench.gap.generate")
                continue
            try:
                r = recorded(id, method, prepare, refits)
            except ImportError as error:
                print(f"{method} is left out: {error} (pip install pysindy)")
                break
            first = f"{r.ranked[0].effect} on {r.ranked[0].equation}" if r.ranked else ""
            what = r.failed.splitlines()[-1] if r.failed else f"{r.verdict}: {first}"
            print(f"{method} {r.id} {r.seconds:6.1f} s  {what}", flush=True)


if __name__ == "__main__":
    main()
