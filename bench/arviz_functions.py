"""What every function of ArviZ does with the results of every method of `sample`.

A local level model with 30 rows, one of them missing. A function is *right* where its numbers are
those of a computation by hand, or its figure shows what it is given; *refused* where ArviZ says
that something is not there; *wrong* where its answer is neither. Functions that are about no result
(converters, settings) are left out; one that is in none of the tables below ends the script, so
that those of a new version are looked at.

    python -m bench.arviz_functions [words of the functions ...]

Without words the outcomes of the installed version go to docs/figures/arviz.csv, beside those of
other versions.
"""

from __future__ import annotations

import csv
import inspect
import sys
import tempfile
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import ssmppl as ssm
from ssmppl.inference.run.convergence import bulk_ess, rank_r_hat
from ssmppl.results import arviz

TABLE = Path(__file__).parents[1] / "docs" / "figures" / "arviz.csv"
HEADER = ["ArviZ", "function", "method", "outcome", "reason"]
NAMES = ["q", "r"]
DRAWS = 100
ROWS, MISSING = 30, 7
PROBABILITY = 0.9
METHODS = {
    "Gibbs": ssm.Gibbs(log_likelihood=True),
    "MetropolisHastings": ssm.MetropolisHastings(log_likelihood=True),
    "PMMH": ssm.PMMH(),
    "ISMCMC": ssm.ISMCMC(),
    "PGAS": ssm.PGAS(log_likelihood=True),
    "SMC2": ssm.SMC2(parameters=100, particles=50),
}

level = ssm.Model("level")
level.prior(lambda: {"q": ssm.InverseGamma(3, scale=1), "r": ssm.InverseGamma(3, scale=1)})
level.initial(lambda: {"x": ssm.Normal(0, sd=3)})
level.transition(lambda x, q: {"x": ssm.Normal(x, variance=q)})
level.observation(lambda x, r: {"y": ssm.Normal(x, variance=r)})


def series() -> np.ndarray:
    rng = np.random.default_rng(1)
    y = np.cumsum(rng.normal(size=ROWS) * 0.7) + rng.normal(size=ROWS) * 0.7
    y[MISSING] = np.nan
    return y


@dataclass(frozen=True)
class Result:
    """What `sample` and `predict` return of a method. measured : the same, with observations and
    their predictions of the measured rows only. other : of another method."""

    idata: Any
    measured: Any
    other: Any

    @property
    def posterior(self) -> Any:
        return self.idata["posterior"]

    def values(self, name: str) -> np.ndarray:
        return np.asarray(self.posterior[name])

    @property
    def log_likelihood(self) -> np.ndarray:
        """(draws, rows)."""
        return np.asarray(self.idata["log_likelihood"]["one_step"]).reshape(4 * DRAWS, -1)


def sampled(names: tuple[str, ...] = tuple(METHODS)) -> dict[str, Result]:
    """The results of methods, with their predictions."""
    y, found = series(), {}
    settings = {"draws": DRAWS, "warmup": 100, "chains": 4, "seed": 1, "progress": False}
    for name in names:
        drawn = ssm.sample(level, {"y": y}, METHODS[name], **settings)
        predicted = ssm.predict(level, drawn, {"y": y}, seed=1)
        prior = ssm.predict(level, None, {"y": y}, draws=2 * DRAWS, seed=1)
        found[name] = _joined(drawn, predicted, prior)
    seen = np.flatnonzero(~np.isnan(y))
    out = {}
    for name, idata in found.items():
        other = found["MetropolisHastings" if name == "Gibbs" else names[0]]
        out[name] = Result(idata, _rows(idata, seen), other)
    return out


def _joined(drawn: Any, predicted: Any, prior: Any) -> Any:
    groups = {"posterior_predictive": predicted, "prior": prior, "prior_predictive": prior}
    if hasattr(drawn, "extend"):  # InferenceData
        drawn.add_groups({g: v[g] for g, v in groups.items()})
    else:
        for group, value in groups.items():
            drawn[group] = value[group]
    return drawn


def _rows(idata: Any, seen: np.ndarray) -> Any:
    groups = ["posterior_predictive", "prior_predictive", "observed_data"]
    groups += ["posterior"] if "time" in idata["posterior"].dims else []
    if hasattr(idata, "extend"):
        return idata.isel(time=seen, groups=groups)
    out = idata.copy()
    for group in groups:
        out[group] = out[group].isel(time=seen)
    return out


