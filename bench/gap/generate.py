"""The data sets and their sealed answers.

    python -m bench.gap.generate [--half sealed] [--ids t000 c013] [--subset ci] [--check]

`sets/<id>/` holds what a user has: `data.csv` and `model.py`. `answers/<id>.txt` holds the sealed
answer. `digests.csv` (committed) holds the digests of both; `--check` makes the sets again and
compares, which needs the NumPy version under which they were made, and says apart which data differ
and which answers. Answers hold twelve digits of the parameters: those after them depend on the
processor.

A set with a wrong starting value has a model whose priors of the physical constants are centred on
three times the usual guesses; one with a wrong noise scale has priors of the noise scales centred
on eight times theirs. In both the priors stay as wide (a factor e either way), so that a fit from
their centres has far to go, and the model is not wrong.
"""

from __future__ import annotations

import argparse
import csv
import io
from pathlib import Path

import numpy as np

from bench.gap import arm
from bench.gap.names import ITEMS
from bench.gap.plan import SPLIT, Entry, entries
from bench.gap.sealing import digest, seal
from bench.gap.strength import load, strength_of
from bench.gap.truth import SYSTEMS, System

HERE = Path(__file__).parent
SETS, ANSWERS, DIGESTS = HERE / "sets", HERE / "answers", HERE / "digests.csv"
MODELS = HERE / "systems"


def made(entry: Entry, table: dict[str, dict]) -> tuple[str, str, dict]:
    """(data.csv, model.py, answer) of one data set.

    Raises
    ------
    KeyError : the strength of one of its effects is not solved.
    """
    if entry.system == arm.NAME:
        data, parameters, strengths = arm.made(entry.seed, entry.effects)
        return data, model_text(entry), answer_of(entry, parameters, strengths)
    system = SYSTEMS[entry.system]
    chosen = {
        key: strength_of(table, system.name, key, entry.level)
        for key in entry.effects
    }  # fmt: skip
    rng = np.random.default_rng(entry.seed)
    p, e = system.drawn_parameters(rng), system.strengths(chosen)
    U, _, Y = system.recorded(p, e, system.excite(rng, system.steps), rng)
    if not np.isfinite(Y).all():
        raise ValueError(f"{entry.id}: the true system {system.name} left the numbers")
    parameters = dict(zip(system.parameters, told(p), strict=True))
    return data_text(system, U, Y), model_text(entry), answer_of(entry, parameters, chosen)


def answer_of(entry: Entry, parameters: dict[str, float], strengths: dict[str, float]) -> dict:
    """The answer that is sealed."""
    return {
        "id": entry.id,
        "half": entry.half,
        "cell": entry.cell,
        "system": entry.system,
        "level": entry.level,
        "seed": entry.seed,
        "parameters": parameters,
        "effects": [described(entry.system, key, strengths[key]) for key in entry.effects],
    }


def told(p: np.ndarray) -> list[float]:
    """True parameters as an answer holds them."""
    return [float(f"{v:.12g}") for v in p]


def described(system: str, key: str, strength: float) -> dict:
    """One effect of an answer: `names` count as right, none of them for one outside."""
    effect = arm.EFFECTS[key] if system == arm.NAME else SYSTEMS[system].effects[key]
    return {
        "key": key,
        "strength": strength,
        "names": list(ITEMS[effect.item]) if effect.item else [],
        "equations": list(effect.equations),
    }


def data_text(system: System, U: np.ndarray, Y: np.ndarray) -> str:
    """Inputs and observations as a CSV file; counts as whole numbers."""
    out = io.StringIO()
    write = csv.writer(out, lineterminator="\n")
    write.writerow([*system.inputs, *system.channels])
    shown = [[f"{v:.0f}" if system.counts else f"{v:.6g}" for v in row] for row in Y]
    for u, y in zip(U, shown, strict=True):
        write.writerow([*(f"{v:.6g}" for v in u), *y])
    return out.getvalue()


def model_text(entry: Entry) -> str:
    """The model file given with a set: the system's, its guesses off where the cell says so."""
    text = (MODELS / f"{entry.system}.py").read_text()
    for name, value in (("GUESS", entry.guess), ("NOISE", entry.noise)):
        before = f"\n{name} = 1.0  "
        if before not in text:
            raise ValueError(f"systems/{entry.system}.py does not set {name} = 1.0")
        text = text.replace(before, f"\n{name} = {value}  ")
    return text


def write(entry: Entry, table: dict[str, dict]) -> tuple[str, str, str]:
    """Write one set and its answer; returns its line of `digests.csv`."""
    data, model, answer = made(entry, table)
    sealed = seal(answer)
    folder = SETS / entry.id
    folder.mkdir(parents=True, exist_ok=True)
    ANSWERS.mkdir(exist_ok=True)
    (folder / "data.csv").write_text(data)
    (folder / "model.py").write_text(model)
    (ANSWERS / f"{entry.id}.txt").write_text(sealed)
    return entry.id, digest(data.encode(), model.encode()), digest(sealed.encode())


def read_digests() -> dict[str, tuple[str, str]]:
    """id -> (digest of data and model, digest of the sealed answer)."""
    if not DIGESTS.exists():
        return {}
    with DIGESTS.open(newline="") as file:
        return {row["id"]: (row["set"], row["answer"]) for row in csv.DictReader(file)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--half", choices=list(SPLIT["halves"]))
    parser.add_argument("--ids", nargs="*")
    parser.add_argument("--subset", choices=["ci"])
    parser.add_argument("--check", action="store_true", help="compare with the committed digests")
    options = parser.parse_args()
    table, known, lacking = load(), read_digests(), []
    differing: dict[str, list[str]] = {"data": [], "answers": []}
    for entry in entries():
        if (options.ids and entry.id not in options.ids) or options.half not in (None, entry.half):
            continue
        if options.subset and not entry.ci:
            continue
        try:
            name, data, answer = write(entry, table)
        except KeyError as error:
            lacking.append(str(error.args[0]))
            continue
        if options.check:
            for kind, was, now in zip(
                differing, known.get(name, ("", "")), (data, answer), strict=True
            ):
                if was != now:
                    differing[kind].append(name)
        else:
            known[name] = data, answer
    if not options.check:
        lines = ["id,set,answer", *(f"{k},{a},{b}" for k, (a, b) in sorted(known.items()))]
        DIGESTS.write_text("\n".join(lines) + "\n")
    print(f"{len(known)} of {len(entries())} sets have digests")
    for reason in sorted(set(lacking)):
        print("left out:", reason)
    for kind, names in differing.items():
        if names:
            print(f"{kind} not as committed: {', '.join(names)}")
    if any(differing.values()):
        raise SystemExit(1)


if __name__ == "__main__":
    main()
