"""Estimate: what `maximize` returns, on the natural scale of the parameters."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from ssmppl import markup
from ssmppl.data import unpack_parameters
from ssmppl.expressions.arrays import array
from ssmppl.expressions.evaluate import evaluate
from ssmppl.inference.preparation.space import free_components
from ssmppl.language.model.component_names import ComponentNames
from ssmppl.language.model.trace import Trace
from ssmppl.results import to_dataset

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

__all__ = ["NO_METHOD", "Estimate", "by_name", "make_estimate", "table"]

NO_METHOD = "none"  # where every parameter is fixed


# What the results of statsmodels' state space models have under these names.
_SMOOTHED = "ssm.smooth(model, data, estimate), which has means and standard deviations"
_FILTERED = "ssm.kalman_filter(model, data, estimate)"
_RESIDUALS = (
    f"{_FILTERED}, of which `y_predicted`, `y_predicted_sd` and `y_pit` give and test one-step "
    "errors, and ssm.plot_predictions"
)
_AHEAD = "ssm.forecast(model, estimate, data=data, steps=12)"
_LONGER = f"the verb with the longer data, as {_FILTERED}"
_TABLE = "print(estimate), or estimate.table()"
ELSEWHERE: dict[str, str] = {
    **dict.fromkeys(("params", "coef"), "estimate.parameters, by name"),
    **dict.fromkeys(("llf", "loglike", "loglik"), "estimate.log_likelihood"),
    **dict.fromkeys(("bse", "se", "stderr"), "estimate.standard_errors"),
    **dict.fromkeys(("cov_params", "vcov"), "estimate.covariance"),
    **dict.fromkeys(("summary", "params_table"), _TABLE),
    **dict.fromkeys(
        ("tvalues", "zvalues", "pvalues", "conf_int"),
        "estimate.table(), whose estimates and standard errors make them",
    ),
    **dict.fromkeys(("get_forecast", "forecast", "predict", "get_prediction"), _AHEAD),
    **dict.fromkeys(("append", "extend", "apply"), _LONGER),
    **dict.fromkeys(("smoothed_state", "smoother_results", "states", "level"), _SMOOTHED),
    **dict.fromkeys(("filtered_state", "filter_results", "fittedvalues"), _FILTERED),
    **dict.fromkeys(
        ("resid", "standardized_forecasts_error", "plot_diagnostics", "test_normality",
         "test_serial_correlation", "test_heteroskedasticity"), _RESIDUALS,
    ),
    "simulate": "ssm.simulate(model, estimate, steps=100)",
    "plot_components": "ssm.plot_components(model, ssm.smooth(model, data, estimate))",
}  # fmt: skip


@dataclass(frozen=True)
class Estimate:
    """Parameters that maximise the likelihood (or the posterior density), with their uncertainty.

    Parameters
    ----------
    parameters : value of every parameter by name, the fixed ones too: a number, or an array of the
        prior's shape.
    covariance : of the free components, labelled as `phi`, `A[0, 1]` (or by the names that the
        model gives them): the inverse of the observed
        information. NaN where the information is not positive definite; `attrs["covariance"]` then
        says so. NaN too for a component whose maximum is at an edge of its support
        (`attrs["held_at_edge"]`, exact models only): the others' is that with it held there.
    standard_errors : roots of its diagonal, by name, as `parameters`; without the fixed ones.
    log_likelihood : at the estimate; with particles an estimate, whose standard error is
        `attrs["log_likelihood_error"]`.
    iterates : Dataset with dim `iteration`, the way to the estimate; of `IF2` with dim `start` too,
        and with `perturbed_log_likelihood`, what the particle filter made of each pass. Of
        exact methods with `objective`, the log-likelihood, with the log prior density where the
        posterior was maximised. Where a parameter has such a name, an underscore follows theirs.
    attrs : method, why it was taken, `converged`, `interrupted`, seed, seconds; where random
        numbers were used, `monte_carlo_errors`: the estimate's own standard errors by component.
    names : of the components.
    """

    parameters: dict[str, float | np.ndarray]
    covariance: pd.DataFrame
    standard_errors: dict[str, float | np.ndarray]
    log_likelihood: float
    iterates: xr.Dataset
    attrs: dict[str, Any] = field(default_factory=dict)
    names: ComponentNames = field(default_factory=ComponentNames)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_") or name not in ELSEWHERE:
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        raise AttributeError(f"an estimate has no {name!r}: write {ELSEWHERE[name]}")

    @property
    def free_numbers(self) -> int:
        """How many numbers were estimated: free components, and starts that have no prior."""
        return len(self.covariance) + int(self.attrs.get("flat_starts", 0))

    @property
    def aic(self) -> float:
        """Akaike's criterion, 2 k - 2 log p(y), k `free_numbers`; NaN of a posterior mode.

        Likelihoods under flat starts are densities with respect to them: only models with the same
        ones compare.
        """
        return 2.0 * self.free_numbers - 2.0 * self._likelihood

    @property
    def bic(self) -> float:
        """Schwarz's criterion, k log n - 2 log p(y), n the rows in which anything was measured;
        as of `aic`."""
        rows = float(self.attrs.get("measured_rows", np.nan))
        return self.free_numbers * np.log(rows) - 2.0 * self._likelihood

    @property
    def _likelihood(self) -> float:
        """The log-likelihood, where that is what was maximised."""
        return self.log_likelihood if self.attrs.get("objective") == "likelihood" else np.nan

    def __repr__(self) -> str:
        lines, rows = [*self._head(), ""], self._rows()
        widths = [max(len(r[i]) for r in rows) for i in range(len(rows[0]))]
        for row in rows:
            cells = [c.rjust(w) for c, w in zip(row[1:], widths[1:], strict=True)]
            lines.append("  ".join([row[0].ljust(widths[0]), *cells]).rstrip())
        return "\n".join(lines + [f"\nNote: {note}" for note in self.notes])

    def _repr_html_(self) -> str:
        title, likelihood = self._head()
        head, *rows = self._rows()
        cells = [(markup.code(row[0]), *map(markup.text, row[1:])) for row in rows]
        notes = "".join(markup.paragraph(f"Note: {note}") for note in self.notes)
        parts = markup.heading(title), markup.paragraph(likelihood), markup.table(cells, head)
        return "".join(parts) + notes

    def _head(self) -> tuple[str, str]:
        """What was maximised and how, and the log-likelihood."""
        name, method = self.attrs.get("model", ""), self.attrs.get("method", "")
        title = f"{name}: maximum {self.attrs.get('objective', '')} by {method}"
        if method == NO_METHOD:
            title = f"{name}: likelihood of the given parameters"
        error = self.attrs.get("log_likelihood_error")
        spread = f" (Monte Carlo error {error:.2g})" if error else ""
        return title, f"log-likelihood {self.log_likelihood:.6f}{spread}"

    def _rows(self) -> list[tuple[str, ...]]:
        """The table as text, its head first."""
        shown = self.table()
        rows = [("", *(str(c).replace("_", " ") for c in shown.columns))]
        for label, cells in shown.iterrows():
            value, *errors = map(float, cells)
            known = [f"{e:.3g}" if e else "" for e in errors]
            if errors[0] == 0.0:
                known[0] = "fixed"
            rows.append((str(label), f"{value:.6g}", *known))
        return rows

    def table(self) -> pd.DataFrame:
        """One row for each component: estimate, standard error, Monte Carlo error if there is one.

        The standard error of a fixed parameter is zero.

        Returns
        -------
        DataFrame : indexed as `covariance`, with the fixed components.
        """
        import pandas as pd

        noise: dict[str, float] = self.attrs.get("monte_carlo_errors") or {}
        rows: dict[str, dict[str, float]] = {}
        for name, value in self.parameters.items():
            errors = self.standard_errors.get(name)
            for index in np.ndindex(np.shape(value)):
                label = self.names.label(name, index)
                row = {"estimate": float(np.asarray(value)[index])}
                row["standard_error"] = 0.0 if errors is None else float(np.asarray(errors)[index])
                if noise:
                    lower = self.names.label(name, sorted(index, reverse=True))
                    row["monte_carlo_error"] = noise.get(label, noise.get(lower, 0.0))
                rows[label] = row
        return pd.DataFrame.from_dict(rows, orient="index")

    @property
    def notes(self) -> list[str]:
        """What has to be known before the figures are used."""
        out = []
        if self.attrs.get("approximate"):
            out.append(f"the likelihood is {self.attrs.get('likelihood', 'an approximation')}")
        if "approximate_distributions" in self.attrs:
            out.append(str(self.attrs["approximate_distributions"]))
        if idle := self.attrs.get("only_in_priors"):
            out.append(
                f"{', '.join(idle)}: held where the search began, as only priors depend on "
                f"{'it' if len(idle) == 1 else 'them'} and the likelihood does not; ssm.sample "
                "estimates such parameters, and so does ssm.maximize where what they are of is a "
                "state, with that distribution in @initial and Dirac of itself in @transition"
            )
        if self.attrs.get("interrupted"):
            out.append("interrupted; this is the best point so far")
        elif self.attrs.get("converged") is False:
            reason = self.attrs.get("stopped", "")
            out.append("not converged" + (f": {reason}" if reason else ""))
        out += [
            f"{label} is within a standard error of {edge:g}, the boundary of its parameter space: "
            "no interval about it follows from that standard error"
            for label, edge in self.attrs.get("at_edge", {}).items()
        ]
        out += [
            f"the maximum in {label} is at {edge:g}, the boundary of its parameter space, and has "
            "no standard error; those of the others are conditional on it"
            for label, edge in self.attrs.get("held_at_edge", {}).items()
        ]
        how, _, reason = str(self.attrs.get("covariance", "")).partition(": ")
        return [*out, f"no standard errors: {reason}"] if how == "none" else out


def by_name(trace: Trace, values: np.ndarray) -> dict[str, float | np.ndarray]:
    """Values (P,) of the components by name, numbers for scalar parameters."""
    named = unpack_parameters(trace, values)
    return {n: float(v) if v.ndim == 0 else v for n, v in named.items()}


def table(labels: list[str], matrix: np.ndarray) -> pd.DataFrame:
    """A square matrix with these labels on both sides."""
    import pandas as pd

    return pd.DataFrame(matrix, index=labels, columns=labels)


def _edges(trace: Trace, theta: np.ndarray, errors: np.ndarray) -> dict[str, float]:
    """The components within a standard error of an end of their supports, and that end."""
    env = dict(zip(trace.parameter_symbols, theta, strict=True))
    spread = dict(zip(trace.parameter_symbols, errors, strict=True))
    found: dict[str, float] = {}
    for site in trace.parameters.values():
        support = site.distribution.support()
        if support.kind != "interval":
            continue
        ends = (np.broadcast_to(e.view(np.ndarray), site.shape).ravel()
                for e in (array(support.lower), array(support.upper)))  # fmt: skip
        for s, *own in zip(site.value.ravel(), *ends, strict=True):
            for edge in evaluate(own, env):
                if abs(env[s] - float(edge)) < spread[s]:
                    found[trace.label(s)] = float(edge)
    return found


def beside(parameters: Collection[str], name: str) -> str:
    """What iterates call a dimension or a figure, where a parameter may have the name."""
    return f"{name}_" if name in parameters else name


def make_estimate(
    trace: Trace, theta: np.ndarray, covariance: np.ndarray, log_likelihood: float,
    iterates: np.ndarray, fixed: dict[str, np.ndarray], attrs: dict[str, Any],
    figures: Mapping[str, np.ndarray] | None = None,
) -> Estimate:  # fmt: skip
    """An Estimate from arrays over all P components: theta (P,), covariance (P, P), iterates
    (K, P), or (starts, K, P); figures, (K,) or (starts, K), go with the iterates.

    Rows and columns of fixed parameters are left out of the covariance.
    """
    dims = [beside(trace.parameters, n) for n in ("start", "iteration")[3 - iterates.ndim :]]
    free = free_components(trace, fixed)
    labels = [trace.label(s) for s, f in zip(trace.parameter_symbols, free, strict=True) if f]
    errors = np.full(len(theta), np.nan)
    with np.errstate(invalid="ignore"):
        errors[free] = np.sqrt(np.diagonal(covariance)[free])
    edges = _edges(trace, theta, errors)
    attrs = {**attrs, "at_edge": edges} if edges else attrs
    variables = unpack_parameters(trace, iterates) if len(theta) else {}
    variables |= {beside(trace.parameters, n): v for n, v in (figures or {}).items()}
    return Estimate(
        parameters=by_name(trace, theta),
        covariance=table(labels, covariance[np.ix_(free, free)]),
        standard_errors={n: v for n, v in by_name(trace, errors).items() if n not in fixed},
        log_likelihood=log_likelihood,
        iterates=to_dataset(
            variables,
            sample_dim=tuple(dims),
            over_time=(),
            coords={
                **trace.component_names.coords,
                **{d: np.arange(n) for d, n in zip(dims, iterates.shape, strict=False)},
            },
            renamed=trace.component_names.renamed,
            attrs={k: v for k, v in attrs.items() if v is not None},
        ),
        attrs=attrs,
        names=trace.component_names,
    )
