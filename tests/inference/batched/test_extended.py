"""Models that call a simulator, against exact answers and against the same model written out."""

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.inference.batched.extended import extended_model
from ssmppl.inference.exact.derivatives import jacobian
from ssmppl.inference.run.problem import pose

T = 40
RNG = np.random.default_rng(5)
U = np.sin(np.arange(T) / 4.0)
AT = {"k": 0.8, "c": 0.5, "s": 0.3}


def position(state, inputs, parameters):
    return state[:, :1]


@ssm.simulator(
    state=["q", "v"], inputs=["u"], parameters=["k", "c"], output=position, outputs=["z"]
)
def spring(state, inputs, parameters):
    """Linear: two steps of a damped spring."""
    (q, v), (u,), (k, c) = state.T, inputs.T, parameters.T
    for _ in range(2):
        q, v = q + 0.2 * v, v + 0.2 * (u - k * q - c * v)
    return np.stack([q, v], axis=1)


def written(q, v, u, k, c):
    for _ in range(2):
        q, v = q + 0.2 * v, v + 0.2 * (u - k * q - c * v)
    return {"q": q, "v": v}


def called(q, v, u, k, c):
    return spring(q=q, v=v, u=u, k=k, c=c)


def model_of(step, observe, dirac=True, priors=None):
    model = ssm.Model("spring", inputs=("u",))

    @model.prior
    def prior():
        return priors or {
            "k": ssm.HalfNormal(sd=2), "c": ssm.HalfNormal(sd=2), "s": ssm.HalfNormal(sd=1)
        }  # fmt: skip

    @model.initial
    def initial():
        return {"q": ssm.Normal(0, sd=0.5), "v": ssm.Normal(0, sd=0.5)}

    @model.transition
    def transition(q, v, u, k, c, s):
        new = step(q, v, u, k, c)
        first = ssm.Dirac(new["q"]) if dirac else ssm.Normal(new["q"], sd=0.1)
        return {"q": first, "v": ssm.Normal(new["v"], sd=s)}

    model.observation(observe)
    return model


def normal(q):
    return {"y": ssm.Normal(q, sd=0.2)}


def sensed(q, v, u, k, c):
    return {"y": ssm.Normal(spring.sense(q=q, v=v, u=u, k=k, c=c).z, sd=0.2)}


def counts(q):
    return {"y": ssm.Poisson(np.exp(1.0 + 0.5 * q))}


def heavy(q):
    return {"y": ssm.StudentT(4.0, q, scale=0.2)}


def simulated(seed, counts=False, steps=T):
    rng = np.random.default_rng(seed)
    x, y = 0.5 * rng.standard_normal((1, 2)), []
    for t in range(steps):
        y.append(rng.poisson(np.exp(1 + 0.5 * x[0, 0])) if counts else x[0, 0] + 0.2 * rng.normal())
        x = spring.step(x, U[None, t : t + 1], np.array([[0.8, 0.5]])) + [0.0, 0.3 * rng.normal()]
    return {"y": np.array(y, dtype=float), "u": U[:steps]}


DATA = simulated(1)
GAPS = {**DATA, "y": np.where(np.arange(T) % 7 == 3, np.nan, DATA["y"])}
SEVERAL = [DATA, simulated(2, steps=25), GAPS]


@pytest.fixture(scope="module")
def linear():
    return model_of(called, normal)


@pytest.fixture(scope="module")
def exact():
    return model_of(written, normal)


