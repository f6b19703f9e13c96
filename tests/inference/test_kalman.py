"""The exact filter against the joint Gaussian of all states and observations, written densely."""

import os
import subprocess
import sys

import numpy as np
import pytest
from scipy.stats import multivariate_normal

import ssmppl.language.distributions as D
from ssmppl import datasets
from ssmppl.analysis.structure import linear_gaussian
from ssmppl.codegen.kernels import kalman as kernel
from ssmppl.data import bind, check_parameters
from ssmppl.errors import ArgumentError, NotApplicable, SamplingError
from ssmppl.expressions.arrays import array
from ssmppl.expressions.evaluate import numbers
from ssmppl.inference.kalman import kalman_filter, kalman_log_likelihood, kalman_model
from ssmppl.language.model import Model
from ssmppl.language.trace import trace


# -- models: the laws as users write them, run by the dense computation on plain numbers
def scalar():
    model = Model("scalar")

    @model.prior
    def prior():
        return {"a": D.Uniform(-1, 1), "q": D.Gamma(1, rate=1), "r": D.Gamma(1, rate=1)}

    @model.initial
    def initial(a, q):
        return {"x": D.Normal(0.3, variance=q / (1 - a**2))}

    @model.transition
    def transition(x, a, q):
        return {"x": D.Normal(a * x + 0.1, variance=q)}

    @model.observation
    def observation(x, r):
        return {"y": D.Normal(2 * x - 1, sd=r)}

    return model, {"a": 0.8, "q": 0.5, "r": 0.7}, {}


def time_varying():
    model = Model("time varying", inputs=("u", "dt"))

    @model.prior
    def prior():
        return {"a": D.Uniform(-1, 1), "q": D.Gamma(1, rate=1)}

    @model.initial
    def initial(a, u, t):
        return {"x": D.MvNormal([u, t], covariance=np.array([[2.0, 0.5], [0.5, 1.0]]))}

    @model.transition
    def transition(x, a, q, u, dt, t):
        turn = np.stack([np.stack([a, np.cos(t)]), np.stack([-0.2 * dt, 0.9 + 0 * a])])
        noise = np.array([[1.0, 0.3], [0.3, 0.5]])
        return {"x": D.MvNormal(turn @ x + u * np.array([1.0, 2.0]), covariance=q * dt * noise)}

    @model.observation
    def observation(x, u, t, dt):
        gain = np.stack([np.stack([1.0 + 0 * t, np.sin(t)]), np.stack([u, 0.5 + 0 * u])])
        return {"y": D.MvNormal(gain @ x + t / 10, precision=np.array([[3.0, 0.4], [0.4, 2.0]])),
                "z": D.Normal(x[1], variance=0.1 + dt)}  # fmt: skip

    return model, {"a": 0.6, "q": 0.4}, {"u": (), "dt": "positive"}


def deterministic():
    model = Model("integrated, with a lag")

    @model.prior
    def prior():
        return {"q": D.Gamma(1, rate=1)}

    @model.initial
    def initial(q):
        return {"position": D.Dirac(1.5), "speed": D.Normal(0.2, sd=1), "lag": D.Dirac(0.0)}

    @model.transition
    def transition(position, speed, lag, q):
        mean = 0.9 * speed - 0.3 * lag - 0.1 * position
        return {"position": D.Dirac(position + 0.1 * speed),
                "lag": D.Dirac(speed + 0.01 * lag),
                "speed": D.Normal(mean, variance=q)}  # fmt: skip

    @model.observation
    def observation(position, lag):
        return {"y": D.Normal(np.stack([position, lag - position]), sd=np.array([0.3, 0.5]))}

    return model, {"q": 0.8}, {}


def feedback():
    model = Model("feedback", inputs=("u",))

    @model.prior
    def prior():
        return {"k": D.Normal(0, sd=1)}

    @model.initial
    def initial():
        return {"x": D.Normal(np.array([0.0, 1.0]), sd=np.array([1.0, 0.5]))}

    @model.transition
    def transition(x, y, u, k):
        mean = np.stack([0.7 * x[0] + k * y[0], x[0] + 0.5 * x[1] - k * y[1] * u])
        return {"x": D.Normal(mean, sd=0.4)}

    @model.observation
    def observation(x):
        return {"y": D.MvNormal(x, covariance=np.array([[0.5, 0.2], [0.2, 0.9]]))}

    return model, {"k": 0.3}, {"u": ()}


