"""Linear Gaussian models of all kinds, and the same laws as one dense Gaussian."""

import numpy as np
from scipy.stats import multivariate_normal

import ssmppl.language.distributions as D
from ssmppl.data import bind, check_parameters
from ssmppl.expressions.arrays import array
from ssmppl.expressions.evaluate import evaluate
from ssmppl.language.model.model import Model
from ssmppl.language.model.trace import symbols
from ssmppl.language.tracing import trace


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
    """Mean and covariance of one role at numbers, over `components` (name, index).

    The numbers stand for symbols, as a spread that is written as zero is refused.
    """
    mean, covariance = [], {}
    place, values = {}, {}

    def given(name):
        value = np.asarray(known[name])
        square = value.ndim == 2 and value.shape[0] == value.shape[1]
        own = symbols("given", name, value.shape, square and bool(np.all(value == value.T)))
        values.update(zip(own.ravel(), np.ravel(known[name]), strict=True))
        return own if own.shape else own[()]

    def numbers(expressions):
        return np.array(evaluate(list(expressions), values), dtype=float)

    for function in model.functions[role]:
        wanted = function.__code__.co_varnames[: function.__code__.co_argcount]
        for name, d in function(**{n: given(n) for n in wanted}).items():
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


def root(covariance):
    """L with L L' = a covariance, which may be singular."""
    value, vector = np.linalg.eigh(covariance)
    return vector * np.sqrt(np.maximum(value, 0.0))


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
            noise[:, t * (d + k) : t * (d + k) + d] = root(cov)
            self.x.append([x[0], x[1] + noise])

            def seen_mean(v, known=known):
                return law(
                    model, "observation", {**known, **by_name(self.states, v)}, self.channels
                )

            centre, cov = seen_mean(np.zeros(d))
            slope = np.array([seen_mean(e)[0] - centre for e in np.eye(d)]).T
            noise = np.zeros((k, size))
            noise[:, t * (d + k) + d : (t + 1) * (d + k)] = root(cov)
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


def posed(build, missing, seed=3, steps=7):
    """Trace, parameters (P,), one simulated experiment and its dense law, with gaps at will."""
    model, parameters, inputs = build()
    rng = np.random.default_rng(seed)
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
    return traced, check_parameters(traced, parameters), experiment, dense
