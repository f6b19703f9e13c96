"""What the user's functions become: names bound to symbols, sites in order, places remembered."""

import inspect

import numpy as np
import pytest

from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import symbol, symbols_of
from ssmppl.language import distributions as ssm
from ssmppl.language.model.model import Model, location_of
from ssmppl.language.model.trace import previous, seen
from ssmppl.language.tracing import trace


def names(symbols):
    return [str(s) for s in symbols]


def mean_of(site):
    return site.distribution.mean_.ravel()


def line_of(function, marker):
    """Line number, in this file, of the marker within a function."""
    lines, first = inspect.getsourcelines(function)
    return first + next(i for i, text in enumerate(lines) if f"# {marker}" in text)


def varves():
    model = Model("ice varves")

    @model.prior
    def prior():
        return {"phi": ssm.Uniform(-1, 1), "tau": ssm.Gamma(0.01, rate=0.01)}

    @model.initial
    def initial(phi, tau):
        return {"x": ssm.Normal(0, precision=(1 - phi**2) * tau)}

    @model.transition
    def transition(x, phi, tau):
        drift = phi * x  # drift
        return {"x": ssm.Normal(drift, precision=tau)}  # law

    @model.observation
    def observation(x):
        return {"y": ssm.Gamma(6.25, rate=0.256 * np.exp(-x))}

    return model


def local_level(**laws):
    """A random walk observed with noise; any of its functions replaced."""
    model = Model("local level", inputs=laws.pop("inputs", ()))
    standard = {
        "prior": lambda: {"q": ssm.Gamma(2, rate=1)},
        "initial": lambda: {"x": ssm.Normal(0, sd=1)},
        "transition": lambda x, q: {"x": ssm.Normal(x, variance=q)},
        "observation": lambda x: {"y": ssm.Normal(x, sd=1)},
    }
    for role, law in (standard | laws).items():
        for function in law if isinstance(law, list) else [law]:
            getattr(model, role)(function)
    return trace(model)


def test_arguments_bind_by_name_to_symbols():
    t = trace(varves())
    assert names(t.parameter_symbols) == ["phi", "tau"]
    assert names(t.state_symbols) == ["x"]
    assert names(t.state_prev_symbols) == ["x_prev"]
    assert names(t.observation_symbols) == ["y"]
    phi, x = symbol("parameter", "phi"), symbol("state_prev", "x")
    assert mean_of(t.transition["x"])[0] is phi * x
    assert symbols_of(t.observations["y"].distribution.rate.ravel()) == {symbol("state", "x")}


def test_order_of_arguments_does_not_matter():
    a = local_level(transition=lambda q, x: {"x": ssm.Normal(x, variance=q)})
    b = local_level(transition=lambda x, q: {"x": ssm.Normal(x, variance=q)})
    assert mean_of(a.transition["x"])[0] is mean_of(b.transition["x"])[0]


def test_kinds_of_arguments():
    def transition(x, /, q, *, t):
        return {"x": ssm.Normal(x + t, variance=q)}

    t = local_level(transition=transition)
    kinds = {s.data[0] for s in symbols_of(mean_of(t.transition["x"]))}
    assert kinds == {"state_prev", "time_prev"}


def test_defaults_are_constants_unless_the_model_knows_the_name():
    def transition(x, q=3.0, step=0.5):
        return {"x": ssm.Normal(x + step, variance=q)}

    law = local_level(transition=transition).transition["x"].distribution
    assert symbols_of(law.parameters["variance"].ravel()) == {symbol("parameter", "q")}
    assert evaluate(law.mean_[()], {symbol("state_prev", "x"): 1.0}) == 1.5