def noiseless_start():
    model = Model("everything known at the start")

    @model.initial
    def initial():
        return {"x": D.Dirac(2.0), "v": D.Dirac(-1.0)}

    @model.transition
    def transition(x, v, t):
        return {"x": D.Dirac(x + v), "v": D.Normal(v * (1 - 1 / (t + 1)), sd=1 / t)}

    @model.observation
    def observation(x, v):
        return {"y": D.Normal(x + v, sd=0.2)}

    return model, {}, {}


MODELS = [scalar, time_varying, deterministic, feedback, noiseless_start]


# -- the same laws as one dense Gaussian
def law(model, role, known, components):
    """Mean and covariance of one role at plain numbers, over `components` (name, index)."""
    mean, covariance = [], {}
    place = {}
    for function in model.functions[role]:
        wanted = function.__code__.co_varnames[: function.__code__.co_argcount]
        for name, d in function(**{n: known[n] for n in wanted}).items():
            own = [place.setdefault((name, i), len(place)) for i in np.ndindex(d.shape)]
            mean += list(numbers(array(d.mean()).ravel()))
            if isinstance(d, D.MvNormal):
                block = numbers(d.covariance_matrix().ravel()).reshape(len(own), -1)
            elif isinstance(d, D.Dirac):
                block = np.zeros((len(own), len(own)))
            else:
                block = np.diag(numbers(array(np.broadcast_to(d.variance(), d.shape)).ravel()))
            covariance |= {
                (i, j): block[a, b] for a, i in enumerate(own) for b, j in enumerate(own)
            }
    order = [place[c] for c in components]
    full = np.zeros((len(place), len(place)))
    for (i, j), v in covariance.items():
        full[i, j] = v
    return np.array(mean)[order], full[np.ix_(order, order)]


def by_name(components, values):
    """{name: number or array} from a flat vector."""
    out = {}
    for (name, index), v in zip(components, values, strict=True):
        out.setdefault(name, {})[index] = v
    return {
        n: items[()] if () in items else np.array([items[(i,)] for i in range(len(items))])
        for n, items in out.items()
    }


class Dense:
    """Every x_t and y_t as an affine function of one standard Gaussian vector."""

    def __init__(self, model, parameters, inputs, steps):
        traced = trace(model)
        self.states = [s.data[1:] for s in traced.state_symbols]
        self.channels = [s.data[1:] for s in traced.observation_symbols]
        d, k = len(self.states), len(self.channels)
        size = steps * (d + k)
        self.x, self.y = [], []
        for t in range(steps):
            u = {n: v[t] for n, v in inputs.items()}
            known = {**parameters, **u, "t": float(t + 1)}
            noise = np.zeros((d, size))
            if t == 0:
                centre, cov = law(model, "initial", known, self.states)
                x = [centre, np.zeros((d, size))]
            else:
                before = {**parameters, **{n: v[t - 1] for n, v in inputs.items()}, "t": float(t)}
                both = [*self.states, *self.channels]

                def mean(v, before=before, both=both):
                    return law(model, "transition", {**before, **by_name(both, v)}, self.states)

                centre, cov = mean(np.zeros(d + k))
                slope = np.array([mean(e)[0] - centre for e in np.eye(d + k)]).T
                past = [np.concatenate([self.x[-1][i], self.y[-1][i]]) for i in (0, 1)]
                x = [centre + slope @ past[0], slope @ past[1]]
            value, vector = np.linalg.eigh(cov)
            noise[:, t * (d + k) : t * (d + k) + d] = vector * np.sqrt(np.maximum(value, 0.0))
            self.x.append([x[0], x[1] + noise])

            def seen_mean(v, known=known):
                return law(
                    model, "observation", {**known, **by_name(self.states, v)}, self.channels
                )

            centre, cov = seen_mean(np.zeros(d))
            slope = np.array([seen_mean(e)[0] - centre for e in np.eye(d)]).T
            noise = np.zeros((k, size))
            noise[:, t * (d + k) + d : (t + 1) * (d + k)] = np.linalg.cholesky(cov)
            self.y.append([centre + slope @ self.x[-1][0], slope @ self.x[-1][1] + noise])

    def measured(self, seen, upto):
        """Mean and basis of the measured components of y_{1:upto}."""
        rows = [(t, j) for t in range(upto) for j in range(seen.shape[1]) if seen[t, j]]
        mean = np.array([self.y[t][0][j] for t, j in rows])
        basis = np.array([self.y[t][1][j] for t, j in rows]).reshape(
            len(rows), self.y[0][1].shape[1]
        )
        return rows, mean, basis

    def log_likelihood(self, y, seen, upto):
        rows, mean, basis = self.measured(seen, upto)
        if not rows:
            return 0.0
        values = np.array([y[t, j] for t, j in rows])
        return multivariate_normal(mean, basis @ basis.T).logpdf(values)

    def given(self, target, y, seen, upto):
        """Mean and covariance of a target (mean, basis) given the measured y_{1:upto}."""
        rows, mean, basis = self.measured(seen, upto)
        if not rows:
            return target[0], target[1] @ target[1].T
        values = np.array([y[t, j] for t, j in rows])
        gain = np.linalg.solve(basis @ basis.T, basis @ target[1].T).T
        return target[0] + gain @ (values - mean), (target[1] - gain @ basis) @ target[1].T

    def simulate(self, rng):
        e = rng.standard_normal(self.y[0][1].shape[1])
        return np.array([m + b @ e for m, b in self.y])


