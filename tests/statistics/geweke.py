"""Joint-distribution tests: do a sampler and the simulator mean the same joint distribution?

Geweke (2004), "Getting it right: joint distribution tests of posterior simulators", *JASA* 99.
Parameters, states and data (theta, x, y) are drawn in two ways:

* marginal-conditional: theta from the prior, x and y by simulation, independent draws;
* successive-conditional: alternately (i) new data y given theta and x, (ii) one transition of the
  sampler on (theta, x) given y.

If the sampler leaves p(theta, x | y) invariant, both have the same law, and so the same mean of
every function. Compared are first and second moments of the parameters (on the unconstrained
scale, where all moments exist), of the first, the middle and the last state, of an observation, of
log p(theta, x, y) and of neighbouring states, and the products of every parameter with a state and
with that log density: all of quantities that are centred and scaled by the independent draws, and
held within three standard deviations. (What is far out in both, as a state that is nearly
nonstationary, a chain leaves slowly: unbounded moments have standard errors that no chain of a
length that can be run tells. Functions of bounded quantities tell wrong samplers as well.)

The second simulator is run as many short chains, each from an independent draw of the joint law,
after the sampler's warmup, so that all of its tuning is fixed. Under the hypothesis every chain has
the right law from the first transition on, and the means over chains are independent: Monte Carlo
standard errors are those of batch means with independent batches, whatever the autocorrelation.
The first quarter of each chain is left out, in which one that goes wrong is only beginning to.
z = (mean over chains - mean of the independent draws) / standard error, corrected for skewness; p
by Student's t with the Welch-Satterthwaite degrees of freedom. Functions of one study depend on
each other: all decisions are Bonferroni's.

    python -m tests.statistics.geweke [chains] [study ...]

writes docs/figures/geweke.csv, one row for each model, method and function; with names, these
studies only, the others in the table staying.
"""

from __future__ import annotations

import csv
import sys
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import stats

import ssmppl as ssm
from ssmppl.inference.run.prior import draw_prior
from ssmppl.inference.verbs.simulate import feeds_back
from tests.models import standard as models
from tests.models import wider as wider_models

from . import geweke_kernels as kernels
from .checks import seed_of

STEPS = 5  # rows of data: few, so that each transition can move far
FAR = 3.0  # standard deviations that a quantity is held within
FORWARD = 5000  # independent draws
CHAINS, SWEEPS = 64, 60  # of the table
LEFT_OUT = 0.25  # of each chain
TABLE = Path(__file__).parents[2] / "docs" / "figures" / "geweke.csv"
COLUMNS = ("model", "method", "quantity", "z", "p", "chains", "sweeps", "effective")


@dataclass(frozen=True)
class Study:
    """A model and how it is sampled; `warmup` transitions in which the sampler adapts."""

    model: str
    method: ssm.PMMH | ssm.PGAS | ssm.Gibbs | ssm.MetropolisHastings
    label: str
    warmup: int

    @property
    def name(self) -> str:
        return f"{self.model} {self.label}"


@dataclass(frozen=True)
class Found:
    """The comparison of one function's two means.

    effective : number of independent draws that would have given the chains' standard error.
    """

    quantity: str
    z: float
    p: float
    effective: float


