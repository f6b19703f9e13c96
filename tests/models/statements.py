"""Models that between them use every distribution and every feature of the language.

`MODELS` maps a name to a function that declares the model; `THETA` gives parameters that are
moderate for all of them.
"""

import numpy as np

import ssmppl.language.distributions as D
from ssmppl.expressions.loops.integrate import integrate, repeat
from ssmppl.language.model.model import Model

MODELS = {}


def register(declare):
    MODELS[declare.__name__] = declare
    return declare


def build(name):
    return MODELS[name]()


def declare(name, *, prior=None, initial, transition, observation=None, proposal=None, inputs=()):
    """A model from its four laws as functions."""
    model = Model(name, inputs=inputs)
    if prior is not None:
        model.prior(prior)
    model.initial(initial)
    model.transition(transition)
    if observation is not None:
        model.observation(observation)
    if proposal is not None:
        model.proposal(proposal)
    return model


@register
def varves():
    def prior():
        return {"phi": D.Uniform(-1, 1), "tau": D.Gamma(2, rate=1)}

    def initial(phi, tau):
        return {"x": D.Normal(0, precision=(1 - phi**2) * tau)}

    def transition(x, phi, tau):
        return {"x": D.Normal(phi * x, precision=tau)}

    def observation(x):
        return {"y": D.Gamma(6.25, rate=0.256 * np.exp(-x))}

    return declare("varves", prior=prior, initial=initial, transition=transition,
                   observation=observation)  # fmt: skip


@register
def linear_scalar():
    def prior():
        return {"a": D.Beta(2, 2), "q": D.InverseGamma(2, scale=1), "r": D.HalfNormal(sd=1)}

    def initial(q):
        return {"x": D.Normal(1, sd=q)}

    def transition(x, a, q, t):
        return {"x": D.Normal(a * x + np.cos(0.1 * t), sd=q)}

    def observation(x, r):
        return {"y": D.Normal(2 * x + 1, variance=r)}

    return declare("linear scalar", prior=prior, initial=initial, transition=transition,
                   observation=observation)  # fmt: skip


@register
def linear_vector():
    def prior():
        return {"A": D.Normal(np.zeros((2, 2)), sd=0.3), "q": D.HalfCauchy(scale=1)}

    def initial():
        return {"x": D.MvNormal(np.zeros(2), covariance=np.array([[2.0, 0.3], [0.3, 1.0]]))}

    def transition(x, A, q, force):
        noise = q * np.array([[1.0, 0.2], [0.2, 0.5]])
        return {"x": D.MvNormal(A @ x + force, covariance=noise)}

    def observation(x, q):
        return {"y": D.MvNormal(np.stack([x[0], x[0] + x[1], x[1]]), precision=q * np.eye(3) + 0.1)}

    return declare("linear vector", prior=prior, initial=initial, transition=transition,
                   observation=observation, inputs={"force": 2})  # fmt: skip


@register
def wishart_noise():
    def prior():
        return {"P": D.Wishart(4, scale=np.eye(2)), "S": D.InverseWishart(5, scale=np.eye(2))}

    def initial(S):
        return {"x": D.MvNormal(np.array([0.1, 0.2]), covariance=S)}

    def transition(x, P):
        turn = np.linalg.inv(np.eye(2) + P)
        return {"x": D.MvNormal(turn @ np.tanh(x), precision=P)}

    def observation(x, S):
        root = np.linalg.cholesky(S)
        size = np.linalg.det(S) + np.linalg.slogdet(S)[1]
        return {"y": D.MvNormal(root @ x, cholesky=root), "z": D.Normal(x[0] * size, sd=0.5)}

    return declare("wishart noise", prior=prior, initial=initial, transition=transition,
                   observation=observation)  # fmt: skip