# ------------------------------------------------------------------ by hand


def variables(found: Any) -> Any:
    """A Dataset of what a function gives for each variable."""
    found = found["posterior"] if hasattr(found, "children") and found.children else found
    return found


def each(by_hand: Callable[[np.ndarray], Any]) -> Callable[[Any, Result], bool]:
    def check(found: Any, result: Result) -> bool:
        return all(
            np.allclose(np.ravel(variables(found)[n]), by_hand(result.values(n)), rtol=1e-6)
            for n in NAMES
        )

    return check


def narrowest(draws: np.ndarray) -> np.ndarray:
    x = np.sort(draws.ravel())
    within = int(np.floor(PROBABILITY * len(x)))
    widths = x[within:] - x[: len(x) - within]
    k = int(np.argmin(widths))
    return np.array([x[k], x[k + within]])


def standard_error(draws: np.ndarray) -> float:
    return float(np.std(draws, ddof=1) / np.sqrt(float(arviz().ess(draws, method="mean"))))


def elpd(found: Any, result: Result) -> bool:
    """Beside importance sampling without smoothing of the weights, and the number of rows."""
    ratios = -result.log_likelihood
    weights = np.exp(ratios - ratios.max(axis=0))
    plain = np.log((weights * np.exp(-ratios)).sum(axis=0) / weights.sum(axis=0)).sum()
    value = getattr(found, "elpd_loo", None)
    value = getattr(found, "elpd", None) if value is None else value
    return abs(float(value) - plain) < 0.5 and int(found.n_data_points) == ROWS - 1


def waic(found: Any, result: Result) -> bool:
    log_p = result.log_likelihood
    value = np.log(np.exp(log_p).mean(axis=0)).sum() - log_p.var(axis=0).sum()
    return bool(np.isclose(float(found.elpd_waic), value, rtol=1e-6))


def ranked(found: Any, result: Result) -> bool:
    column = "elpd_loo" if "elpd_loo" in found else "elpd"
    values = found[column].astype(float).to_numpy()
    return values[0] >= values[1] and found.shape[0] == 2


def table(found: Any, result: Result) -> bool:
    means = found["mean"].astype(float)
    near = all(abs(means[n] - result.values(n).mean()) < 0.01 for n in NAMES)
    return near and len(found) == len(NAMES) + (ROWS if "x" in result.posterior else 0)


def finite(found: Any, result: Result) -> bool:
    found = variables(found)
    arrays = found.values() if hasattr(found, "data_vars") else [found]
    return all(bool(np.all(np.isfinite(np.asarray(a, dtype=float)))) for a in arrays)


def drawn(found: Any, result: Result) -> bool:
    """Every panel that is shown holds something, at places that are numbers."""
    from matplotlib import pyplot as plt

    axes = [a for n in plt.get_fignums() for a in plt.figure(n).axes if a.axison]
    lines = [ln for a in axes for ln in a.lines if len(ln.get_xdata())]
    held = [a for a in axes if a.lines or a.collections or a.patches or a.images or a.texts]
    places = [np.asarray(ln.get_ydata(), dtype=float) for ln in lines]
    return bool(held) and all(np.isfinite(p).any() for p in places)


# ------------------------------------------------------------------ how each is called

Call = tuple[Callable[[Any, Result], Any], Callable[[Any, Result], bool]]


def of(name: str, check: Callable[[Any, Result], bool], *more: Any, **options: Any) -> Call:
    return (lambda az, r: getattr(az, name)(r.idata, *more, **options)), check


def plot(name: str, *more: Any, measured: bool = False, **options: Any) -> Call:
    """By the parameters, or by the observations and predictions of the measured rows."""

    def call(az: Any, r: Result) -> Any:
        return getattr(az, name)(r.measured if measured else r.idata, *more, **options)

    return call, drawn


def for_draws(name: str, check: Callable[[Any, Result], bool]) -> Call:
    return (lambda az, r: getattr(az, name)(r.values("q"))), check


def by_loo(name: str) -> Call:
    return (lambda az, r: getattr(az, name)(az.loo(r.idata, pointwise=True))), drawn


def of_two(name: str, check: Callable[[Any, Result], bool]) -> Call:
    return (lambda az, r: getattr(az, name)({"a": r.idata, "b": r.other})), check