def studies() -> dict[str, Study]:
    """Every model with every sampler that applies to it."""
    pgas = {
        "PGAS": ssm.PGAS(particles=10, proposal="bootstrap", interweave=False),
        "PGAS interweaved": ssm.PGAS(particles=10, interweave=True),
        "PGAS eliminated": ssm.PGAS(particles=10, eliminate=True),
    }
    guided = {"PGAS guided": ssm.PGAS(particles=10, proposal="guided")}
    look_ahead = {"PGAS auxiliary": ssm.PGAS(particles=10, proposal="auxiliary")}
    pmmh = {"PMMH": ssm.PMMH(particles=60, proposal="bootstrap")}
    pmmh_guided = {"PMMH guided": ssm.PMMH(particles=40, proposal="guided")}
    exact = {
        "Gibbs": ssm.Gibbs(interweave=False),
        "Gibbs interweaved": ssm.Gibbs(interweave=True),
        "MetropolisHastings": ssm.MetropolisHastings(),
    }
    plain = {"PGAS": pgas["PGAS"]}
    without_elimination = {k: v for k, v in pgas.items() if k != "PGAS eliminated"}
    finite = {k: v for k, v in exact.items() if k != "Gibbs interweaved"}
    variants = {
        "PMMH correlated": ssm.PMMH(particles=60, proposal="bootstrap", correlation=0.9),
        "PMMH order 1": ssm.PMMH(particles=60, proposal="bootstrap", order=1),
        "PMMH order 2": ssm.PMMH(particles=60, proposal="bootstrap", order=2),
        "PMMH auxiliary": ssm.PMMH(particles=40, proposal="auxiliary"),
        "PMMH twisted": ssm.PMMH(particles=20, proposal="twisted"),
        "PMMH twisted at once": ssm.PMMH(
            particles=20, proposal="twisted", delayed_acceptance=False
        ),
        "PMMH delayed": ssm.PMMH(particles=60, proposal="bootstrap", delayed_acceptance=True),
        "PMMH natural scale": ssm.PMMH(particles=60, proposal="bootstrap", scale="natural"),
        "PMMH rescue": ssm.PMMH(particles=60, proposal="bootstrap", rescue=50),
    }
    # Where there is a Gaussian approximation, but for growth: of its two modes the guide knows one,
    # log Z scatters by several nats at many draws from the prior, and no number of independence
    # steps that can be afforded draws the run of a filter anew.
    twisted = {"PMMH twisted": variants["PMMH twisted"]}
    table: dict[str, dict] = {
        "proper_varves": pgas | guided | pmmh | pmmh_guided | twisted,
        "regression": pgas | look_ahead | pmmh | twisted,
        "two_states": pgas | pmmh | twisted,
        "counts": pgas | guided | pmmh | variants,
        "stationary": exact | plain | pmmh | twisted,
        "vector_ar": exact | plain | twisted,
        "vector_ar_apart": exact | plain | twisted,
        "three_regimes": finite | plain | pmmh,
        "leverage": pgas | guided | pmmh | twisted,
        "ricker": pgas | guided | pmmh | twisted,
        "growth": pgas | pmmh,
        "bounded": without_elimination | guided | pmmh | twisted,
        "delay": exact | pgas | pmmh | twisted,
    }
    found = [
        Study(model, method, label, 0 if label in ("PGAS", "Gibbs") else 300)
        for model, methods in table.items()
        for label, method in methods.items()
    ]
    return {study.name: study for study in found}


STUDIES = studies()
GAPS = {"vector_ar", "vector_ar_apart", "bounded"}  # whose data lack some rows and entries
RENEW: dict[str, kernels.Renew] = {}


def model_of(study: Study) -> ssm.Model:
    return getattr(wider_models if hasattr(wider_models, study.model) else models, study.model)


def leverage_data(problem, theta, path, rng):
    """y given (theta, x) where x_{t+1} has mean m_t + k e_t, e_t = y_t exp(-x_t / 2) ~ N(0, 1): e_t
    is Normal with precision 1 + k^2 tau, pulled by x_{t+1}; nothing follows the last."""
    mu, phi, tau, k = theta
    x = path[:, 0]
    precision = np.append(np.full(len(x) - 1, 1.0 + k * k * tau), 1.0)
    pull = np.append(k * tau * (x[1:] - mu - phi * (x[:-1] - mu)), 0.0)
    e = pull / precision + rng.standard_normal(len(x)) / np.sqrt(precision)
    return (e * np.exp(x / 2))[:, None]


RENEW["leverage"] = leverage_data


def first_data(study: Study, seed: int) -> dict[str, np.ndarray]:
    """Data of one simulation, with the gaps that they keep."""
    model = model_of(study)
    u = {name: np.sign(np.cos(np.arange(STEPS) / 1.5)) for name in model.inputs}
    y = ssm.simulate(model, steps=STEPS, inputs=u or None, seed=seed)["y"].values[0].astype(float)
    if study.model in GAPS:
        y[2] = np.nan
        if y.ndim > 1:
            y[3, 0] = np.nan
    return {"y": y} | u