@register
def counts():
    def prior():
        return {"level": D.Normal(1, sd=0.2), "sigma": D.Exponential(rate=1)}

    def initial(level, sigma):
        return {"x": D.Normal(level, sd=sigma), "p": D.Beta(2, 3)}

    def transition(x, p, sigma):
        return {"x": D.Normal(0.9 * x, sd=sigma), "p": D.Beta(1 + 3 * p, 2)}

    def observation(x, p, sigma):
        return {
            "n": D.Poisson(np.exp(x)),
            "k": D.Binomial(7, p),
            "b": D.Bernoulli(1 / (1 + np.exp(-x))),
            "m": D.NegativeBinomial(np.exp(0.5 * x), dispersion=1 + sigma),
            "c": D.Categorical(np.stack([p / 2, p / 2, 1 - p])),
        }

    return declare("counts", prior=prior, initial=initial, transition=transition,
                   observation=observation)  # fmt: skip


@register
def heavy_tails():
    def prior():
        return {"nu": D.Uniform(3, 9), "s": D.LogNormal(0, sd=0.3)}

    def initial(s):
        return {"x": D.StudentT(5, 0.5, scale=s), "w": D.Laplace(0, scale=s)}

    def transition(x, w, nu, s):
        return {"x": D.StudentT(nu, 0.8 * x + w, scale=s), "w": D.Laplace(0.1 * w, scale=s)}

    def observation(x, w, nu, s):
        return {"y": D.StudentT(nu, x, scale=0.5), "v": D.Cauchy(w, scale=s),
                "l": D.Laplace(x - w, scale=1 + s)}  # fmt: skip

    return declare("heavy tails", prior=prior, initial=initial, transition=transition,
                   observation=observation)  # fmt: skip


@register
def positive():
    def prior():
        return {"a": D.Gamma(3, scale=0.5), "b": D.InverseGamma(3, scale=2)}

    def initial(a, b):
        return {"g": D.Gamma(a, rate=b), "h": D.HalfNormal(sd=b), "e": D.Exponential(scale=a)}

    def transition(g, h, e, a, b):
        return {
            "g": D.Gamma(1 + g, rate=1 + b),
            "h": D.InverseGamma(2 + a, scale=1 + h),
            "e": D.LogNormal(np.log(e) / 2, sd=0.4),
        }

    def observation(g, h, e, b):
        return {
            "y": D.Exponential(rate=1 + g),
            "z": D.HalfCauchy(scale=h + e),
            "w": D.HalfNormal(sd=g + 0.1),
            "i": D.InverseGamma(3, scale=e),
            "l": D.LogNormal(np.log(g), sd=b),
        }

    return declare("positive", prior=prior, initial=initial, transition=transition,
                   observation=observation)  # fmt: skip


@register
def bounded():
    def prior():
        return {"c": D.Uniform(0.5, 2)}

    def initial(c):
        return {"u1": D.Uniform(-c, c), "x": D.Truncated(D.Normal(0, sd=1), lower=-c, upper=2)}

    def transition(u1, x, c):
        return {
            "u1": D.Uniform(u1 / 2 - c, u1 / 2 + c),
            "x": D.Truncated(D.Normal(0.5 * x, sd=c), lower=-2),
        }

    def observation(u1, x, c):
        return {
            "y": D.Truncated(D.Gamma(2, rate=np.exp(x)), lower=0.2),
            "k": D.Truncated(D.Poisson(3 * c), lower=1),
            "b": D.Beta(np.exp(x), 1 + u1**2),
        }

    return declare("bounded", prior=prior, initial=initial, transition=transition,
                   observation=observation)  # fmt: skip


@register
def simplex():
    def prior():
        return {"k": D.Gamma(4, rate=1)}

    def initial():
        return {"p": D.Dirichlet(np.array([2.0, 3.0, 4.0]))}

    def transition(p, k):
        return {"p": D.Dirichlet(1 + k * p)}

    def observation(p, k):
        return {"y": D.Categorical(p), "q": D.Dirichlet(2 + k * p)}

    return declare("simplex", prior=prior, initial=initial, transition=transition,
                   observation=observation)  # fmt: skip


@register
def matrices():
    def prior():
        return {"df": D.Uniform(4, 6)}

    def initial(df):
        return {"S": D.Wishart(df, scale=np.eye(2) / 4)}

    def transition(S, df):
        return {"S": D.InverseWishart(df + 2, scale=S + np.eye(2))}

    def observation(S, df):
        return {"y": D.MvNormal(np.zeros(2), covariance=S), "V": D.Wishart(df, scale=S / df)}

    return declare("matrices", prior=prior, initial=initial, transition=transition,
                   observation=observation)  # fmt: skip