def compared(az: Any, r: Result) -> Any:
    return az.plot_compare(az.compare({"a": r.idata, "b": r.other}))


def psis(az: Any, r: Result) -> Any:
    return az.psislw(-r.log_likelihood.T)


def r_squared(az: Any, r: Result) -> Any:
    predicted = np.asarray(r.measured["posterior_predictive"]["y"]).reshape(4 * DRAWS, -1)
    return az.r2_score(np.asarray(r.measured["observed_data"]["y"]), predicted)["r2"]


def written(az: Any, r: Result, suffix: str) -> Any:
    with tempfile.TemporaryDirectory() as folder:
        path = str(Path(folder) / f"draws.{suffix}")
        if suffix == "nc":
            r.idata.to_netcdf(path, engine="h5netcdf")
            return az.from_netcdf(path)["posterior"].load()
        az.to_json(r.idata, path)
        return az.from_json(path)["posterior"].load()


def same_draws(found: Any, result: Result) -> bool:
    return all(np.array_equal(np.asarray(found[n]), result.values(n)) for n in NAMES)


def band(az: Any, r: Result) -> Any:
    return az.plot_hdi(r.posterior["time"], r.posterior["x"])


ONE = {"var_names": NAMES}
STATISTICS: dict[str, Call] = {
    "ess": of("ess", each(bulk_ess)),
    "rhat": of("rhat", each(rank_r_hat)),
    "mcse": of("mcse", each(standard_error)),
    "loo": of("loo", elpd),
    "compare": of_two("compare", ranked),
    "summary": of("summary", table),
    "extract": of("extract", lambda f, r: f.sizes["sample"] == 4 * DRAWS),
    "from_netcdf": (partial(written, suffix="nc"), same_draws),
    "convert_to_dataset": of("convert_to_dataset", same_draws),
    "plot_autocorr": plot("plot_autocorr", **ONE),
    "plot_ess": plot("plot_ess", **ONE),
    "plot_mcse": plot("plot_mcse", **ONE),
    "plot_rank": plot("plot_rank", **ONE),
    "plot_trace": plot("plot_trace", **ONE),
    "plot_forest": plot("plot_forest", **ONE),
    "plot_pair": plot("plot_pair", **ONE),
    "plot_parallel": plot("plot_parallel", **ONE),
    "plot_energy": plot("plot_energy"),
    "bfmi": of("bfmi", finite),
    "plot_khat": by_loo("plot_khat"),
    "plot_compare": (compared, drawn),
    "loo_pit": of("loo_pit", finite),
    "plot_loo_pit": plot("plot_loo_pit"),
    "reloo": of("reloo", finite),
    "weight_predictions": ((lambda az, r: az.weight_predictions([r.idata, r.other],
                            weights=[0.5, 0.5])["posterior_predictive"]["y"]), finite),
}  # fmt: skip
OF_0: dict[str, Call] = {
    "hdi": of("hdi", each(narrowest), hdi_prob=PROBABILITY),
    "waic": of("waic", waic),
    "psislw": (psis, lambda f, r: np.allclose(np.exp(f[0]).sum(axis=-1), 1.0)),
    "psens": of("psens", finite, component="likelihood"),
    "autocorr": for_draws("autocorr", lambda f, r: np.allclose(f[:, 0], 1.0)),
    "autocov": for_draws(
        "autocov", lambda f, r: np.allclose(f[:, 0], r.values("q").var(axis=1))
    ),
    "kde": ((lambda az, r: az.kde(r.values("q").ravel())),
            lambda f, r: abs(np.trapezoid(f[1], f[0]) - 1.0) < 0.02),
    "bayes_factor": of("bayes_factor", lambda f, r: np.isclose(f["BF10"] * f["BF01"], 1.0), "q",
                       ref_val=0.5),
    "r2_score": (r_squared, lambda f, r: 0.0 < f < 1.0),
    "concat": ((lambda az, r: az.concat(r.idata.copy(), r.idata.copy(), dim="chain")["posterior"]),
               lambda f, r: f.sizes["chain"] == 8),
    "from_json": (partial(written, suffix="json"), same_draws),
    "plot_bf": plot("plot_bf", "q", ref_val=0.5),
    "plot_bpv": plot("plot_bpv", measured=True),
    "plot_density": plot("plot_density", **ONE),
    "plot_dist": ((lambda az, r: az.plot_dist(r.values("q"))), drawn),
    "plot_dist_comparison": plot("plot_dist_comparison", **ONE),
    "plot_dot": ((lambda az, r: az.plot_dot(r.values("q").ravel())), drawn),
    "plot_ecdf": ((lambda az, r: az.plot_ecdf(r.values("q").ravel())), drawn),
    "plot_elpd": of_two("plot_elpd", drawn),
    "plot_hdi": (band, drawn),
    "plot_kde": ((lambda az, r: az.plot_kde(r.values("q"))), drawn),
    "plot_lm": ((lambda az, r: az.plot_lm(y="y", idata=r.measured)), drawn),
    "plot_loo_pit": ((lambda az, r: az.plot_loo_pit(r.measured, y="y")), drawn),
    "loo_pit": ((lambda az, r: az.loo_pit(r.measured, y="y")), finite),
    "plot_posterior": plot("plot_posterior", **ONE),
    "plot_ppc": plot("plot_ppc", measured=True, num_pp_samples=20),
    "plot_ts": ((lambda az, r: az.plot_ts(r.measured, y="y")), drawn),
    "plot_violin": plot("plot_violin", **ONE),
}  # fmt: skip
OF_1: dict[str, Call] = {
    "hdi": of("hdi", each(narrowest), prob=PROBABILITY),
    "bayes_factor": of("bayes_factor", lambda f, r: bool(f), "q", ref_vals=0.5),
    "diagnose": of("diagnose", lambda f, r: True, **ONE),
    "get_log_likelihood": of("get_log_likelihood", finite),
    "loo_influence": of("loo_influence", lambda f, r: True),
    **{n: of(n, finite) for n in ("iqr", "kde", "mad", "mode", "std", "var")},
    "mean": of("mean", each(np.mean), round_to="none"),
    "median": of("median", each(np.median), round_to="none"),
    "eti": of("eti", each(lambda x: np.quantile(x, [0.05, 0.95])), prob=PROBABILITY),
    "qds": of("qds", finite),
    "histogram": of("histogram", lambda f, r: True),
    "thin": of("thin", lambda f, r: variables(f).sizes["draw"] <= DRAWS),
    "rhat_nested": of("rhat_nested", finite, superchain_ids=[0, 0, 1, 1]),
    "kl_divergence": (
        (lambda az, r: az.kl_divergence(r.idata, r.other, num_samples=DRAWS, **ONE)), finite
    ),
    "wasserstein": (
        (lambda az, r: az.wasserstein(r.idata, r.other, num_samples=DRAWS, **ONE)), finite
    ),
    "psense": of("psense", finite, **ONE),
    "psense_summary": of("psense_summary", finite, **ONE),
    **{n: (partial(lambda az, r, name: getattr(az, name)(r.measured), name=n), finite)
       for n in ("loo_expectations", "loo_metrics", "loo_pit", "loo_score")},
    "loo_r2": ((lambda az, r: az.loo_r2(r.measured, "y")), finite),
    "metrics": ((lambda az, r: az.metrics(r.measured)), lambda f, r: f.mean > 0),
    "residual_r2": (
        (lambda az, r: az.residual_r2(r.measured, pred_mean="x", obs_name="y", summary=False)),
        finite,
    ),
    **{n: plot(n, **ONE) for n in (
        "plot_convergence_dist", "plot_dgof", "plot_dgof_dist", "plot_dist", "plot_ess_evolution",
        "plot_prior_posterior", "plot_rank_dist", "plot_ridge", "plot_trace_dist",
        "plot_psense_dist")},
    "plot_pair_focus": plot("plot_pair_focus", focus_var="q", **ONE),
    "plot_psense_quantities": plot("plot_psense_quantities", **ONE),
    "plot_bf": plot("plot_bf", "q", ref_val=0.5),
    "plot_ecdf_pit": plot("plot_ecdf_pit"),
    "plot_lm": plot("plot_lm", measured=True),
    **{n: plot(n, measured=True) for n in (
        "plot_loo_interval", "plot_loo_pava", "plot_loo_pit", "plot_ppc_dist", "plot_ppc_dist_pit",
        "plot_ppc_interval", "plot_ppc_pava", "plot_ppc_pit",
        "plot_ppc_rootogram", "plot_ppc_tstat", "plot_ppc_censored")},
}  # fmt: skip
# Converters, settings, parts of plots, and what needs a model as ArviZ knows one.
OF_NO_RESULT = set(
    """
    ColumnDataSource CoordSpec DimSpec apply_test_function clear_data_home create_layout
    dict_to_dataset extract_dataset convert_to_inference_data from_beanmachine from_cmdstan
    from_cmdstanpy from_datatree from_dict from_emcee from_numpyro from_pyjags from_pyro
    from_pystan from_pytree from_zarr list_datasets load_arviz_data make_ufunc
    numpy_to_data_array output_file output_notebook plot_separation pytree_to_dataset r2_samples
    show_layout smooth_data to_cds to_datatree to_json to_netcdf to_zarr wrap_xarray_ufunc
    add_bands add_lines bayesian_r2 ci_in_rope citations combine_plots convert_to_datatree
    dataset_to_dataarray dataset_to_dataframe ecdf explode_dataset_dims from_numpyro_svi
    generate_dims_coords generate_survival_curves get_data_home get_function
    get_unconstrained_samples hexbin histogram2d kaplan_meier kde2d lfo_cv
    loo_approximate_posterior plot_ppc_pava_residuals loo_i loo_kfold loo_moment_match
    loo_subsample make_attrs
    ndarray_to_dataarray references_to_dataset update_subsample xarray_sel_iter
    xarray_to_ndarray xarray_var_iter
    """.split()  # noqa: SIM905
)
# What gives an answer that is another than its name says, as the draws of `predict` at a row know
# that row: it has to be refused.
HAS_TO_BE_REFUSED = {
    "loo_pit", "plot_loo_pit", "loo_influence", "loo_expectations", "loo_metrics", "loo_score",
    "loo_r2", "plot_loo_interval", "plot_loo_pava",
}  # fmt: skip