def data_of(traced, y, inputs):
    out = dict(inputs)
    at = 0
    for name, site in traced.observations.items():
        n = len(site.components)
        out[name] = y[:, at : at + n].reshape(len(y), *site.shape)
        at += n
    return out


@pytest.mark.parametrize("missing", [0.0, 0.3])
@pytest.mark.parametrize("build", MODELS)
def test_filter_is_the_dense_gaussian(build, missing):
    model, parameters, inputs = build()
    rng = np.random.default_rng(3)
    steps = 7
    inputs = {
        n: rng.uniform(0.2, 1.5, steps) if kind == "positive" else rng.normal(size=steps)
        for n, kind in inputs.items()
    }
    dense, traced = Dense(model, parameters, inputs, steps), trace(model)
    y = dense.simulate(rng)
    gaps = rng.random(y.shape) < missing
    if missing:
        gaps[2] = True
    if build is feedback:
        gaps[:-1] = False
    y[gaps] = np.nan
    (experiment,) = bind(traced, data_of(traced, y, inputs))
    theta = check_parameters(traced, parameters)
    run = kalman_filter(traced, experiment, theta)
    seen = experiment.seen
    total = 0.0
    for t in range(steps):
        upto = dense.log_likelihood(experiment.y, seen, t + 1)
        assert run.log_increments[t] == pytest.approx(upto - total, abs=1e-9)
        total = upto
        for target, at, mean, covariance in (
            (dense.x[t], t + 1, run.mean, run.covariance),
            (dense.x[t], t, run.mean_predicted, run.covariance_predicted),
            (dense.y[t], t, run.observation_mean, run.observation_covariance),
        ):
            exact_mean, exact_covariance = dense.given(target, experiment.y, seen, at)
            np.testing.assert_allclose(mean[t], exact_mean, atol=1e-9)
            np.testing.assert_allclose(covariance[t], exact_covariance, atol=1e-9)
    assert run.log_likelihood == pytest.approx(total, abs=1e-9)
    assert kalman_log_likelihood(traced, [experiment], theta) == run.log_likelihood
    twice = kalman_log_likelihood(traced, [experiment, experiment], theta)
    assert twice == pytest.approx(2 * total, abs=1e-8)


# -- published and tabulated values
def lgss(gain):
    model = Model("lgss")

    @model.prior
    def prior():
        return {"theta": D.Gamma(0.01, rate=0.01)}

    @model.initial
    def initial(theta):
        return {"x": D.Normal(0, precision=0.51 * theta)}

    @model.transition
    def transition(x, theta):
        return {"x": D.Normal(0.7 * x, precision=theta)}

    @model.observation
    def observation(x):
        return {"y": D.Normal(gain * x, variance=0.1)}

    return trace(model)


@pytest.mark.parametrize(("name", "gain"), [("lgss_main_text", 0.5), ("lgss_appendix", 1.0)])
def test_lgss(name, gain, exact_values):
    traced = lgss(gain)
    experiments = bind(traced, {"y": datasets.load(name)["y"]})
    for text, exact in exact_values[name]["log_likelihood"].items():
        theta = np.array([float(text)])
        assert kalman_log_likelihood(traced, experiments, theta) == pytest.approx(exact, abs=1e-9)


def level(start, q, r):
    model = Model("local level")

    @model.initial
    def initial():
        return {"level": start}

    @model.transition
    def transition(level):
        return {"level": D.Normal(level, variance=q)}

    @model.observation
    def observation(level):
        return {"y": D.Normal(level, variance=r)}

    return trace(model)


