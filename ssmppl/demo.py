"""The ice varves, from four functions to a posterior: the model and the run of `ssmppl demo`.

The thickness of 634 yearly layers of glacial sediment is a Gamma variable around the exponential
of a signal, which is a stationary autoregression of order one. Model and priors are those of
Schön et al., "Sequential Monte Carlo methods for system identification" (2015).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import ssmppl as ssm
from ssmppl.datasets import ice_varves
from ssmppl.results import save

varves = ssm.Model("ice varves")


@varves.prior
def prior():
    return {"phi": ssm.Uniform(-1, 1), "tau": ssm.Gamma(0.01, rate=0.01)}


@varves.initial
def initial(phi, tau):
    return {"x": ssm.Normal(0, precision=(1 - phi**2) * tau)}


@varves.transition
def transition(x, phi, tau):
    return {"x": ssm.Normal(phi * x, precision=tau)}


@varves.observation
def observation(x):
    return {"y": ssm.Gamma(6.25, rate=0.256 * np.exp(-x))}


# Mean and standard deviation of the posterior by quadrature: 120 x 120 points in (atanh phi,
# log tau), the likelihood at each by a point-mass filter on a fine grid of x.
EXACT = {"phi": (0.950254, 0.016627), "tau": (46.1955, 12.129)}

# Iterations for each kept draw. One of PGAS costs a fraction of one of PMMH, and moves less.
PGAS_THIN, PMMH_THIN = 5, 2


def run(
    draws: int, seed: int | None, output: Path, say: Callable[[str], object] = print
) -> dict[str, tuple[Any, Path]]:
    """Tell the plan, sample by PGAS and by PMMH, compare both with quadrature, write netCDF.

    Ctrl-C ends the method that is running, and what it drew is shown and written.

    Parameters
    ----------
    draws : kept draws of each of four chains, after half as many for warmup.
    output : file of the draws of PGAS; those of PMMH go to `<stem>_pmmh<suffix>` beside it.
    say : takes each piece of text.

    Returns
    -------
    The draws of each method by its name, and their file.
    """
    began = time.perf_counter()
    say(str(ssm.explain(varves)))

    files = {"PGAS": output, "PMMH": output.with_name(f"{output.stem}_pmmh{output.suffix}")}
    results = {}
    for method, thin in ((ssm.PGAS(), PGAS_THIN), (ssm.PMMH(), PMMH_THIN)):
        name = type(method).__name__
        results[name] = _sample(method, say, draws=draws, warmup=draws // 2, thin=thin, seed=seed)
        save(results[name], files[name])
        if results[name]["posterior"].attrs["interrupted"]:
            break

    say(f"\nPosterior\n---------\n{_table(results)}")
    say(
        "\nThe error is the mean less the exact one, by quadrature, in Monte Carlo standard errors."
        "\nWithin 4 of them, at an ESS in the hundreds and an R-hat near 1, the two agree."
    )
    written = " and ".join(f"{files[name]} ({name})" for name in results)
    say(f"\nWrote {written}: read them by arviz.from_netcdf.")
    say(f"{time.perf_counter() - began:.0f} s in all, compilation included.")
    return {name: (idata, files[name]) for name, idata in results.items()}


def _sample(method: ssm.PGAS | ssm.PMMH, say: Callable[[str], object], **settings: Any) -> Any:
    began = time.perf_counter()
    idata = ssm.sample(varves, {"y": ice_varves()}, method, **settings)
    attrs = idata["posterior"].attrs
    say(
        f"\n{attrs['method']}: {attrs['particles']} particles, {attrs['proposal']}, 4 chains of "
        f"{settings['draws']} draws: {time.perf_counter() - began:.1f} s"
    )
    return idata


def _table(results: dict[str, Any]) -> str:
    """One row for each parameter and method, below the exact values."""
    lines = [f"{'':12}{'mean':>10}{'sd':>10}{'mcse':>10}{'error':>8}{'ess':>8}{'r_hat':>8}"]
    summaries = {method: ssm.summary(idata) for method, idata in results.items()}
    for name, (mean, sd) in EXACT.items():
        lines.append(f"{name + ' exact':12}{mean:10.5g}{sd:10.4g}")
        for method, table in summaries.items():
            row = table.loc[name]
            error = (row["mean"] - mean) / row["mcse_mean"]
            lines.append(
                f"{'    ' + method:12}{row['mean']:10.5g}{row['sd']:10.4g}{row['mcse_mean']:10.2g}"
                f"{error:+8.1f}{row['ess_bulk']:8.0f}{row['r_hat']:8.3f}"
            )
    return "\n".join(lines)