def calls() -> dict[str, Call]:
    """Those of the installed version, by name.

    Raises
    ------
    SystemExit : it has functions that are in no table.
    """
    az = arviz()
    known = STATISTICS | (OF_0 if az.__version__.startswith("0.") else OF_1)
    there = {n for n in dir(az) if not n.startswith("_") and callable(getattr(az, n))
             and not inspect.isclass(getattr(az, n))}  # fmt: skip
    if new := sorted(there - set(known) - OF_NO_RESULT):
        raise SystemExit(f"ArviZ {az.__version__} has functions that are in no table: {new}")
    return {n: c for n, c in sorted(known.items()) if n in there}


def outcome(name: str, call: Call, result: Result) -> tuple[str, str]:
    """ "right", "refused" or "wrong", and the reason."""
    from matplotlib import pyplot as plt

    function, check = call
    try:
        found = function(arviz(), result)
        if name in HAS_TO_BE_REFUSED:
            return "wrong", "answers by draws that know the row itself"
        return ("right", "") if check(found, result) else ("wrong", "not what is computed by hand")
    except Exception as error:
        text = " ".join(str(error).split())
        return "refused", f"{type(error).__name__}: {text[:90]}"
    finally:
        plt.close("all")


def rows(words: list[str], names: tuple[str, ...] = tuple(METHODS)) -> list[list[str]]:
    import matplotlib

    matplotlib.use("Agg")
    version, out, results = arviz().__version__, [], sampled(names)
    for name, call in calls().items():
        if words and not any(w in name for w in words):
            continue
        for method, result in results.items():
            out.append([version, name, method, *outcome(name, call, result)])
            if words or out[-1][3] == "wrong":
                print(*out[-1], flush=True)
    return out


def main() -> None:
    warnings.simplefilter("ignore")
    words = sys.argv[1:]
    found = rows(words)
    if words:
        return
    version, before = arviz().__version__, []
    if TABLE.exists():
        with TABLE.open(newline="", encoding="utf-8") as file:
            major = version.partition(".")[0]
            before = [r for r in list(csv.reader(file))[1:] if r[0].partition(".")[0] != major]
    with TABLE.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows([HEADER, *sorted(before + found)])
    counts = {o: sum(r[3] == o for r in found) for o in ("right", "refused", "wrong")}
    print(f"ArviZ {version}:", ", ".join(f"{n} {o}" for o, n in counts.items()))


if __name__ == "__main__":
    main()
