"""How strong an effect has to be for a given expected gain in nats: `strengths.json`.

nats(strength) = mean over simulated sets of log p(confirm | true model, refitted) -
log p(confirm | base, refitted), both fitted to the first 70% of the rows, the filter run from the
first row. The true model's refit frees its parameters and the effect's strength, its shape being
known. Each set has its own inputs and its own parameters, about 5% from the nominal ones, as the
benchmark's sets have; the same random numbers serve every strength, so that a secant on the
logarithms of strength and gain converges in a few steps.

    python -m bench.gap.strength [--system oscillator] [--level 20] [--redo]
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import json
import time
import zlib
from pathlib import Path

import numpy as np

from bench.gap.filter import terms
from bench.gap.fit import fit
from bench.gap.plan import SPLIT, UNREACHABLE
from bench.gap.truth import SYSTEMS, System, forms

HERE = Path(__file__).parent
TABLE = HERE / "strengths.json"
SETS = 24
FEW, MORE = 300, 4  # a system of fewer rows has so many times the sets: each tells less
LEVELS = (20, 50)
CLOSE = 0.08  # relative distance from the level at which a search ends
LONGEST = 8  # evaluations of a search
CONFIRM = 0.7  # share of the rows before the confirm part


def code_digest(system: System) -> str:
    """What the strengths of a system depend on: the statements of its module, of the forms and of
    what draws the sets, whatever their comments, layout and types."""
    here = HERE / "truth"
    paths = (here / f"{system.name}.py", here / "system.py", Path(forms.__file__))
    trees = (_Bare().visit(ast.parse(path.read_text())) for path in paths)
    return hashlib.sha256("\n".join(map(ast.unparse, trees)).encode()).hexdigest()[:12]


class _Bare(ast.NodeTransformer):
    """Without docstrings, types and what is imported."""

    def visit_Expr(self, node: ast.Expr) -> ast.Expr | None:
        text = isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
        return None if text else node

    def visit_ImportFrom(self, node: ast.ImportFrom) -> None:
        return None

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.FunctionDef:
        self.generic_visit(node)
        node.returns = None
        for argument in node.args.args:
            argument.annotation = None
        return node

    def visit_AnnAssign(self, node: ast.AnnAssign) -> ast.AST:
        if node.value is None or not isinstance(node.target, ast.Name):
            return node
        return ast.copy_location(ast.Assign([node.target], node.value), node)


def gains(
    system: System,
    strengths: dict[str, float],
    sets: int = SETS,
    starts: dict[int, np.ndarray] | None = None,
) -> np.ndarray:
    """Gain in nats on the confirm part of `sets` simulated sets, (sets,).

    starts : parameters at which the base fits began to converge, by set; read and updated.
    """
    rows = int(CONFIRM * system.steps)
    e = system.strengths(strengths)
    none = np.zeros_like(e)
    starts = {} if starts is None else starts
    out = np.empty(sets)
    for k in range(sets):
        rng = np.random.default_rng([SPLIT["solver_seed"], zlib.crc32(system.name.encode()), k])
        p = system.drawn_parameters(rng)
        U, _, Y = system.recorded(p, e, system.excite(rng, system.steps), rng)
        base = fit(system, U, Y, (), starts.get(k, p), none, rows)
        starts[k] = base.p
        true = fit(system, U, Y, tuple(strengths), p, e, rows)
        ll = [terms(system, f.p, f.e, U, Y)[0][rows:].sum() for f in (base, true)]
        out[k] = ll[1] - ll[0]
    return out


def solve(system: System, key: str, level: float, guess: float | None = None) -> dict:
    """Strength of one effect at which the expected gain is `level` nats, with its standard error.

    The table row: strength, nats reached, their standard error, evaluations, seconds, and
    `solved`, which says whether the level was met.
    """
    began = time.perf_counter()
    start = system.effects[key].start if guess is None else guess
    sign, size = np.sign(start), abs(start)
    starts: dict[int, np.ndarray] = {}
    seen: list[tuple[float, float, float]] = []  # log strength, gain, its standard error
    for _ in range(LONGEST):
        many = SETS * (MORE if system.steps < FEW else 1)
        g = gains(system, {key: sign * size}, many, starts)
        seen.append((np.log(size), g.mean(), g.std(ddof=1) / np.sqrt(len(g))))
        if abs(seen[-1][1] / level - 1) < CLOSE:
            break
        size = np.exp(next_log_strength([s[:2] for s in seen], level))
    best = min(seen, key=lambda s: abs(s[1] - level))
    return {
        "strength": float(sign * np.exp(best[0])),
        "nats": round(best[1], 2),
        "se": round(best[2], 2),
        "solved": bool(abs(best[1] / level - 1) < 1.25 * CLOSE),
        "evaluations": len(seen),
        "seconds": round(time.perf_counter() - began, 1),
        "code": code_digest(system),
    }


def next_log_strength(seen: list[tuple[float, float]], level: float) -> float:
    """Where to look next, from (log strength, gain) pairs: between the nearest points on both
    sides of the level by the chord of log gain, else outwards with the exponent of the two nearest
    points, 2 at first."""
    positive = [(s, max(g, 0.3)) for s, g in seen]
    low = [pt for pt in positive if pt[1] < level]
    high = [pt for pt in positive if pt[1] >= level]
    if low and high:
        a, b = max(low, key=lambda pt: pt[1]), min(high, key=lambda pt: pt[1])
        share = np.log(level / a[1]) / np.log(b[1] / a[1])
        return a[0] + float(np.clip(share, 0.1, 0.9)) * (b[0] - a[0])
    ordered = sorted(positive, key=lambda pt: abs(np.log(level / pt[1])))
    last, slope = ordered[0], 2.0
    if len(ordered) > 1 and ordered[1][0] != last[0]:
        slope = np.log(ordered[1][1] / last[1]) / (ordered[1][0] - last[0])
        slope = float(np.clip(slope, 0.4, 4.0))
    return last[0] + float(np.clip(np.log(level / last[1]) / slope, -1.0, 1.0))


def load() -> dict[str, dict]:
    """The table: 'system/effect/level' -> row."""
    return json.loads(TABLE.read_text()) if TABLE.exists() else {}


def save(table: dict[str, dict]) -> None:
    TABLE.write_text(json.dumps(dict(sorted(table.items())), indent=1) + "\n")


def strength_of(table: dict[str, dict], system: str, key: str, level: int) -> float:
    """The solved strength; raises KeyError where it is missing or its search failed."""
    row = table.get(f"{system}/{key}/{level}")
    if row is None or not row["solved"]:
        raise KeyError(f"no strength for {system}/{key}/{level}: run python -m bench.gap.strength")
    return row["strength"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--system", choices=list(SYSTEMS))
    parser.add_argument("--effect")
    parser.add_argument("--level", type=int, choices=LEVELS)
    parser.add_argument("--redo", action="store_true", help="also what is solved")
    parser.add_argument("--retry", action="store_true", help="also what was not solved before")
    options = parser.parse_args()
    table = load()
    for name in [options.system] if options.system else SYSTEMS:
        system = SYSTEMS[name]
        for key, effect in system.effects.items():
            if options.effect not in (None, key):
                continue
            guess = None
            for level in LEVELS if options.level is None else (options.level,):
                unreachable = level == 50 and f"{name}/{key}" in UNREACHABLE
                if unreachable or (effect.item is None and level == 20):
                    continue
                label = f"{name}/{key}/{level}"
                row = table.get(label)
                wanted = options.redo or row is None or row["code"] != code_digest(system)
                if wanted or row is None or (options.retry and not row["solved"]):
                    row = solve(system, key, level, guess)
                    table = load()
                    table[label] = row
                    save(table)
                    print(f"{label}: {row}", flush=True)
                guess = row["strength"] * np.sqrt(50 / 20)
    print(f"{sum(r['solved'] for r in table.values())} of {len(table)} rows solved")


if __name__ == "__main__":
    main()
