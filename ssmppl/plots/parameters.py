"""`plot_prior_posterior`: prior and posterior densities; `plot_maximization`: iterates of
`maximize`."""

from __future__ import annotations

from typing import Any

import numpy as np

from ssmppl.data.per_experiment import trace_of_results
from ssmppl.drawing.numerals import with_error
from ssmppl.drawing.style import MAIN, OTHER, bare
from ssmppl.errors import ArgumentError
from ssmppl.inference.maximum.estimate import Estimate, beside
from ssmppl.inference.verbs.predict import group
from ssmppl.language.model.model import Model
from ssmppl.plots.density import Prior, estimated, prior_draws, priors_of, window
from ssmppl.plots.drawing import few, handed, key, multiples, only_below, styled
from ssmppl.plots.reading import components, group_of, is_inference_data, pick, wrong_kind

__all__ = ["parameter_draws", "plot_maximization", "plot_prior_posterior"]

OBJECTIVES = {
    "likelihood": "log-likelihood", "posterior": "log-likelihood\n+ log prior",
}  # fmt: skip


def parameter_draws(idata: Any, verb: str) -> dict[str, np.ndarray]:
    """(chain, draw) of each component of the parameters.

    Raises
    ------
    ArgumentError : there is no posterior, or no parameter in it.
    """
    posterior = group_of(verb, idata, "posterior", "give what ssm.sample returns")
    found: dict[str, np.ndarray] = {}
    for name, variable in posterior.data_vars.items():
        if "time" not in variable.dims:
            values = variable.transpose("chain", "draw", ...).values
            found |= components(str(name), np.asarray(values, dtype=float), 2, variable)
    if not found:
        raise ArgumentError(
            "the posterior holds no parameters: all of them are fixed, or the model has none",
            fix="sample with a parameter left free",
        )
    return found


@styled
def plot_prior_posterior(
    idata: Any, prior: Any = None, *, var_names: Any = None, ax: Any = None
) -> Any:
    """The density of each parameter before and after the data: prior dashed, posterior filled.

    Thin lines are single chains; where they differ from the whole, the chains have not converged. A
    posterior like its prior has learned nothing from the data. The prior is drawn over the range of
    the posterior, so that a vague one is a low line.

    Parameters
    ----------
    idata : what `sample` returns.
    prior : the model, whose priors are drawn exactly where they depend on no other parameter, and
        else from draws; or InferenceData with a group `prior`, as of ``ssm.predict(model)``; None:
        the group `prior` of `idata`.
    var_names : names of the parameters that are drawn, or of components; None: all.
    ax : Matplotlib axes, as many as there are parameters; None: a new figure.

    Returns
    -------
    Axes
        Of several panels an array of them, as of `plt.subplots`.

    Raises
    ------
    ArgumentError : there is no posterior, no prior, or no such parameter; `ax` are not as many.
    """
    draws = parameter_draws(idata, "plot_prior_posterior")
    before = _priors(idata, prior)
    names = _moving(draws, pick(draws, var_names, "the parameters of the posterior"), var_names)
    names = few(names, "plot_prior_posterior")
    missing = [n for n in names if n not in before]
    if missing:
        raise ArgumentError(
            f"the posterior has {missing[0]!r}, and the prior has not",
            fix="give the model that was sampled, or choose parameters by var_names=",
        )
    axes = multiples("plot_prior_posterior", len(names), ax, share=False, height=1.9)
    for name, one in zip(names, axes, strict=True):
        _densities(one, before[name], draws[name])
        one.set_xlabel(name)
    key(axes, ax)
    return handed(axes)


def _moving(values: dict[str, np.ndarray], names: list[str], var_names: Any) -> list[str]:
    """The names without the entries of matrices that were not asked for one by one and say nothing
    of their own: the other half of a symmetric one, and the diagonal of correlations."""
    asked = {var_names} if isinstance(var_names, str) else set(var_names or ())
    kept: list[str] = []
    for name in names:
        own, stem = values[name], name.split("[")[0]
        beside = [values[k] for k in kept if k.split("[")[0] == stem]
        entry = "," in name.partition("[")[2]
        still = bool(np.all(own == 1.0))
        copied = any(np.array_equal(own, v) for v in beside)
        if name in asked or not entry or not (still or copied):
            kept.append(name)
    return kept or names


def _priors(idata: Any, prior: Any) -> dict[str, Prior]:
    if isinstance(prior, Model):
        posterior = group(idata, "posterior") if is_inference_data(idata) else None
        return priors_of(trace_of_results(prior, posterior))
    found = None
    source = idata if prior is None else prior
    if is_inference_data(source):
        found = group(source, "prior")
    if found is None:
        what = "idata has no group `prior`" if prior is None else "prior= is neither a Model nor " \
            "InferenceData with a group `prior`"  # fmt: skip
        raise ArgumentError(
            what, fix="give the model, ssm.plot_prior_posterior(idata, model), or what "
            "ssm.predict(model, steps=...) returns"
        )  # fmt: skip
    return prior_draws(found)


