"""What comes after the first call: results plotted, saved and gone on with; the long verbs; the
command line. All of it on what random models and data have left behind."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import arviz as az
import click.testing
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

import ssmppl as ssm
from ssmppl.cli import main
from tests.fuzz.calls import FEW, WEIGHTS, Case, Wrong

LATER = WEIGHTS | {
    "results": 4, "plot_filtered": 3, "plot_smoothed": 2, "plot_likelihood": 1, "plot_maximum": 1,
    "leave_future_out": 1, "evidence": 1, "diagnose": 0.5, "command_line": 5,
}  # fmt: skip


@dataclass
class LaterCase(Case):
    """A case of all verbs. file : the model's."""

    file: Path = Path()

    def method(self) -> Any:
        return (None, ssm.PMMH(particles=10), ssm.PGAS(particles=5))[self.rng.integers(3)]

    def results(self) -> None:
        """The posterior summed up, drawn, saved, read again, and gone on with."""
        data = self.data()
        idata = ssm.sample(self.model, data, self.method(), seed=1, **FEW)
        calls = (
            lambda: ssm.summary(idata),
            lambda: self.drawn(ssm.plot_states, idata),
            lambda: self.drawn(ssm.plot_prior_posterior, idata, prior=self.model),
            lambda: self.drawn(ssm.plot_predictions, ssm.predict(self.model, idata, data, seed=1)),
            lambda: self.forecast(idata),
            lambda: self.saved(idata),
        )
        for k in self.rng.permutation(len(calls))[:3]:
            calls[k]()

    def forecast(self, idata: Any) -> None:
        steps = int(self.rng.choice([1, 4]))
        inputs = {
            n: self.rng.normal(size=(steps, length) if length > 1 else steps)
            for n, length in self.recipe.inputs.items()
        }
        given = {"steps": steps} if not inputs or self.rng.random() < self.odd else {}
        if "experiment" in idata["posterior"].dims or self.rng.random() < self.odd:  # of several
            given["experiment"] = 1
        found = ssm.forecast(self.model, idata, inputs=inputs or None, seed=1, **given)
        self.drawn(ssm.plot_forecast, found, idata)

    def saved(self, idata: Any) -> None:
        with tempfile.TemporaryDirectory() as folder:
            idata.to_netcdf(f"{folder}/found.nc")
            again = az.from_netcdf(f"{folder}/found.nc")
            one, two = (ssm.summary(i) for i in (idata, again))
            again.close()
        if not one.equals(two):
            raise Wrong(f"the summary changed in a file:\n{one}\n{two}")

    def plot_filtered(self) -> None:
        found = ssm.particle_filter(self.model, self.data(), self.parameters(), **self.settings())
        self.drawn(ssm.plot_filter, found)
        self.drawn(ssm.plot_predictions, found)

    def plot_smoothed(self) -> None:
        found = ssm.smooth(self.model, self.data(), self.parameters(), particles=10, trajectories=5)
        self.drawn(ssm.plot_states, found)

    def plot_likelihood(self) -> None:
        self.drawn(
            ssm.plot_likelihood, self.model, self.data(), parameters=self.parameters(), points=3,
            particles=10, repeats=2,
        )  # fmt: skip

    def plot_maximum(self) -> None:
        found = ssm.maximize(
            self.model, self.data(), ssm.IF2(particles=10, iterations=2), start=self.parameters(),
            seed=1, progress=False,
        )  # fmt: skip
        if not all(np.isfinite(v).all() for v in found.parameters.values()):
            raise Wrong(str(found))
        found._repr_html_()
        self.drawn(ssm.plot_maximization, found)

    def drawn(self, plot: Any, *what: Any, **given: Any) -> None:
        """A plot, put on paper."""
        try:
            plot(*what, **given)
            plt.gcf().canvas.draw()
        finally:
            plt.close("all")

    def leave_future_out(self) -> None:
        ssm.leave_future_out(
            self.model, self.data(), method=self.method(), particles=10, seed=1, **FEW
        )

    def evidence(self) -> None:
        found = ssm.evidence(self.model, self.data(), seed=1, **{**FEW, "draws": 20})
        if np.isnan(found.log_evidence):
            raise Wrong(str(found))

    def diagnose(self) -> None:
        ssm.diagnose(
            self.model, self.data(), mode="fast", particles=20, progress=False,
            fixed=self.parameters() if self.rng.random() < 0.7 else None,
        )  # fmt: skip

    def command_line(self) -> None:
        """Exit code 0 with an answer, or 1 or 2 with a message; nothing else."""
        data = self.data()
        columns = data if isinstance(data, (dict, pd.DataFrame)) else {}
        with tempfile.TemporaryDirectory() as folder:
            table = Path(folder) / "data.csv"
            self.write(columns, table)
            verb = str(self.rng.choice(["explain", "log-likelihood", "particle-filter", "sample"]))
            words = [verb, str(self.file), str(table)]
            at = self.parameters()
            if verb in ("log-likelihood", "particle-filter"):
                words += ["--particles", "10"]
                if isinstance(at, dict) and at:
                    words += ["-p", *(f"{n}={v}" for n, v in at.items())]
            if verb == "sample":
                words += ["--draws", "3", "--warmup", "3", "--chains", "1"]
            if verb in ("sample", "particle-filter"):
                words += ["-o", f"{folder}/found.nc"]
            if self.rng.random() < 0.3:
                words += ["--json"]
            found = click.testing.CliRunner().invoke(main, words)
        if found.exception is not None and not isinstance(found.exception, SystemExit):
            raise found.exception
        if found.exit_code not in (0, 1, 2) or "Traceback" in found.output:
            raise Wrong(f"{' '.join(words)}: exit code {found.exit_code}\n{found.output}")
        if found.exit_code and not found.output.strip():
            raise Wrong(f"{' '.join(words)}: exit code {found.exit_code} without a word")

    def write(self, columns: Any, table: Path) -> None:
        """The columns that fit into a CSV file, as pandas writes them."""
        flat: dict[str, Any] = {}
        for name, values in dict(columns).items():
            try:
                array = np.asarray(values)
            except ValueError:  # rows of unlike lengths
                continue
            if array.ndim == 1:
                flat[str(name)] = pd.Series(array)
            elif array.ndim == 2:
                flat |= {f"{name}_{k}": pd.Series(c) for k, c in enumerate(array.T)}
        pd.DataFrame(flat).to_csv(table, index=False)