def test_vectors_and_matrices():
    def prior():
        return {
            "A": ssm.Normal(np.zeros((2, 2)), sd=1),
            "Q": ssm.InverseWishart(4, scale=np.eye(2)),
            "r": ssm.HalfNormal(sd=np.ones(2)),
        }

    t = local_level(
        prior=prior,
        initial=lambda Q: {"x": ssm.MvNormal(np.zeros(2), covariance=Q)},
        transition=lambda x, A, Q: {"x": ssm.MvNormal(A @ x, covariance=Q)},
        observation=lambda x, r: {"y": ssm.Normal(x, sd=r), "s": ssm.Normal(x.sum(), sd=1)},
    )
    assert names(t.parameter_symbols) == [
        "A[0, 0]", "A[0, 1]", "A[1, 0]", "A[1, 1]", "Q[0, 0]", "Q[1, 0]", "Q[1, 1]", "r[0]", "r[1]",
    ]  # fmt: skip
    assert names(t.state_symbols) == ["x[0]", "x[1]"]
    assert names(t.observation_symbols) == ["y[0]", "y[1]", "s"]
    assert t.parameters["Q"].value[0, 1] is t.parameters["Q"].value[1, 0]
    a, x = np.array([[0.5, 0.2], [-0.1, 0.9]]), np.array([1.0, 2.0])
    values = dict(zip(t.parameters["A"].value.ravel(), a.ravel(), strict=True))
    values |= dict(zip(t.state_prev_symbols, x, strict=True))
    assert np.allclose(evaluate(t.transition["x"].distribution.mean_, values), a @ x)


def test_a_symmetric_state_keeps_its_symbols_in_a_dirac_transition():
    t = local_level(
        initial=lambda: {"x": ssm.Normal(0, sd=1), "S": ssm.Wishart(3, scale=np.eye(2))},
        transition=lambda x, S, q: {"x": ssm.Normal(x, variance=S[0, 0] * q), "S": ssm.Dirac(S)},
    )
    assert t.transition["S"].components == t.initial["S"].components
    assert names(t.state_symbols) == ["x", "S[0, 0]", "S[1, 0]", "S[1, 1]"]


def test_hierarchies_take_parameters_declared_earlier():
    t = local_level(
        prior=[
            lambda: {"m": ssm.Normal(0, sd=1), "s": ssm.HalfNormal(sd=1)},
            lambda m, s: {"q": ssm.LogNormal(m, sd=s)},
        ]
    )
    assert list(t.parameters) == ["m", "s", "q"]
    assert symbols_of(t.parameters["q"].distribution.parameters["mean_"].ravel()) == {
        symbol("parameter", "m")
    }


def test_several_functions_give_some_of_the_states_and_channels_each():
    t = local_level(
        initial=lambda: {"p": ssm.Normal(0, sd=1), "v": ssm.Normal(0, sd=1)},
        transition=[
            lambda v, q: {"v": ssm.Normal(v, variance=q)},
            lambda p, v: {"p": ssm.Dirac(p + 0.1 * v)},
        ],
        observation=[
            lambda p: {"gps": ssm.Normal(p, sd=1)},
            lambda v: {"speed": ssm.StudentT(4, v, scale=1)},
        ],
    )
    assert list(t.transition) == ["p", "v"]  # the order of the initial law
    assert list(t.observations) == ["gps", "speed"]


def test_time_is_that_of_the_step():
    t = local_level(
        initial=lambda t: {"x": ssm.Normal(t, sd=1)},
        transition=lambda x, q, t: {"x": ssm.Normal(x + t, variance=q)},
        observation=lambda x, t: {"y": ssm.Normal(x + t, sd=1)},
    )
    time, before = symbol("time", "t"), symbol("time_prev", "t")
    assert time in symbols_of(mean_of(t.initial["x"]))
    assert before in symbols_of(mean_of(t.transition["x"]))
    assert time in symbols_of(mean_of(t.observations["y"]))


def test_inputs_act_in_the_step_from_t_and_in_y_t():
    t = local_level(
        inputs={"u": None, "w": 3},
        initial=lambda u: {"x": ssm.Normal(u, sd=1)},
        transition=lambda x, q, u, w: {"x": ssm.Normal(x + u + w @ np.arange(3.0), variance=q)},
        observation=lambda x, w: {"y": ssm.Normal(x + w[1], sd=1)},
    )
    assert names(t.input_symbols) == ["u", "w[0]", "w[1]", "w[2]"]
    assert t.inputs == {"u": (), "w": (3,)}
    kinds = {s.data[0] for s in symbols_of(mean_of(t.transition["x"]))}
    assert kinds == {"state_prev", "input_prev"}
    assert symbol("input", "w", (1,)) in symbols_of(mean_of(t.observations["y"]))
    assert symbol("input", "u") in symbols_of(mean_of(t.initial["x"]))


def test_a_transition_may_name_an_observation():
    t = local_level(transition=lambda x, q, y: {"x": ssm.Normal(x + 0.1 * y, variance=q)})
    assert symbol("observation_prev", "y") in symbols_of(mean_of(t.transition["x"]))