@register
def pendulum():
    """Deterministic components, an input, a step size, and a nonlinear observation."""

    def prior():
        return {"damping": D.HalfNormal(sd=1), "q": D.Exponential(rate=1)}

    def initial():
        return {"angle": D.Dirac(0.1), "speed": D.Normal(0, sd=0.5)}

    def transition(angle, speed, damping, q, torque, dt):
        pull = -9.81 * np.sin(angle) - damping * speed + torque
        return {"angle": D.Dirac(angle + dt * speed),
                "speed": D.Normal(speed + dt * pull, variance=q * dt)}  # fmt: skip

    def observation(angle, speed):
        return {"y": D.Normal(np.stack([np.sin(angle), np.cos(angle) * speed]), sd=0.1)}

    return declare("pendulum", prior=prior, initial=initial, transition=transition,
                   observation=observation, inputs=("torque", "dt"))  # fmt: skip


@register
def prey():
    """Multiplicative noise, more of it at the start, and a state that follows."""

    def prior():
        return {"r": D.Uniform(0.5, 2), "s": D.Uniform(0.1, 0.6)}

    def initial(s):
        return {"n": D.LogNormal(1, sd=s), "before": D.LogNormal(0.5, sd=0.3)}

    def transition(n, before, r, s):
        return {"n": D.LogNormal(np.log(n) + r - 0.2 * n, sd=s / (1 + before)),
                "before": D.Dirac(n)}  # fmt: skip

    def observation(n, before):
        return {"y": D.Poisson(n + 0.5 * before)}

    return declare("prey", prior=prior, initial=initial, transition=transition,
                   observation=observation)  # fmt: skip


@register
def seven_noises():
    """More noises than a factorisation is written out for, of a spread that varies."""

    def prior():
        return {"q": D.Uniform(0.2, 0.8)}

    def initial(q):
        return {"x": D.Normal(np.zeros(7), sd=q)}

    def transition(x, q):
        lagged = np.concatenate([x[1:], x[:1]])
        return {"x": D.Normal(0.5 * x + 0.3 * np.tanh(lagged), sd=q / (1 + lagged**2))}

    def observation(x):
        return {"y": D.Normal(np.sum(x), sd=1), "m": D.Poisson(np.exp(x[0] * x[6]))}

    return declare("seven noises", prior=prior, initial=initial, transition=transition,
                   observation=observation)  # fmt: skip


