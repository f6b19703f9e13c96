"""The diagnosis on measured data: the Silverbox and the coupled drives.

    python -m bench.gap.real.run [silverbox] [drives] [--data ../shared/data] [--out build/real]
        [--mode fast]

The data are not part of the project: where they are absent, this says so and ends. Each case gets
a linear model and no hint. Of the Silverbox 1,000 rows of the multisine part are diagnosed; the
model that comes back is then compared with the linear one on the part of growing amplitude, by the
error of a simulation that never looks at the answers there. Reports go to OUT.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.io import loadmat

import ssmppl as ssm
from ssmppl.diagnosis.report.report import GapReport
from ssmppl.modelfile import load_model

HERE = Path(__file__).parent
MULTISINE, GROWING = slice(45_000, 46_000), slice(100, 40_575)  # rows of the Silverbox
SAMPLED = 610.35  # Hz


def silverbox(folder: Path) -> pd.DataFrame:
    """All rows: y, u, and the sum of the u beside it."""
    raw = pd.read_csv(folder / "silverbox" / "SNLS80mV.csv", usecols=["V1", "V2"]).dropna()
    u = raw["V1"].to_numpy()
    beside = np.convolve(u, [1.0, 0.0, 1.0], mode="same")
    return pd.DataFrame({"y": raw["V2"].to_numpy(), "u": u, "beside": beside})


def drives(folder: Path, record: int) -> pd.DataFrame:
    """Record 1, 2 or 3."""
    raw = loadmat(folder / "coupled_drives" / "drive.mat")
    return pd.DataFrame({"y": raw[f"z{record}"].ravel(), "u": raw[f"u{record}"].ravel()})


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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", nargs="*", default=["silverbox", "drives"])
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--out", type=Path, default=Path("build/real"))
    parser.add_argument("--mode", choices=["fast", "full"], default="full")
    options = parser.parse_args()
    if not options.data.exists():
        print(f"skipped: the measured data are not at {options.data}; say --data PATH")
        return
    if "silverbox" in options.cases:
        model, data = load_model(str(HERE / "silverbox.py")), silverbox(options.data)
        report = ssm.diagnose(model, data.iloc[MULTISINE].reset_index(drop=True), mode=options.mode)
        print(report)
        report.save(options.out / "silverbox")
        print(f"{report.seconds:.0f} s")
        if options.mode == "full":
            checked(model, report, data)
    if "drives" in options.cases:
        model = load_model(str(HERE / "coupled_drives.py"))
        for record in (1, 2):
            report = ssm.diagnose(model, drives(options.data, record), mode=options.mode)
            print(report)
            report.save(options.out / f"coupled_drives_{record}")


if __name__ == "__main__":
    main()
