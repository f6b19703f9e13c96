"""The diagnosis on measured data whose answer the literature has.

    python -m bench.gap.real.run NAME... [--shared PATH] [--sources PATH] [--out build/real]
        [--mode fast]
    python -m bench.gap.real.run --table [--out build/real]

Each case gets a simple model and no hint, seed 1. NAME is a case (all without one): `measles`,
`hare_lynx`, `beaver`, `nile`, `house`, `cooling_water`, `electricity`, `power_plant`, with models
in this folder and data that packages carry; `emps`, `silverbox`, `tclab`, with models and data in
`cases/` of PATH (or of $SSMPPL_SHARED, or of ../shared); `multisine`, `drives1`, `drives2`, with
models in this folder and data in `data/` of PATH. What is not there is skipped, and the run says
what it needs. What counts as right was written down before the first run, in the models' files and
below.

A report goes to OUT/NAME, and one line, which is printed too, to OUT/NAME.json: the headline, the
error of simulations over the default horizon on rows not used, before and after, the grade
(`answers.py`) and the seconds. `--table` prints the lines that are there.

The model that `multisine` gives back is also compared with the linear one on the part of the
Silverbox's record with growing amplitude, by the error of a simulation that never looks at the
answers; that of `emps` by windows of half a second of its other record, from filtered states.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
from scipy.io import loadmat

import ssmppl as ssm
from bench.gap.real.answers import Absent, Named, Right, grade, named
from ssmppl.diagnosis.fitting.augmented_models import proposal_of
from ssmppl.diagnosis.fitting.fit import Fitter
from ssmppl.diagnosis.model.smoothing import Settings
from ssmppl.diagnosis.report import words
from ssmppl.diagnosis.report.report import GapReport
from ssmppl.diagnosis.selection.horizons import look_ahead
from ssmppl.inference.run.problem import pose
from ssmppl.modelfile import load_model

HERE = Path(__file__).parent
PACKAGED = ("measles", "hare_lynx", "beaver", "nile", "house", "cooling_water", "electricity",
            "power_plant")  # fmt: skip
WINDOW, PARTICLES = 25, 100  # rows of the servo's windows, half a second; as in full mode
MULTISINE, GROWING = slice(45_000, 46_000), slice(100, 40_575)  # rows of the Silverbox
COLUMNS = ("case", "rows", "known", "headline", "before", "after", "horizon", "grade", "seconds")


@dataclass(frozen=True)
class Case:
    """A model file, the data, what the model lacks and which effects say so."""

    model: Path
    records: Callable[[], pd.DataFrame]
    lacks: str
    right: Right


# -- the data
def there(path: Path) -> Path:
    if not path.exists():
        raise Absent(f"needs {path}: say --shared")
    return path


def silverbox(folder: Path) -> pd.DataFrame:
    """All rows: y, u, and the sum of the u beside it."""
    path = there(folder / "silverbox" / "SNLS80mV.csv")
    raw = pd.read_csv(path, usecols=["V1", "V2"]).dropna()
    u = raw["V1"].to_numpy()
    beside = np.convolve(u, [1.0, 0.0, 1.0], mode="same")
    return pd.DataFrame({"y": raw["V2"].to_numpy(), "u": u, "beside": beside})


def multisine(folder: Path) -> pd.DataFrame:
    """The rows that are diagnosed."""
    return silverbox(folder).iloc[MULTISINE].reset_index(drop=True)


def drives(folder: Path, record: int) -> pd.DataFrame:
    """Record 1, 2 or 3."""
    raw = loadmat(there(folder / "coupled_drives" / "drive.mat"))
    return pd.DataFrame({"y": raw[f"z{record}"].ravel(), "u": raw[f"u{record}"].ravel()})


# -- the cases. Of those that are no part of the project, the answers are these:
def friction(n: Named) -> bool:
    """EMPS: A. Janot, M. Gautier, M. Brunot, Workshop on Nonlinear System Identification Benchmarks
    2019: the axis has dry friction, and an offset of the force."""
    return n.among("coulomb friction", "stribeck")


def spring(n: Named) -> bool:
    """Silverbox: Wigren and Schoukens, ECC 2013: the spring is a polynomial of third degree."""
    return n.among("cubic stiffness")


def second_mass(n: Named) -> bool:
    """The Temperature Control Lab: J. Park, R. A. Martin, J. D. Kelly, J. D. Hedengren, Computers
    and Chemical Engineering 135, 2020: heater and sensor each have a time constant."""
    return n.among("actuator lag", "sensor lag")


def unsigned(n: Named) -> bool:
    """The drives: Wigren and Schoukens, report 2017-024: the sensor does not tell the sign."""
    return n.among("sensor rectification")


SHARED = {
    "emps": (friction, "Coulomb friction (and an offset)"),
    "silverbox": (spring, "a cubic spring"),
    "tclab": (second_mass, "a second time constant, of the heater or the sensor"),
}


def cases(shared: Path, sources: Path | None) -> dict[str, Case]:
    """All cases by name; no data are read yet."""
    found = {}
    for name in PACKAGED:
        module = importlib.import_module(f"bench.gap.real.{name}")
        records = partial(module.records, sources) if name == "house" else module.records
        found[name] = Case(HERE / f"{name}.py", records, module.LACKS, module.right)
    for name, (right, lacks) in SHARED.items():
        folder = shared / "cases" / name
        found[name] = Case(folder / "model.py", partial(csv_file, folder), lacks, right)
    data = shared / "data"
    found["multisine"] = Case(
        HERE / "silverbox.py", partial(multisine, data), "a cubic spring", spring
    )
    for record in (1, 2):
        found[f"drives{record}"] = Case(
            HERE / "coupled_drives.py", partial(drives, data, record), "the sensor gives |speed|",
            unsigned,
        )  # fmt: skip
    return found


def csv_file(folder: Path) -> pd.DataFrame:
    return pd.read_csv(there(folder / "data.csv"))


# -- one case
def line(name: str, case: Case, rows: int, report: GapReport) -> dict[str, Any]:
    """What the table says of a report; the errors are None where none were measured."""
    ahead = words.windows(report) or {}
    errors = {k: ahead.get(f"rmse_{k}") for k in ("before", "after")}
    return {
        "case": name, "rows": rows, "known": case.lacks, "headline": words.headline(report),
        **errors, "horizon": ahead.get("horizon"), "grade": grade(report, case.right),
        "seconds": round(report.seconds), "named": [vars(n) for n in named(report)],
        "left_out": report.left_out.to_dict("records"),
    }  # fmt: skip


def table(lines: list[dict[str, Any]]) -> str:
    """The lines as a table in Markdown."""
    rows = [COLUMNS, ("---",) * len(COLUMNS)]
    rows += [tuple(cell(found.get(c)) for c in COLUMNS) for found in lines]
    return "\n".join(f"| {' | '.join(r)} |" for r in rows)


def cell(value: Any) -> str:
    if value is None or value != value:
        return "-"
    return f"{value:.3g}" if isinstance(value, float) else str(value).replace("|", "\\|")


def run_free(model: ssm.Model, values: Mapping[str, float], data: pd.DataFrame) -> np.ndarray:
    """y without noise from the first row on, started at the measured position, at rest."""
    quiet = {**values, "q": 1e-12, "r": 1e-12}
    inputs = {n: data[n].to_numpy() for n in data.columns if n != "y"}
    drawn = ssm.simulate(model, quiet, steps=len(data), inputs=inputs, seed=1)
    return np.asarray(drawn["y"].values[0])


def fitted(report: GapReport, when: str) -> dict[str, float]:
    """Values of the parameters before or after the effect was added."""
    return {n: v for n, (v, _) in report.estimates[when].items()}


def checked(model: ssm.Model, report: GapReport, data: pd.DataFrame) -> None:
    """The free run over the part of growing amplitude, before and after."""
    part = data.iloc[GROWING].reset_index(drop=True)
    models: list[tuple[str, Any, str]] = [("linear", model, "before")]
    if report.model is not None:
        models.append(("with " + " and ".join(report.chosen), report.model, "after"))
    y = part["y"].to_numpy()
    print(f"\nPart of growing amplitude, {len(y):,} rows, rms of y {1e3 * np.std(y):.1f} mV:")
    for name, m, when in models:
        error = y - run_free(m, fitted(report, when), part)
        tenths = [np.sqrt(np.mean(e**2)) for e in np.array_split(error[200:], 10)]
        print(f"  {name}: free run off by {1e3 * np.sqrt(np.mean(error[200:] ** 2)):.2f} mV rms; "
              f"by tenths of the rows {', '.join(f'{1e3 * e:.2f}' for e in tenths)}")  # fmt: skip


def windows_ahead(model: ssm.Model, values: Mapping[str, float], data: pd.DataFrame) -> float:
    """Root mean square error of y over `WINDOW` rows, simulated from the filtered states of rows
    spread over the data."""
    problem = pose(model, data)
    names = [repr(s) for s in problem.trace.parameter_symbols]
    fixed = {n: np.asarray(values[n]) for n in names}
    settings = Settings(PARTICLES, proposal_of(problem.program))
    fitter = Fitter(problem, fixed, settings)
    theta = np.array([float(values[n]) for n in names])
    everything = [np.ones(e.steps, dtype=bool) for e in problem.experiments]
    found = look_ahead(
        fitter, SimpleNamespace(theta=theta), problem.experiments, everything, WINDOW,
        np.random.SeedSequence(1),
    )  # fmt: skip
    return found.window(WINDOW).rmse


def validated(model: ssm.Model, report: GapReport, folder: Path) -> None:
    """Half-second windows of the servo's other record, by each set of parameters."""
    data = pd.read_csv(folder / "validation.csv")
    print(f"\nThe other record, {len(data):,} rows, windows of {WINDOW} rows:")
    for when in report.estimates:
        own = model if when == "before" else report.model
        if own is not None:
            error = 1e3 * windows_ahead(own, fitted(report, when), data)
            print(f"  {when}: off by {error:.2f} mm rms")