def test_a_proposal_sees_the_observation_to_come():
    t = local_level(proposal=lambda x, y, q: {"x": ssm.Normal(0.5 * (x + y), variance=q)})
    kinds = {s.data[0] for s in symbols_of(mean_of(t.proposal["x"]))}
    assert kinds == {"state_prev", "observation"}


def test_companions_of_symbols():
    y = symbol("observation", "y", (1,))
    assert previous(symbol("state", "x")) is symbol("state_prev", "x")
    assert seen(y) is symbol("seen", "y", (1,))


# -- where functions come from
def test_closures_methods_and_lambdas():
    class Laws:
        gain = 2.0

        def transition(self, x, q):
            return {"x": ssm.Normal(self.gain * x, variance=q)}

    def observer(scale):
        def observation(x):
            return {"y": ssm.Normal(scale * x, sd=1)}

        return observation

    t = local_level(transition=Laws().transition, observation=observer(3.0))
    x = symbol("state", "x")
    assert mean_of(t.transition["x"])[0] is 2.0 * previous(x)
    assert mean_of(t.observations["y"])[0] is 3.0 * x


def test_functions_defined_in_a_loop_keep_their_own_constants():
    channels = []
    for k in range(3):

        def observation(x, gain=float(k + 1), name=f"y{k}"):
            return {name: ssm.Normal(gain * x, sd=1)}

        channels.append(observation)
    t = local_level(observation=channels)
    x = symbol("state", "x")
    assert list(t.observations) == ["y0", "y1", "y2"]
    for site, expected in zip(t.observations.values(), [x, 2.0 * x, 3.0 * x], strict=True):
        assert mean_of(site)[0] is expected


@pytest.mark.parametrize(
    ("law", "meaning"),
    [
        (lambda x: np.where(x > 0, x, 0.1 * x), lambda x: x if x > 0 else 0.1 * x),
        (lambda x: np.exp(x) / (1 + np.exp(x)), lambda x: np.exp(x) / (1 + np.exp(x))),
        (lambda x: sum(x**k for k in range(1, 4)), lambda x: x + x**2 + x**3),
        (lambda x: np.stack([x, 1.0]) @ np.array([2.0, 3.0]), lambda x: 2 * x + 3),
        (lambda x: np.array([x, x**2])[1], lambda x: x**2),
        (lambda x: np.clip(x, -1, 1), lambda x: np.clip(x, -1, 1)),
        (lambda x: np.linalg.solve(np.block([[2, x], [0, 1]]), np.ones(2))[0],
         lambda x: (1 - x) / 2),
    ],
)  # fmt: skip
@pytest.mark.parametrize("value", [-0.7, 0.3])
def test_plain_numpy_inside(law, meaning, value):
    t = local_level(observation=lambda x: {"y": ssm.Normal(law(x), sd=1)})
    mean = mean_of(t.observations["y"])[0]
    assert evaluate(mean, {symbol("state", "x"): value}) == pytest.approx(meaning(value))


# -- remembering
def test_traces_are_kept_until_the_model_changes():
    model = varves()
    first = trace(model)
    assert trace(model) is first

    @model.observation
    def second(x):
        return {"z": ssm.Normal(x, sd=1)}

    assert list(trace(model).observations) == ["y", "z"]
    assert list(first.observations) == ["y"]


def test_a_changed_constant_outside_of_the_function_is_noticed():
    gain = np.ones(2)
    model = Model()
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x: {"x": ssm.Normal(gain.sum() * x, sd=1)})
    assert evaluate(mean_of(trace(model).transition["x"])[0], {symbol("state_prev", "x"): 1.0}) == 2
    gain[:] = 5.0
    assert (
        evaluate(mean_of(trace(model).transition["x"])[0], {symbol("state_prev", "x"): 1.0}) == 10
    )


def test_places_point_at_the_users_lines():
    model = varves()
    t = trace(model)
    site = t.transition["x"]
    assert site.where.function == "transition"
    assert site.where.line == line_of(varves, "drift") - 1  # the def, not its decorator
    assert site.where.file == __file__
    assert site.distribution.location.line == line_of(varves, "law")
    drift = symbol("parameter", "phi") * symbol("state_prev", "x")
    assert t.locations[drift].line == line_of(varves, "drift")
    assert t.functions["transition"] == [site.where]
    assert location_of(model.functions["transition"][0]) == site.where
    assert "precision=tau" in site.distribution.location.text