@register
def switching():
    """np.where, comparisons, clipping, indexing by a state, integer powers."""

    def prior():
        return {"rate": D.Normal(np.zeros(3), sd=1), "r": D.HalfNormal(sd=1)}

    def initial():
        return {"mode": D.Categorical(np.array([0.2, 0.3, 0.5])), "x": D.Normal(0, sd=1)}

    def transition(mode, x, rate):
        weights = np.stack([np.exp(rate[0] * (mode == 0)), 1.0 + mode, np.exp(rate[2] * x / 5)])
        drift = np.where((x > 1) & ~(mode >= 2), -x, np.clip(x**3, -2, 2) + rate[mode])
        drift = drift + np.minimum(abs(x), 3) ** -2 * 0.01 + (x // 2) - x % 3
        return {"mode": D.Categorical(weights / np.sum(weights)), "x": D.Normal(drift, sd=1)}

    def observation(mode, x, r):
        return {"y": D.Normal(np.where(mode == 1, x, np.sign(x) * np.sqrt(abs(x))), sd=r)}

    return declare("switching", prior=prior, initial=initial, transition=transition,
                   observation=observation)  # fmt: skip


@register
def leverage():
    """Stochastic volatility whose transition hears the last return; `y`, `u` and `t` as names."""

    def prior():
        return {"phi": D.Beta(20, 2), "rho": D.Uniform(-1, 1), "sigma": D.HalfNormal(sd=1)}

    def initial(sigma):
        return {"h": D.Normal(0, sd=sigma)}

    def transition(h, y, phi, rho, sigma, u):
        mean = phi * h + rho * sigma * np.exp(-h / 2) * y + 0.1 * u
        return {"h": D.Normal(mean, sd=sigma * np.sqrt(1 - rho**2))}

    def observation(h, u):
        return {"y": D.Normal(0.1 * u, sd=np.exp(h / 2))}

    return declare("leverage", prior=prior, initial=initial, transition=transition,
                   observation=observation, inputs=("u",))  # fmt: skip


@register
def own_proposal():
    def prior():
        return {"a": D.Uniform(-1, 1)}

    def initial():
        return {"x": D.Normal(0, sd=1), "z": D.Laplace(0, scale=1)}

    def transition(x, z, a):
        return {"x": D.Normal(a * np.sin(x) + z, sd=0.7), "z": D.Laplace(z / 2, scale=1)}

    def observation(x):
        return {"y": D.StudentT(4, x, scale=0.3), "e": D.Exponential(rate=np.exp(x))}

    def proposal(x, z, a, y):
        return {"x": D.StudentT(5, (y + a * np.sin(x)) / 2, scale=0.5),
                "z": D.Laplace(z / 2, scale=1.5)}  # fmt: skip

    return declare("own proposal", prior=prior, initial=initial, transition=transition,
                   observation=observation, proposal=proposal)  # fmt: skip


@register
def awkward_names():
    """Names that generated code uses itself, and a constant law."""

    def prior():
        return {"n": D.Normal(0, sd=1), "states": D.Normal(0, sd=1), "rng": D.HalfNormal(sd=1),
                "max": D.HalfNormal(sd=1)}  # fmt: skip

    def initial(n):
        return {"i": D.Normal(n, sd=1), "exp": D.Normal(0, sd=1), "c0": D.Normal(1, sd=2)}

    def transition(i, exp, c0, n, states, rng, s, seen):
        return {"i": D.Normal(n * i + s + seen, sd=rng), "exp": D.Normal(np.exp(-exp), sd=rng),
                "c0": D.Normal(np.sin(c0 * states), sd=0.5)}  # fmt: skip

    def observation(i, exp, c0, max, range):
        return {"log_w": D.Normal(i + np.exp(exp / 4), sd=max), "theta": D.Normal(range, sd=1)}

    return declare("awkward names", prior=prior, initial=initial, transition=transition,
                   observation=observation, inputs=("s", "seen", "range"))  # fmt: skip


@register
def outliers():
    """Mixtures as prior, transition and observation, of scalars and arrays, one inside another."""

    def prior():
        return {
            "p": D.Beta(2, 8),
            "w": D.Dirichlet([2.0, 2.0, 1.0]),
            "r": D.HalfNormal(sd=1),
            "m": D.Mixture([0.3, 0.7], [D.Normal(-1, sd=0.5), D.StudentT(4, 1, scale=0.5)]),
            "s": D.Mixture([0.5, 0.5], [D.Gamma(2, rate=2), D.LogNormal(0, sd=0.5)]),
        }

    def initial(m):
        return {"x": D.Normal(m, sd=1), "z": D.Normal(np.zeros(2), sd=1)}

    def transition(x, z, p, s):
        jump = 1 / (1 + np.exp(-x))
        return {
            "x": D.Mixture([1 - p, p], [D.Normal(0.9 * x, sd=0.2), D.Normal(x, sd=2 * s)]),
            "z": D.Mixture([jump, 1 - jump], [D.Normal(0.5 * z, sd=0.3), D.Laplace(z[0], scale=s)]),
        }

    def observation(x, z, w, r):
        late = D.Mixture([0.5, 0.5], [D.Exponential(scale=r), D.HalfNormal(sd=2)])
        return {
            "y": D.Mixture(w, [D.Normal(x, sd=r), D.Normal(x, sd=5), D.Cauchy(x, scale=1)]),
            "late": D.Mixture([0.8, 0.2], [D.Normal(x, sd=r), late]),
            "v": D.Mixture([0.9, 0.1], [D.Normal(z, sd=r), D.Normal(0, sd=10)]),
        }

    return declare(
        "outliers", prior=prior, initial=initial, transition=transition, observation=observation
    )


@register
def surveys():
    """Counts with zeros of their own and more scatter; lifetimes and headings."""

    def prior():
        return {"zero": D.Beta(2, 2), "k": D.HalfNormal(sd=2), "kappa": D.Gamma(3, rate=1)}

    def initial(kappa):
        return {
            "n": D.ZeroInflated(D.Poisson(4.0), 0.2),
            "age": D.Weibull(2.0, scale=3.0),
            "angle": D.VonMises(0.0, concentration=kappa),
        }

    def transition(n, age, angle, k, kappa):
        return {
            "n": D.ZeroInflated(D.NegativeBinomial(2.0 + 0.5 * n, dispersion=3.0), 0.1),
            "age": D.Weibull(1.0 + k, scale=0.5 + 0.5 * age),
            "angle": D.VonMises(angle + 0.5, concentration=kappa),
        }

    def observation(n, age, angle, zero, k, kappa):
        return {
            "seen": D.ZeroInflated(D.Binomial(n, 0.4), zero),
            "many": D.ZeroInflated(D.Truncated(D.Poisson(1.0 + n), lower=1), zero),
            "shares": D.BetaBinomial(n, 1.0 + k, age * np.array([1.0, 2.0])),
            "kinds": D.Mixture([zero, 1 - zero], [D.Poisson(1.0), D.BetaBinomial(9, k, 2)]),
            "heading": D.VonMises(angle, concentration=3.0 + kappa),
        }

    return declare(
        "surveys", prior=prior, initial=initial, transition=transition, observation=observation
    )


@register
def small_steps():
    """A differential equation in small steps, one within another's, an observation by one, and the
    exact solution of a linear one over a time from the data."""

    def prior():
        return {"k": D.HalfNormal(sd=3), "d": D.HalfNormal(sd=1)}

    def initial():
        return {"q": D.Normal(0.4, sd=0.3), "v": D.Normal(0, sd=0.5), "x": D.Normal(0, sd=1)}

    def transition(q, v, x, k, d, torque, dt):
        def swing(q, v):
            drag = repeat(lambda a: a + 0.1 * (np.tanh(v) - a), 0.5 * v, 3)
            return {"q": v, "v": torque - k * np.sin(q) - d * drag}

        new = integrate(swing, {"q": q, "v": v}, 0.2, steps=5)
        flow = integrate(lambda x: -(0.5 + d) * x + k, np.stack([x, 0.3 * q]), 0.3 * dt)
        return {"q": D.Dirac(new["q"]), "v": D.Normal(new["v"], sd=0.1 * d),
                "x": D.Normal(flow[0] + 0.1 * flow[1], sd=0.3)}  # fmt: skip

    def observation(q, v, x):
        def fall(q):
            return -0.5 * q * q

        ahead = integrate(fall, q + 0.1 * x, 0.1, steps=4, method="heun")
        return {"y": D.Normal(np.stack([np.sin(q), ahead]), sd=0.1), "z": D.Normal(v, sd=0.2)}

    return declare("small_steps", prior=prior, initial=initial, transition=transition,
                   observation=observation, inputs=("torque", "dt"))  # fmt: skip


@register
def new_values():
    def prior():
        return {"a": D.Beta(2, 2), "b": D.Normal(0, sd=1), "q": D.InverseGamma(3, scale=1)}

    def initial():
        return {"x": D.Normal(np.zeros(2), sd=1), "k": D.Bernoulli(0.5), "n": D.Poisson(2)}

    def shared(q, x):
        return {"shock": D.Normal(0, variance=q), "moved": D.Poisson(np.exp(0.2 * x[0]))}

    def position(x, a, shock_next):
        return {"x": D.Normal(np.stack([a * x[0], 0.5 * x[1]]) + shock_next, sd=0.5)}

    def kind(x_next, k):
        return {"k": D.Bernoulli(np.where(k > 0, 0.8, 1 / (1 + np.exp(-x_next[1]))))}

    def number(n, k_next, moved_next):
        return {"n": D.Dirac(np.floor(0.5 * n) + k_next + moved_next)}

    def observation(x, n, b):
        return {"y": D.Normal(x[0] + b * x[1], sd=0.5), "c": D.Poisson(n + 0.5)}

    model = declare("new_values", prior=prior, initial=initial, transition=shared,
                    observation=observation)  # fmt: skip
    for step in (position, kind, number):
        model.transition(step)
    return model
