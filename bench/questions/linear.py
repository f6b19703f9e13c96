"""Linear Gaussian models: the carbon dioxide of Mauna Loa by trend and season, dynamic factors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

import ssmppl as ssm

from .question import (
    OWN,
    Answer,
    Program,
    Question,
    Run,
    below,
    distant,
    estimated,
    sampled,
    unmixed,
)

# --- 240 months of carbon dioxide: level, slope and a season of twelve months, 13 states ---------

# Monthly means, ppm, 1982 to 2001, of the weekly series that statsmodels embeds (Keeling and Whorf
# 2004, Scripps Institution of Oceanography; in the public domain).
CO2 = Path(__file__).with_name("co2.csv")
LEVEL, SPREAD, SLOPE = 341.0, 5.0, 1.0  # the first month's level, its sd and the slope's
CO2_SCALES = ("irregular", "level_sd", "slope_sd", "season_sd")
CO2_BEST = -91.0324  # statsmodels 0.15, from several starts


def carbon_dioxide() -> np.ndarray:
    """ppm by month, (240,)."""
    return np.loadtxt(CO2, delimiter=",", skiprows=1, usecols=1)


def trend_and_season() -> ssm.Model:
    made = ssm.Model("trend and season")

    @made.prior
    def prior():
        return {name: ssm.HalfNormal(sd=1) for name in CO2_SCALES}

    @made.initial
    def initial():
        return {
            "level": ssm.Normal(LEVEL, sd=SPREAD), "slope": ssm.Normal(0, sd=SLOPE),
            "season": ssm.Normal(0, sd=SPREAD), "past": ssm.Normal(np.zeros(10), sd=SPREAD),
        }  # fmt: skip

    @made.transition
    def transition(level, slope, season, past, level_sd, slope_sd, season_sd):
        return {
            "level": ssm.Normal(level + slope, sd=level_sd),
            "slope": ssm.Normal(slope, sd=slope_sd),
            "season": ssm.Normal(-season - past.sum(), sd=season_sd),
            "past": ssm.Dirac(np.concatenate([np.stack([season]), past[:-1]])),
        }

    @made.observation
    def observation(level, season, irregular):
        return {"y": ssm.Normal(level + season, sd=irregular)}

    return made


def co2_own() -> Run:
    made, data = trend_and_season(), {"y": carbon_dioxide()}
    return lambda seed: estimated(ssm.maximize(made, data, seed=seed, progress=False))


def co2_statsmodels() -> Run:
    from statsmodels.tsa.statespace.structural import UnobservedComponents

    y = carbon_dioxide()

    def run(seed: int) -> Answer:
        made = UnobservedComponents(y, level="local linear trend", seasonal=12)
        variances = [SPREAD**2, SLOPE**2, *[SPREAD**2] * 11]
        made.ssm.initialize_known(np.array([LEVEL, *[0.0] * 12]), np.diag(variances))
        made.loglikelihood_burn = 0
        found = made.fit(disp=0)
        sd = np.sqrt(found.params)
        errors = found.bse / (2 * sd)
        rows = zip(CO2_SCALES, sd, errors, strict=True)
        return Answer({n: (float(a), float(b)) for n, a, b in rows},
                      {"log-likelihood": float(found.llf)})  # fmt: skip

    return run


def co2_faults(own: Answer, others: Mapping[str, Answer]) -> list[str]:
    """Where it is below the best known maximum; there the last two scales are at zero."""
    out = below(own, CO2_BEST, 0.01)
    return out + distant(own, {"irregular": 0.1697, "level_sd": 0.1814}, 0.05)


# --- dynamic factors: 8 series, 200 rows, 2 factors ----------------------------------------------

SERIES, ROWS = 8, 200
FACTORS = ("A", "first", "second", "third", "rest", "noise")


def factor_series() -> np.ndarray:
    """Simulated series (200, 8)."""
    rng = np.random.default_rng(1)
    turn, load = np.array([[0.8, 0.1], [-0.1, 0.6]]), rng.normal(size=(SERIES, 2))
    load[0] = 1.0, 0.0
    noise, f = rng.uniform(0.4, 1.0, SERIES), rng.normal(size=2)
    y = np.empty((ROWS, SERIES))
    for t in range(ROWS):
        y[t] = load @ f + noise * rng.normal(size=SERIES)
        f = turn @ f + rng.normal(size=2)
    return y


def factors() -> ssm.Model:
    """Two factors of unit noise; the first series has no part in the second, and the signs of two
    loadings are held, so that nothing can be turned."""
    made = ssm.Model("dynamic factors")

    @made.prior
    def prior():
        return {
            "A": ssm.Normal(np.zeros((2, 2)), sd=1),
            "first": ssm.HalfNormal(sd=2), "second": ssm.Normal(0, sd=2),
            "third": ssm.HalfNormal(sd=2), "rest": ssm.Normal(np.zeros((SERIES - 2, 2)), sd=2),
            "noise": ssm.HalfNormal(sd=np.full(SERIES, 2.0)),
        }  # fmt: skip

    @made.initial
    def initial():
        return {"f": ssm.Normal(np.zeros(2), sd=1)}

    @made.transition
    def transition(f, A):
        return {"f": ssm.Normal(A @ f, sd=1)}

    @made.observation
    def observation(f, first, second, third, rest, noise):
        top = np.stack([first * f[0], second * f[0] + third * f[1]])
        return {"y": ssm.Normal(np.concatenate([top, rest @ f]), sd=noise)}

    return made


def _noises(found: Answer) -> Answer:
    """Of many estimates those of the noises, which no turning of the factors touches."""
    kept = {n: v for n, v in found.estimates.items() if n.startswith("noise")}
    return replace(found, estimates=kept)


def factors_own() -> Run:
    made, data = factors(), {"y": factor_series()}
    return lambda seed: _noises(estimated(ssm.maximize(made, data, seed=seed, progress=False)))


def factors_statsmodels() -> Run:
    from statsmodels.tsa.statespace.dynamic_factor import DynamicFactor

    y = factor_series()

    def run(seed: int) -> Answer:
        made = DynamicFactor(y, k_factors=2, factor_order=1, enforce_stationarity=False)
        made.ssm.initialize_known(np.zeros(2), np.eye(2))
        found = made.fit(disp=0, maxiter=1_000)
        at = [n.startswith("sigma2") for n in made.param_names]
        sd = np.sqrt(found.params[at])
        errors = found.bse[at] / (2 * sd)
        return Answer(
            {f"noise[{i}]": (float(a), float(b))
             for i, (a, b) in enumerate(zip(sd, errors, strict=True))},
            {"log-likelihood": float(found.llf),
             "note": "converged" if found.mle_retvals["converged"] else "not converged"},
        )  # fmt: skip

    return run


def factors_faults(own: Answer, others: Mapping[str, Answer]) -> list[str]:
    """Where the other's log-likelihood is above it by more than rounding."""
    out: list[str] = []
    for other in others.values():
        out += below(own, float(other.remarks["log-likelihood"]), 0.01)
        if not out:
            out += distant(own, {name: v for name, (v, _) in other.estimates.items()}, 0.05)
    return out


def factors_posterior() -> Run:
    made, data = factors(), {"y": factor_series()}
    return lambda seed: sampled(
        ssm.sample(made, data, chains=2, draws=500, seed=seed, progress=False), FACTORS, ["noise"]
    )


QUESTIONS = [
    Question(
        "co2", "CO2, trend and season, 240 months, 13 states: maximum likelihood", 0.3,
        (
            Program(OWN, co2_own),
            Program("statsmodels", co2_statsmodels, ("statsmodels",)),
        ),
        co2_faults,
    ),
    Question(
        "factors-maximum",
        "dynamic factors, 8 series, 200 rows, 2 factors: maximum likelihood", 2.0,
        (
            Program(OWN, factors_own),
            Program("statsmodels", factors_statsmodels, ("statsmodels",)),
        ),
        factors_faults,
    ),
    Question(
        "factors-posterior", "the same: `sample`, 2 x 500 draws", 10.0,
        (Program(OWN, factors_posterior),), lambda own, others: unmixed(own, 1.05),
    ),
]  # fmt: skip