def test_random_walk_from_a_known_start(exact_values):
    traced, exact = level(D.Normal(0, variance=1), 1, 2), exact_values["scalar_lg"]
    (experiment,) = bind(traced, {"y": [0.0, 1.0, 2.0]})
    run = kalman_filter(traced, experiment, np.zeros(0))
    assert run.log_likelihood == pytest.approx(exact["log_likelihood"], abs=1e-6)
    np.testing.assert_allclose(run.mean[:, 0], exact["filter_means"], atol=1e-3)
    np.testing.assert_allclose(run.covariance[:, 0, 0], exact["filter_variances"], atol=1e-3)


# -- numbers that ruin the textbook form
def test_precise_measurements_of_a_vague_state():
    """Subtraction of covariances would leave nothing of the posterior variance."""
    traced = level(D.Normal(0, variance=1e10), 1e-12, 1e-14)
    (experiment,) = bind(traced, {"y": np.zeros(50)})
    run = kalman_filter(traced, experiment, np.zeros(0))
    precision = 1e-10 + 1e14
    for t in range(50):
        assert run.covariance[t, 0, 0] == pytest.approx(1 / precision, rel=1e-9)
        precision = 1 / (1 / precision + 1e-12) + 1e14


def test_square_root_of_semidefinite_matrices():
    rng = np.random.default_rng(0)
    for n in range(1, 6):
        for rank in range(n + 1):
            half = rng.normal(size=(n, rank))
            c = half @ half.T
            root = np.empty((n, n))
            assert kernel.square_root(c, root)
            np.testing.assert_allclose(root @ root.T, c, atol=1e-7)
    for bad in ([[1.0, 2.0], [2.0, 1.0]], [[-1.0]], [[np.nan]], [[0.0, 1.0], [1.0, 0.0]],
                [[np.inf]]):  # fmt: skip
        assert not kernel.square_root(np.array(bad), np.empty((len(bad), len(bad))))


@pytest.mark.parametrize("shape", [(1, 1), (1, 4), (3, 3), (3, 7), (5, 6)])
def test_triangularise_keeps_the_product(shape):
    a = np.random.default_rng(1).normal(size=shape)
    lower = a.copy()
    kernel.triangularise(lower)
    np.testing.assert_allclose(lower @ lower.T, a @ a.T, atol=1e-12)
    assert not np.triu(lower, 1).any()


# -- what does not exist
def test_parameters_without_a_density():
    model = Model()

    @model.prior
    def prior():
        return {"q": D.Normal(0, sd=1)}

    @model.initial
    def initial():
        return {"x": D.Normal(0, sd=1)}

    @model.transition
    def transition(x, q):
        return {"x": D.Normal(x, variance=q)}

    @model.observation
    def observation(x, q):
        return {"y": D.Normal(x, sd=0.1)}

    traced = trace(model)
    (experiment,) = bind(traced, {"y": [0.1, 0.2, 0.3]})
    assert kalman_log_likelihood(traced, [experiment], np.array([-1.0])) == -np.inf
    with pytest.raises(
        SamplingError, match=r"(?s)positive semidefinite at t=2; parameters: q = -1"
    ):
        kalman_filter(traced, experiment, np.array([-1.0]))
    assert np.isfinite(kalman_log_likelihood(traced, [experiment], np.array([0.0])))


def test_refuses_other_models():
    model = Model()

    @model.initial
    def initial():
        return {"x": D.Normal(0, sd=1)}

    @model.transition
    def transition(x):
        return {"x": D.Normal(np.sin(x), sd=1)}

    @model.observation
    def observation(x):
        return {"y": D.Normal(x, sd=1)}

    traced = trace(model)
    assert isinstance(kalman_model(traced), NotApplicable)
    assert kalman_model(traced).reason == linear_gaussian(traced).reason
    (experiment,) = bind(traced, {"y": [0.0]})
    with pytest.raises(ArgumentError, match="not linear and Gaussian"):
        kalman_log_likelihood(traced, [experiment], np.zeros(0))


def test_compiled_once_for_all_processes(tmp_path):
    code = (
        "import numpy as np\n"
        "from ssmppl.codegen.kernels.kalman import kalman_filter as f\n"
        "one, e = np.eye(1), np.eye(1)[None]\n"
        "v, inc, y = np.zeros((1, 1)), np.empty(3), np.zeros((3, 1))\n"
        "f(v[0], one, e, v, e, e, v, e, y, y + 1, inc, *[np.empty((0,) + s) for s in"
        " ((1,), (1, 1)) * 3])\n"
        "print(sum(f.stats.cache_hits.values()), sum(f.stats.cache_misses.values()))\n"
    )
    for expected in ("0 1", "1 0"):
        run = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True,
            env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)},
        )  # fmt: skip
        assert run.stdout.split() == expected.split()