class TestLinear:
    """The extended filter of a linear model is the Kalman filter, up to rounding of differences:
    slopes are good to about 1e-10."""

    @pytest.mark.parametrize("data", [DATA, GAPS, SEVERAL], ids=["whole", "gaps", "several"])
    def test_log_likelihood(self, linear, exact, data):
        found, known = (ssm.log_likelihood(m, data, AT)[0] for m in (linear, exact))
        assert found == pytest.approx(known, abs=1e-7)

    def test_filter(self, linear, exact):
        found, known = (ssm.kalman_filter(m, GAPS, AT) for m in (linear, exact))
        assert found.attrs["approximate"] == 1
        for name in ("q", "v_sd", "covariance", "y_predicted", "log_likelihood_increment"):
            np.testing.assert_allclose(found[name], known[name], atol=1e-7)

    def test_smoother(self, linear, exact):
        found, known = (ssm.smooth(m, GAPS, AT) for m in (linear, exact))
        assert found.attrs["approximate"] == 1
        for name in ("q", "v", "v_sd", "covariance_previous"):
            np.testing.assert_allclose(found[name], known[name], atol=1e-7)

    def test_many_parameter_vectors_at_once(self, linear, exact):
        """Of several data sets of unlike lengths and gaps, one call of the simulator a row."""
        theta = np.array([[0.8, 0.5, 0.3], [2.0, 0.1, 0.1], [0.1, 1.5, 0.9]])
        problem = pose(linear, SEVERAL)
        model = extended_model(problem.trace)
        model.log_likelihoods(problem.experiments, 1.1 * theta)  # its first calls are checked
        calls = spring.moves.calls
        found = model.log_likelihoods(problem.experiments, theta)
        assert spring.moves.calls - calls == T - 1
        known = [
            ssm.log_likelihood(exact, SEVERAL, dict(zip(AT, row, strict=True)))[0] for row in theta
        ]
        np.testing.assert_allclose(found, known, atol=1e-7)

    @pytest.mark.parametrize("data", [DATA, GAPS, SEVERAL], ids=["whole", "gaps", "several"])
    def test_predictions_are_those_of_the_kalman_filter(self, linear, exact, data):
        problem = pose(linear, data)
        theta = np.array([[0.8, 0.5, 0.3], [2.0, 0.1, 0.1]])
        model = extended_model(problem.trace)
        rows, found = model.increments_and_predictions(problem.experiments, theta)
        np.testing.assert_array_equal(rows, model.increments(problem.experiments, theta))
        for k, at in enumerate(theta):
            begin = 0
            for e, own in zip(
                problem.experiments, data if data is SEVERAL else [data], strict=True
            ):
                known = ssm.kalman_filter(exact, own, dict(zip(AT, at, strict=True)))
                part, begin = slice(begin, begin + e.steps), begin + T  # all are as long as one
                y, seen = e.y[:, 0], e.seen[:, 0] == 1.0
                error = np.where(seen, y - known["y_predicted"].values.ravel(), 0.0)
                sd = np.where(seen, known["y_predicted_sd"].values.ravel(), 1.0)
                np.testing.assert_allclose(found.error[k, part, 0], error, atol=1e-7)
                np.testing.assert_allclose(found.covariance[k, part, 0, 0], sd**2, atol=1e-7)

    def test_score_and_information(self, linear, exact):
        found, known = (ssm.score(m, DATA, AT) for m in (linear, exact))
        scale = np.sqrt(np.diagonal(known.information))
        for name, size in zip(AT, scale, strict=True):
            assert found.gradient[name] == pytest.approx(known.gradient[name], abs=1e-5 * size)
        off = (found.information - known.information).to_numpy() / np.outer(scale, scale)
        assert np.max(np.abs(off)) < 1e-4
        assert found.attrs["method"].startswith("approximate")

    def test_maximum(self, linear, exact):
        found, known = (ssm.maximize(m, DATA, seed=1, progress=False) for m in (linear, exact))
        for name, value in known.parameters.items():
            error = known.standard_errors[name]
            assert found.parameters[name] == pytest.approx(value, abs=1e-3 * error)
            assert found.standard_errors[name] == pytest.approx(error, rel=1e-3)
        assert found.attrs["converged"]
        assert "approximate" in str(found)

    def test_particles_are_unbiased(self, linear, exact):
        """The mean of exp(log Z - log p) is 1 within four of its standard errors."""
        short = {k: v[:12] for k, v in DATA.items()}
        options = {"proposal": "bootstrap", "particles": 200, "repeats": 200, "seed": 2}
        log_z = ssm.log_likelihood(linear, short, AT, **options)
        ratio = np.exp(log_z - ssm.log_likelihood(exact, short, AT)[0])
        assert abs(ratio.mean() - 1.0) < 4.0 * ratio.std() / np.sqrt(len(ratio))
        # and those of the model written out, draw for draw
        np.testing.assert_allclose(
            log_z, ssm.log_likelihood(exact, short, AT, **options), rtol=1e-9
        )

    def test_posterior_against_a_grid(self, exact):
        """Of two parameters; the draws' mean and sd within four Monte Carlo errors."""
        priors = {
            "k": ssm.HalfNormal(sd=2),
            "c": ssm.Exponential(rate=1),
            "s": ssm.HalfNormal(sd=1),
        }
        linear = model_of(called, normal, priors=priors)
        idata = ssm.sample(linear, DATA, fixed={"s": 0.3}, draws=1000, warmup=100, chains=2, seed=4,
                           progress=False)  # fmt: skip
        assert idata["posterior"].attrs["approximate"] == 1
        k, c = (g.ravel() for g in np.meshgrid(np.linspace(0.2, 1.6, 57), np.linspace(0, 1.6, 57)))
        problem = pose(linear, DATA)
        theta = np.stack([k, np.maximum(c, 1e-6), np.full(k.shape, 0.3)], axis=1)
        log_p = extended_model(problem.trace).log_likelihoods(problem.experiments, theta)
        log_p -= k**2 / 8.0 + c
        w = np.exp(log_p - log_p.max())
        w /= w.sum()
        edge = (np.abs(k - 0.9) > 0.69) | (c > 1.57)
        assert w[edge].sum() < 1e-3
        for name, grid in (("k", k), ("c", c)):
            draws = idata["posterior"][name].values
            mean, sd = w @ grid, np.sqrt(w @ grid**2 - (w @ grid) ** 2)
            ess = draws.size / 6.0  # acceptance is above a half
            assert abs(draws.mean() - mean) < 4.0 * sd / np.sqrt(ess)
            assert abs(draws.std() / sd - 1.0) < 4.0 / np.sqrt(2.0 * ess)
        smoothed = ssm.smooth(exact, DATA, {"k": w @ k, "c": w @ c, "s": 0.3})
        path = idata["posterior"]["q"].mean(("chain", "draw"))
        assert np.max(np.abs(path - smoothed["q"][0]) / smoothed["q_sd"][0]) < 0.5