def _densities(ax: Any, prior: Prior, draws: np.ndarray) -> None:
    """draws : (chain, draw)."""
    ends = prior.lower, prior.upper
    x = window(draws.ravel(), *ends)
    whole = estimated(draws.ravel(), x, *ends)
    ax.fill_between(x, whole, color=MAIN, alpha=0.18, linewidth=0)
    ax.plot(x, whole, color=MAIN, linewidth=1.6, label="posterior")
    top = whole.max()
    if len(draws) > 1:
        for k, chain in enumerate(draws):
            own = estimated(chain, x, *ends)
            top = max(top, own.max())
            ax.plot(x, own, color=MAIN, linewidth=0.6, alpha=0.7,
                    label="single chains" if k == 0 else None)  # fmt: skip
    if prior.known:
        density = prior.density(x)
        ax.plot(x, density, "--", color=OTHER, linewidth=1.3, label="prior")
        finite = density[np.isfinite(density)]
        # A prior that is unbounded at an end of its support may not squeeze the posterior.
        top = max(top, min(finite.max(initial=0.0), 3.0 * top))
    else:
        ax.set_title("prior improper")
    ax.set_ylim(0.0, 1.06 * top or 1.0)
    ax.set_xlim(x[0], x[-1])
    ax.locator_params(axis="x", nbins=5)
    ax.set_yticks([])
    bare(ax, ["bottom"])


@styled
def plot_maximization(estimate: Any, *, var_names: Any = None, ax: Any = None) -> Any:
    """Each parameter over the iterations of `maximize`, and the estimate.

    The dashed line is the estimate, the band one standard error on both sides; there is no band
    where the information at the estimate was not positive definite. Below, where the method knows
    it, what was maximised: the log-likelihood of the exact methods; of `IF2` the one that its
    perturbed particles had, which is no log-likelihood of theirs. Of several starts, one line
    each.

    Parameters
    ----------
    estimate : what `maximize` returns.
    var_names : names of the parameters that are drawn, or of components; None: all that are free.
    ax : Matplotlib axes, as many as there are panels: one more than parameters where the method
        knows the log-likelihood; None: a new figure.

    Returns
    -------
    Axes
        Of several panels an array of them, as of `plt.subplots`.

    Raises
    ------
    ArgumentError : it is no estimate, or holds no such parameter; `ax` are not as many.
    """
    if not isinstance(estimate, Estimate):
        raise wrong_kind("plot_maximization", estimate, "give what ssm.maximize returns")
    paths, figures = iterates_of(estimate)
    names = _moving(paths, pick(paths, var_names, "the parameters that were estimated"), var_names)
    names = few(names, "plot_maximization")
    if not names:
        raise ArgumentError(
            "nothing was maximised: every parameter is fixed, or the model has none",
            fix="maximise with a parameter left free",
        )
    table = estimate.table()
    axes = multiples("plot_maximization", len(names) + len(figures), ax, height=1.5)
    for name, one in zip(names, axes, strict=False):
        value, error = (float(table.loc[name, c]) for c in ("estimate", "standard_error"))
        _path(one, paths[name])
        one.axhline(value, color=OTHER, linewidth=1.0, linestyle="--")
        if np.isfinite(error) and error > 0.0:
            one.axhspan(value - error, value + error, color=OTHER, alpha=0.15, linewidth=0)
        one.set_title(f"estimate {with_error(value, error)}")
        one.set_ylabel(name)
    for (label, values), one in zip(figures.items(), axes[len(names) :], strict=True):
        _path(one, values)
        one.set_ylabel(label)
        if not label.startswith("perturbed") and np.isfinite(values).any():
            _upper_part(one, values)
    only_below(axes)
    key(axes, ax)
    return handed(axes)


def iterates_of(estimate: Estimate) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """(start, iteration) of each free component, and of what was maximised, by its name."""
    held = [n for n in estimate.parameters if n not in estimate.standard_errors]
    paths: dict[str, np.ndarray] = {}
    for name, variable in estimate.iterates.data_vars.items():
        if str(name) in estimate.parameters and str(name) not in held:
            values, shape = variable.values, np.shape(estimate.parameters[str(name)])
            one = values.ndim == 1 + len(shape)  # of a single start
            paths |= components(str(name), values[None] if one else values, 2, variable)
    figures: dict[str, np.ndarray] = {}
    objective = str(estimate.attrs.get("objective", "likelihood"))
    for name, label in (("objective", OBJECTIVES.get(objective, objective)),
                        ("perturbed_log_likelihood", "perturbed\nlog-likelihood")):  # fmt: skip
        if (own := beside(estimate.parameters, name)) in estimate.iterates:
            values = estimate.iterates[own].values
            figures[label] = values if values.ndim == 2 else values[None]
    return paths, figures


def _path(ax: Any, values: np.ndarray) -> None:
    """values : (start, iteration)."""
    strength = max(1.0 / len(values) ** 0.5, 0.15)
    marker = "." if values.shape[1] <= 40 else None
    for row in values:
        ax.plot(np.arange(len(row)), row, color=MAIN, linewidth=1.1, alpha=strength, marker=marker,
                markersize=4)  # fmt: skip
    ax.set_xlabel("iteration")
    ax.margins(x=0.01)
    bare(ax)


def _upper_part(ax: Any, values: np.ndarray) -> None:
    """Leave out of sight what lies far below the top, so that the last steps can be told apart."""
    ax.ticklabel_format(axis="y", useOffset=False)
    known = values[np.isfinite(values)]
    late = values[:, values.shape[1] // 4 :]
    late = late[np.isfinite(late)]
    if not len(late):
        return
    top = known.max()
    room = max(4.0 * (top - np.median(late)), 5.0)
    if top - known.min() > 3.0 * room:
        ax.set_ylim(top - room, top + 0.08 * room)
