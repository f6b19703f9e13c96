"""Hidden Markov models: choices that three strategies explain, and capture histories of animals."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.special import expit, logsumexp

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

# --- a GLM-HMM: choices by logistic regression on a stimulus, in three states --------------------

TRIALS, STATES = 600, 3
WEIGHTS, BIASES = np.array([0.0, 2.0, 5.0]), np.array([-1.5, 1.5, 0.0])
STAY = 0.95
STARTS, EPS = 10, 1e-6  # of the EM algorithm by hmmlearn


def choices() -> dict[str, np.ndarray]:
    """Stimulus u and choice y of 600 trials, as of Ashwood et al. (2022)."""
    rng = np.random.default_rng(3)
    u, y, k = rng.normal(size=TRIALS), np.empty(TRIALS), 0
    for t in range(TRIALS):
        y[t] = rng.random() < expit(BIASES[k] + WEIGHTS[k] * u[t])
        if rng.random() > STAY:
            k = (k + 1 + rng.integers(2)) % STATES
    return {"y": y, "u": u}


def glm_hmm() -> ssm.Model:
    made = ssm.Model("GLM-HMM", inputs=("u",))

    @made.prior
    def prior():
        return {
            "stay": ssm.Dirichlet(1 + 8 * np.eye(STATES)),
            "weight": ssm.Normal(np.zeros(STATES), sd=3),
            "bias": ssm.Normal(np.zeros(STATES), sd=3),
        }

    @made.initial
    def initial():
        return {"k": ssm.Categorical(np.full(STATES, 1 / STATES))}

    @made.transition
    def transition(k, stay):
        return {"k": ssm.Categorical(stay[k])}

    @made.observation
    def observation(k, u, weight, bias):
        return {"y": ssm.Bernoulli(1 / (1 + np.exp(-bias[k] - weight[k] * u)))}

    return made


def _ordered(values: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> dict[str, tuple]:
    """Estimates of weights and biases, the states by rising weight, as no label means anything."""
    order = np.argsort(values["weight"][0])
    return {
        f"{name}[{i}]": (float(value[k]), float(error[k]))
        for name, (value, error) in values.items() for i, k in enumerate(order)
    }  # fmt: skip


def glm_own() -> Run:
    made, data = glm_hmm(), choices()

    def run(seed: int) -> Answer:
        found = ssm.maximize(made, data, seed=seed, progress=False)
        both = {n: (np.asarray(found.parameters[n]), np.asarray(found.standard_errors[n]))
                for n in ("weight", "bias")}  # fmt: skip
        return Answer(_ordered(both), estimated(found).remarks)

    return run


def glm_hmmlearn() -> Run:
    """EM by hmmlearn, whose base class is given this emission; the best of some random starts."""
    from hmmlearn.base import BaseHMM

    class Choices(BaseHMM):
        """Columns of X: choice, stimulus. beta : (states, 2) of bias and weight."""

        def _compute_log_likelihood(self, X):
            eta = self.beta[:, 0] + np.outer(X[:, 1], self.beta[:, 1])
            return -np.logaddexp(0, np.where(X[:, :1] == 1, -eta, eta))

        def _get_n_fit_scalars_per_param(self):
            return {"t": STATES * (STATES - 1), "b": 2 * STATES}

        def _initialize_sufficient_statistics(self):
            return {**super()._initialize_sufficient_statistics(), "shares": []}

        def _accumulate_sufficient_statistics(self, stats, X, lattice, post, forward, back):
            super()._accumulate_sufficient_statistics(stats, X, lattice, post, forward, back)
            stats["shares"].append((X, post))

        def _do_mstep(self, stats):
            super()._do_mstep(stats)
            ((X, post),) = stats["shares"]
            design = np.column_stack([np.ones(len(X)), X[:, 1]])
            for k in range(STATES):
                for _ in range(10):  # of Newton's steps
                    p = expit(design @ self.beta[k])
                    slope = design.T @ (post[:, k] * (X[:, 0] - p))
                    bend = (design.T * (post[:, k] * p * (1 - p))) @ design + 1e-8 * np.eye(2)
                    self.beta[k] += np.clip(np.linalg.solve(bend, slope), -1, 1)

    data = choices()
    X = np.column_stack([data["y"], data["u"]])

    def run(seed: int) -> Answer:
        rng, best = np.random.default_rng(seed), None
        for _ in range(STARTS):
            fitted = Choices(STATES, init_params="", params="t", n_iter=500, tol=EPS)
            fitted.startprob_ = np.full(STATES, 1 / STATES)
            fitted.transmat_ = np.where(np.eye(STATES), 0.9, 0.1 / (STATES - 1))
            fitted.beta = rng.normal(size=(STATES, 2)) * 2
            fitted.fit(X)
            value = float(fitted.score(X))
            if best is None or value > best[0]:
                best = value, fitted.beta
        value, beta = best
        none = np.full(STATES, np.nan)
        return Answer(_ordered({"weight": (beta[:, 1], none), "bias": (beta[:, 0], none)}),
                      {"log-likelihood": value, "by": f"EM, best of {STARTS} starts"})  # fmt: skip

    return run


def glm_faults(own: Answer, others: Mapping[str, Answer]) -> list[str]:
    """Where another found a higher maximum, or the same one elsewhere."""
    out: list[str] = []
    for other in others.values():
        out += below(own, float(other.remarks["log-likelihood"]), 0.01)
        if not out:
            out += distant(own, {name: v for name, (v, _) in other.estimates.items()}, 0.05)
    return out


# --- capture histories (Cormack, Jolly, Seber) of animals released at different occasions --------

ANIMALS, OCCASIONS, SURVIVAL, CAPTURE = 200, 7, 0.7, 0.5


def histories() -> list[dict[str, np.ndarray]]:
    """Of each animal whether it was seen, from its release on: 2 to 7 rows."""
    rng, found = np.random.default_rng(4), []
    for _ in range(ANIMALS):
        rows = rng.integers(2, OCCASIONS + 1)
        alive = np.cumprod(rng.random(rows - 1) < SURVIVAL)
        seen = alive * (rng.random(rows - 1) < CAPTURE)
        found.append({"seen": np.concatenate([[1.0], seen])})
    return found


def capture() -> ssm.Model:
    made = ssm.Model("capture and recapture")
    made.prior(lambda: {"phi": ssm.Beta(1, 1), "p": ssm.Beta(1, 1)})
    made.initial(lambda: {"alive": ssm.Bernoulli(1.0)})
    made.transition(lambda alive, phi: {"alive": ssm.Bernoulli(phi * alive)})
    made.observation(lambda alive, p, t: {"seen": ssm.Bernoulli(alive * np.where(t == 1, 1.0, p))})
    return made


def exact_posterior(points: int = 400) -> dict[str, tuple[float, float]]:
    """Mean and standard deviation of phi and p by the midpoint rule on a grid of the unit square.

    Between release and last sight an animal has survived, and was caught or not; the chance of not
    being seen again in n occasions is chi_n = 1 - phi + phi (1 - p) chi_{n-1}.
    """
    at = (np.arange(points) + 0.5) / points
    phi, p = np.meshgrid(at, at, indexing="ij")
    chi = [np.ones_like(phi)]
    for _ in range(OCCASIONS):
        chi.append(1 - phi + phi * (1 - p) * chi[-1])
    total = np.zeros_like(phi)
    for animal in histories():
        seen = animal["seen"]
        last = int(np.flatnonzero(seen)[-1])
        caught = seen[1 : last + 1].sum()
        total += last * np.log(phi) + caught * np.log(p) + (last - caught) * np.log1p(-p)
        total += np.log(chi[len(seen) - 1 - last])
    weight = np.exp(total - logsumexp(total))
    out = {}
    for name, grid in (("phi", phi), ("p", p)):
        mean = float((weight * grid).sum())
        out[name] = mean, float(np.sqrt((weight * (grid - mean) ** 2).sum()))
    return out


def capture_own() -> Run:
    made, data = capture(), histories()
    return lambda seed: sampled(
        ssm.sample(made, data, chains=2, draws=1_000, seed=seed, progress=False), ["phi", "p"]
    )


def capture_grid() -> Run:
    """The sums over survival in closed form, by hand, and a grid: exact."""
    return lambda seed: Answer(exact_posterior())


def capture_faults(own: Answer, others: Mapping[str, Answer]) -> list[str]:
    """Where a mean is further than four Monte Carlo standard errors from the exact one."""
    exact = exact_posterior()
    right, unit = ({n: v[i] for n, v in exact.items()} for i in (0, 1))
    ess = float(own.remarks["ESS"])
    return [*distant(own, right, 4 / ess**0.5, unit), *unmixed(own, 1.01)]


QUESTIONS = [
    Question(
        "glm-hmm", "GLM-HMM, three states, 600 rows: maximum likelihood", 1.0,
        (Program(OWN, glm_own), Program("hmmlearn", glm_hmmlearn, ("hmmlearn",))), glm_faults,
    ),
    Question(
        "capture", "200 capture histories of 2 to 7 rows: `sample`, 2 x 1,000 draws", 5.0,
        (Program(OWN, capture_own), Program("grid by hand, exact", capture_grid)), capture_faults,
    ),
]  # fmt: skip