@pytest.mark.parametrize(
    ("observe", "kind"),
    [(counts, "counts"), (heavy, "plain"), (sensed, "plain")],
    ids=["Poisson", "StudentT", "output"],
)
def test_observations_of_other_kinds(observe, kind):
    """The extended filter's update is the mode of each row, as of the model written out."""
    data = simulated(3, counts=kind == "counts")
    ours = model_of(called, observe, dirac=False)
    theirs = model_of(written, normal if observe is sensed else observe, dirac=False)
    known = ssm.log_likelihood(theirs, data, AT, proposal="extended")[0]
    assert ssm.log_likelihood(ours, data, AT)[0] == pytest.approx(known, abs=1e-6)
    problem = pose(ours, data)
    theta = np.tile(list(AT.values()), (3, 1))
    found = extended_model(problem.trace).log_likelihoods(problem.experiments, theta)
    # Newton's steps end where they gain less than 0.05 nats a row: both at the same place
    np.testing.assert_allclose(found, known, atol=1e-6)


@pytest.mark.parametrize("observe", [counts, heavy])
def test_what_is_not_gaussian_has_no_gaussian_predictions(observe):
    data = simulated(3, counts=observe is counts)
    problem = pose(model_of(called, observe), data)
    model = extended_model(problem.trace)
    rows, predictions = model.increments_and_predictions(
        problem.experiments, np.array([[0.8, 0.5, 0.3]])
    )
    assert predictions is None
    assert np.isfinite(rows).all()


def late(step):
    """The spring, pushed two rows late and through a lag: states that the inputs determine, and two
    that look determined and are not: what another one was, and what it is from the start."""
    model = ssm.Model("late spring", inputs=("u",))

    @model.prior
    def prior():
        return {
            "k": ssm.HalfNormal(sd=2), "c": ssm.HalfNormal(sd=2), "s": ssm.HalfNormal(sd=1)
        }  # fmt: skip

    @model.initial
    def initial():
        return {
            "a": ssm.Dirac(0.0), "q": ssm.Normal(0, sd=0.5), "b": ssm.Dirac(0.0),
            "lag": ssm.Dirac(0.1), "v": ssm.Normal(0, sd=0.5), "was": ssm.Dirac(0.0),
            "off": ssm.Normal(0, sd=0.2),
        }  # fmt: skip

    @model.transition
    def transition(a, b, lag, q, v, off, u, k, c, s):
        new = step(q, v, 0.5 * b + 0.5 * lag, k, c)
        return {
            "a": ssm.Dirac(u), "b": ssm.Dirac(a), "lag": ssm.Dirac(0.6 * lag + 0.4 * c * u),
            "q": ssm.Dirac(new["q"]), "v": ssm.Normal(new["v"], sd=s), "was": ssm.Dirac(q),
            "off": ssm.Dirac(off),
        }  # fmt: skip

    @model.observation
    def observation(q, was, lag, off):
        return {"y": ssm.Normal(q + 0.3 * was + 0.1 * lag + off, sd=0.2)}

    return model