def diagnosed(name: str, case: Case, options: argparse.Namespace) -> dict[str, Any]:
    """The line of one case; its report is printed and saved."""
    data = case.records()
    model = load_model(str(case.model))
    try:
        report = ssm.diagnose(model, data, mode=options.mode, seed=1)
        print(report)
        report.save(options.out / name)
    except Exception:  # any: an error is a wrong answer, and the table says so
        traceback.print_exc()
        return {"case": name, "rows": len(data), "known": case.lacks, "headline": "an error",
                "grade": "error"}  # fmt: skip
    if name == "emps" and options.mode == "full":
        validated(model, report, options.shared / "cases" / "emps")
    if name == "multisine" and options.mode == "full":
        checked(model, report, silverbox(options.shared / "data"))
    return line(name, case, len(data), report)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", nargs="*")
    default = Path(os.environ.get("SSMPPL_SHARED", "../shared"))
    parser.add_argument("--shared", type=Path, default=default)
    parser.add_argument("--sources", type=Path, help="folder of source archives of packages")
    parser.add_argument("--out", type=Path, default=Path("build/real"))
    parser.add_argument("--mode", choices=["fast", "full"], default="full")
    parser.add_argument("--table", action="store_true", help="only print what is done")
    options = parser.parse_args()
    known = cases(options.shared, options.sources)
    for name in options.cases:
        if name not in known:
            parser.error(f"no case {name!r}: they are {', '.join(known)}")
    wanted = options.cases or list(known)
    lines = []
    for name in wanted:
        kept = options.out / f"{name}.json"
        if not options.table:
            try:
                found = diagnosed(name, known[name], options)
            except Absent as absent:
                print(f"{name} skipped: {absent}")
                continue
            kept.parent.mkdir(parents=True, exist_ok=True)
            kept.write_text(json.dumps(found, indent=1, default=str))
            lines.append(found)
        elif kept.exists():
            lines.append(json.loads(kept.read_text()))
    if lines:
        print("\n" + table(lines))


if __name__ == "__main__":
    main()