def joint_draws(made: kernels.Transitions, draws: int, seed: int):
    """Independent draws of theta (draws, P), x (draws, T, D) and y (draws, T, K)."""
    problem, e = made.problem, made.problem.experiments[0]
    theta = draw_prior(problem.trace, np.random.default_rng(seed), draws)
    stream = kernels.random_state(np.random.SeedSequence(seed))
    run, feedback = problem.program.entry("simulate"), feeds_back(problem.trace)
    x = np.empty((draws, STEPS, len(problem.trace.state_symbols), 1))
    y = np.empty((draws, *e.y.shape, 1))
    for i in range(draws):
        run(theta[i], np.zeros_like(e.y), np.ones_like(e.y), e.u, stream, x[i], y[i], feedback)
    return theta, np.ascontiguousarray(x[..., 0]), y[..., 0]


class Functions:
    """What is compared: named functions of a point (theta, x, y), the data written in place."""

    def __init__(self, made: kernels.Transitions):
        self.made, trace = made, made.problem.trace
        names = [t.site.name for t in made.transforms for _ in t.free]
        at: dict[str, int] = {}
        self.parameters = []
        for name in names:
            at[name] = at.get(name, -1) + 1
            self.parameters.append(f"{name}.{at[name]}" if names.count(name) > 1 else name)
        self.rows = [0, STEPS // 2, STEPS // 2 + 1, STEPS - 1]
        states = [repr(s) for s in trace.state_symbols]
        self.states = [f"{s}[{t}]" for t in self.rows for s in states]
        self.base = [*self.parameters, *self.states, "y", "log p"]

    def __call__(self, theta: np.ndarray, path: np.ndarray) -> np.ndarray:
        """The quantities that the functions are made of, (B,)."""
        y = self.made.problem.experiments[0].y
        own = [*self.made.free(theta), *path[self.rows].ravel(), y[STEPS // 2, 0]]
        return np.array([*own, self.made.log_joint(theta, path)])

    def expand(self, values: np.ndarray) -> tuple[list[str], np.ndarray]:
        """Names (F,) and values (n, F) of all functions, from standardised quantities (n, B)."""
        values = np.clip(values, -FAR, FAR)
        by = dict(zip(self.base, values.T, strict=True))
        out = dict(by)
        out |= {f"{name}^2": v**2 for name, v in by.items()}
        d = len(self.states) // len(self.rows)
        middle = self.rows.index(STEPS // 2)
        for i in range(d):
            state, after = self.states[middle * d + i], self.states[(middle + 1) * d + i]
            out[f"{state} {after}"] = by[state] * by[after]
            out |= {f"{p} {state}": by[p] * by[state] for p in self.parameters}
        out |= {f"{p} log p": by[p] * by["log p"] for p in self.parameters}
        return list(out), np.stack(list(out.values()), axis=1)


def compare(
    study: Study, chains: int = CHAINS, sweeps: int = SWEEPS, forward: int = FORWARD, seed: int = 0
) -> list[Found]:
    """Both simulators of a study, and how far the means of their functions are apart."""
    root = seed_of("geweke", study.name, seed)
    made = kernels.prepare(
        model_of(study), study.method, first_data(study, root), study.warmup, root,
        RENEW.get(study.model),
    )  # fmt: skip
    functions = Functions(made)
    theta, x, y = joint_draws(made, forward + chains + 1, root)
    direct = np.empty((forward, len(functions.base)))
    for i in range(forward):
        made.write(y[i])
        direct[i] = functions(theta[i], x[i])
    keep = direct.std(axis=0) > 0.0  # a deterministic component may be one number
    functions.base = [b for b, k in zip(functions.base, keep, strict=True) if k]
    center, scale = direct[:, keep].mean(axis=0), direct[:, keep].std(axis=0)
    names, values = functions.expand((direct[:, keep] - center) / scale)
    chain(made, functions, theta[forward], x[forward], study.warmup)
    means = []
    for i in range(forward + 1, forward + 1 + chains):
        found = chain(made, functions, theta[i], x[i], sweeps)[int(LEFT_OUT * sweeps) :, keep]
        means.append(functions.expand((found - center) / scale)[1].mean(axis=0))
    return judged(names, values, np.array(means))


def chain(
    made: kernels.Transitions, functions: Functions, theta: np.ndarray, x: np.ndarray, sweeps: int
) -> np.ndarray:
    """The successive-conditional simulator from (theta, x): its quantities (sweeps, B)."""
    out = np.empty((sweeps, len(functions.parameters) + len(functions.states) + 2))
    for k in range(sweeps):
        made.data(theta, x)
        theta, x = made.parameters(theta, x)
        out[k] = functions(theta, x)
    return out


def judged(names: list[str], direct: np.ndarray, means: np.ndarray) -> list[Found]:
    """Tests of direct draws (n, F) against independent means (chains, F), corrected for skewness
    as in `checks.mean_one_p`."""
    n = len(means)
    own, other = means.var(axis=0, ddof=1) / n, direct.var(axis=0, ddof=1) / len(direct)
    total = own + other
    s = (means.mean(axis=0) - direct.mean(axis=0)) / np.sqrt(n * total)
    with np.errstate(all="ignore"):
        centred = means - means.mean(axis=0)
        skew = (centred**3).mean(axis=0) / (centred**2).mean(axis=0) ** 1.5
    a = np.nan_to_num(skew) * (own / total) ** 1.5  # none where all chains say the same
    z = np.sqrt(n) * (s + a * s**2 / 3 + a**2 * s**3 / 27 + a / (6 * n))
    freedom = total**2 / (own**2 / (n - 1) + other**2 / (len(direct) - 1))
    p = 2 * stats.t.sf(np.abs(z), freedom)
    p[np.isnan(p)] = 0.0  # a chain that comes to no number does not agree
    effective = direct.var(axis=0, ddof=1) / np.maximum(own, 1e-300)
    return [Found(*f) for f in zip(names, z.tolist(), p.tolist(), effective.tolist(), strict=True)]


def least(found: Iterable[Found]) -> float:
    """Bonferroni's p value of one study: that all of its functions agree."""
    p = [f.p for f in found]
    return min(1.0, min(p) * len(p))


def write_table(rows: dict[str, list[tuple]]) -> None:
    TABLE.parent.mkdir(parents=True, exist_ok=True)
    with TABLE.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        writer.writerows(row for name in STUDIES for row in rows.get(name, []))


def read_table() -> dict[str, list[tuple]]:
    rows: dict[str, list[tuple]] = {}
    if TABLE.exists():
        with TABLE.open(encoding="utf-8") as file:
            for row in list(csv.reader(file))[1:]:
                rows.setdefault(f"{row[0]} {row[1]}", []).append(tuple(row))
    return rows


def main(chains: int, chosen: list[str]) -> None:
    """Run the studies whose names begin with one of `chosen`, and put them into the table."""
    for name, study in STUDIES.items():
        if chosen and not name.startswith(tuple(chosen)):
            continue
        began = time.perf_counter()
        found = compare(study, chains)
        worst = min(found, key=lambda f: f.p)
        few = min(f.effective for f in found)
        print(
            f"{name:32} {len(found):3} functions, least p x their number {least(found):.4f} "
            f"({worst.quantity}, z {worst.z:+.2f}), effective at least {few:.0f}, "
            f"{time.perf_counter() - began:.0f} s", flush=True,
        )  # fmt: skip
        rows = [
            (study.model, study.label, f.quantity, f"{f.z:.3f}", f"{f.p:.3g}", chains, SWEEPS,
             f"{f.effective:.0f}")
            for f in found
        ]  # fmt: skip
        write_table(read_table() | {name: rows})


if __name__ == "__main__":
    main(int(sys.argv[1]) if sys.argv[1:] else CHAINS, sys.argv[2:])