class TestStatesThatTheInputsDetermine:
    """Lines of delays, and lags, of inputs have no covariance; the filter is the same."""

    def test_increments_and_predictions(self):
        ours, exact = late(called), late(written)
        problem = pose(ours, GAPS)
        model = extended_model(problem.trace)
        theta = np.array([[0.8, 0.5, 0.3], [2.0, 0.1, 0.1]])
        rows, found = model.increments_and_predictions(problem.experiments, theta)
        names = [s.data[1] for s in problem.trace.state_symbols]
        kept = [names[k] for k in model._filter(problem.experiments).own]
        assert sorted(kept) == ["off", "q", "v", "was"]
        for k, at in enumerate(theta):
            known = ssm.kalman_filter(exact, GAPS, dict(zip(AT, at, strict=True)))
            np.testing.assert_allclose(
                rows[k], known["log_likelihood_increment"].values.ravel(), atol=1e-7
            )
            seen = np.isfinite(GAPS["y"])
            error = (GAPS["y"] - known["y_predicted"].values.ravel())[seen]
            np.testing.assert_allclose(found.error[k, seen, 0], error, atol=1e-7)

    def test_trajectories(self):
        """Of each lane the determined ones are what they are, and the others have the moments of
        the smoother."""
        ours, exact = late(called), late(written)
        problem = pose(ours, GAPS)
        model = extended_model(problem.trace)
        theta = np.repeat([[0.8, 0.5, 0.3]], 400, axis=0)
        (e,) = problem.experiments
        drawn = model.trajectories(e, theta, np.random.default_rng(3))
        known = ssm.smooth(exact, GAPS, AT)
        for k, s in enumerate(problem.trace.state_symbols):
            name = s.data[1]
            mean, sd = known[name].values.ravel(), known[f"{name}_sd"].values.ravel()
            assert np.all(np.abs(drawn[:, :, k].mean(axis=0) - mean) <= 5.0 * sd / 20.0 + 1e-6)
            spread = drawn[:, :, k].std(axis=0)
            np.testing.assert_allclose(spread, sd, rtol=0.25, atol=1e-6)


def test_a_lane_that_comes_to_no_number_leaves_the_others_alone(linear):
    problem = pose(linear, DATA)
    model = extended_model(problem.trace)
    theta = np.array([[0.8, 0.5, 0.3], [1e200, 0.5, 0.3], [0.8, 0.5, 0.3]])
    found = model.log_likelihoods(problem.experiments, theta)
    assert found[1] == -np.inf
    assert found[0] == found[2] == pytest.approx(ssm.log_likelihood(linear, DATA, AT)[0], abs=1e-7)


def test_gradient_by_differences_of_the_compiled_filter(linear):
    problem = pose(linear, DATA)
    model = extended_model(problem.trace)
    theta = np.array(list(AT.values()))
    value, gradient = model.score(problem.experiments, theta)
    known, error = jacobian(
        lambda v: np.array([model.log_likelihood(problem.experiments, v)]), theta, 0.05 * theta
    )
    assert value == pytest.approx(model.log_likelihood(problem.experiments, theta), abs=1e-8)
    assert np.all(np.abs(gradient - known[0]) < 1e-4 + 10 * error[0])


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda m: ssm.sample(m, DATA, ssm.Gibbs(), progress=False), "Gibbs draws the states"),
        (
            lambda m: ssm.maximize(m, DATA, ssm.EM(), progress=False),
            "EM needs the exact distribution",
        ),
    ],
)
def test_what_needs_exact_laws_is_refused(linear, call, words):
    with pytest.raises(ssm.ArgumentError, match=words):
        call(linear)
