"""Every rule of the language, broken on purpose: the error names the place, the find and the fix.

A bad model is a function that declares one; the line at fault is marked `# HERE`, and the error
must name this file and that line. Bad data and bad parameters are given to two good models.
"""

import inspect
import math
import pickle
import random
import statistics
import sys
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import scipy.linalg
import scipy.special
import xarray as xr
from scipy import stats

from ssmppl.data import bind, bind_inputs, check_parameters, check_values
from ssmppl.errors import (
    ArgumentError,
    DataError,
    Location,
    ModelError,
    SSMError,
    UnsupportedOperation,
)
from ssmppl.language import distributions as ssm
from ssmppl.language.model.model import Model
from ssmppl.language.tracing import trace

GOOD = {
    "prior": lambda: {"phi": ssm.Uniform(-1, 1), "q": ssm.Gamma(2, rate=1)},
    "initial": lambda q: {"x": ssm.Normal(0, variance=q)},
    "transition": lambda x, phi, q: {"x": ssm.Normal(phi * x, variance=q)},
    "observation": lambda x: {"y": ssm.Normal(x, sd=1)},
}
BAD_MODELS = []  # (builder, class, fragments)


def bad(*fragments, error=ModelError):
    def register(builder):
        BAD_MODELS.append((builder, error, fragments))
        return builder

    return register


def declare(inputs=(), without=(), **laws):
    """A model with the laws of GOOD, save those replaced or left out; several in a list."""
    model = Model("bad", inputs=inputs)
    for role, law in (GOOD | laws).items():
        if role not in without:
            for function in law if isinstance(law, list) else [law]:
                getattr(model, role)(function)
    return model


# -- what a model consists of
@bad("'bad model'", "no @transition", "x_{t+1}", "@model.transition")
def no_transition():
    model = Model("bad model")  # HERE
    model.initial(GOOD["initial"])
    return model


@bad("no @initial", "x_1")
def no_initial():
    model = Model("bad")  # HERE
    model.transition(GOOD["transition"])
    return model


@bad("the name of a model is 3", 'ssm.Model("ice varves")')
def name_is_no_string():
    return Model(3)  # HERE


@bad("inputs is the string 'torque'", "inputs=('torque',)")
def inputs_is_a_string():
    return Model("m", inputs="torque")  # HERE


@bad("inputs is 3", "tuple of names")
def inputs_is_a_number():
    return Model("m", inputs=3)  # HERE


@bad("input 'w' of length 0", "positive whole number", "None stands for a number")
def input_of_no_length():
    return Model("m", inputs={"w": 0})  # HERE


@bad("a name twice", "'u', 'u'")
def input_twice():
    return Model("m", inputs=("u", "u"))  # HERE


@bad("decorates 3", "not a function", "without parentheses")
def decorator_on_a_number():
    model = Model("m")
    model.prior(3)  # HERE


@bad("called without a function", "without parentheses")
def decorator_with_parentheses():
    model = Model("m")

    @model.prior()  # HERE
    def prior():
        return {}


@bad("'x' is given by two @initial functions; the other is at", "give each quantity one")
def second_initial():
    def again():  # HERE
        return {"x": ssm.Normal(0, sd=1)}

    return declare(initial=[GOOD["initial"], again])


# -- arguments
@bad("asks for 'phy', which the model does not know", "use one of: phi, ")
def misspelled_argument():
    def transition(x, phy, q):  # HERE
        return {"x": ssm.Normal(phy * x, variance=q)}

    return declare(transition=transition)


@bad("takes *parameters", "bound by name")
def star_arguments():
    def transition(x, **parameters):  # HERE
        return {"x": ssm.Normal(x, sd=1)}

    return declare(transition=transition)


@bad("asks for 'x'", "declared by a @prior, a state by @initial")
def initial_names_its_state():
    def initial(x):  # HERE
        return {"x": ssm.Normal(x, sd=1)}

    return declare(initial=initial)


@bad("asks for 'tau'", "use one of: phi", "declare it in an earlier @prior")
def prior_names_a_later_parameter():
    def hyper(phi, tau):  # HERE
        return {"m": ssm.Normal(phi, sd=tau)}

    return declare(prior=[GOOD["prior"], hyper, lambda: {"tau": ssm.HalfNormal(sd=1)}])


@bad("'u' is an input", "a prior depends on parameters declared earlier only")
def prior_names_an_input():
    def prior(u):  # HERE
        return {"phi": ssm.Normal(u, sd=1), "q": ssm.HalfNormal(sd=1)}

    return declare(prior=prior, inputs=("u",))


@bad("a prior does not depend on time")
def prior_names_time():
    def prior(t):  # HERE
        return {"phi": ssm.Normal(t, sd=1), "q": ssm.HalfNormal(sd=1)}

    return declare(prior=prior)


@bad("an observation cannot depend on an observation of the same time")
def observation_names_an_observation():
    def second(x, y):  # HERE
        return {"z": ssm.Normal(x + y, sd=1)}

    return declare(observation=[GOOD["observation"], second])


@bad("NameError", "name 'phi' is not defined", "add 'phi', a parameter of the model")
def forgotten_argument():
    def transition(x, q):
        return {"x": ssm.Normal(phi * x, variance=q)}  # HERE # noqa: F821

    return declare(transition=transition)


@bad("reads the Python variable 'phi', while 'phi' is a parameter", "add 'phi' to the arguments")
def a_variable_of_the_same_name():
    phi = 0.9

    def transition(x, q):
        mean = phi * x  # HERE
        return {"x": ssm.Normal(mean, variance=q)}

    return declare(transition=transition)


@bad("drift(), which @transition calls, reads the Python variable 'phi'", "arguments of drift")
def a_variable_of_the_same_name_in_a_function_that_the_law_calls():
    phi = 0.9

    def drift(x):
        return phi * x  # HERE

    def transition(x, q):
        return {"x": ssm.Normal(drift(x), variance=q)}

    return declare(transition=transition)


# -- what a law returns
@bad("returned nothing", 'return a dictionary {"name": distribution}')
def returns_nothing():
    def transition(x):
        ssm.Normal(x, sd=1)  # HERE

    return declare(transition=transition)


@bad("returned Normal(", 'return a dictionary {"name": distribution}')
def returns_a_bare_distribution():
    def transition(x):
        y = 2 * x
        return ssm.Normal(y, sd=1)  # HERE

    return declare(transition=transition)


@bad("'x' is 0.5*x_prev, which is no distribution", "ssm.Dirac(...) if 'x' is deterministic")
def returns_an_expression():
    def transition(x):
        return {"x": 0.5 * x}  # HERE

    return declare(transition=transition)


@bad("the class Normal", "call it with its parameters")
def returns_a_class():
    def observation(x):
        return {"y": ssm.Normal}  # HERE

    return declare(observation=observation)


@bad("'my y'", "letters, digits and underscores")
def name_with_a_blank():
    def observation(x):
        return {"my y": ssm.Normal(x, sd=1)}  # HERE

    return declare(observation=observation)


@bad("'lambda'", "no keyword")
def name_is_a_keyword():
    def prior():
        return {"lambda": ssm.Normal(0, sd=1)}  # HERE

    return declare(prior=prior)


@bad("named 't', which means the row number", "'t_'")
def name_is_t():
    def prior():
        return {"t": ssm.Normal(0, sd=1)}  # HERE

    return declare(prior=prior)


@bad("'x_dim_0', which is in results a dimension of the state 'x'", "'x_0_dim'")
def name_of_a_dimension_of_a_vector():
    def prior():
        return {"x_dim_0": ssm.Normal(0, sd=1)}  # HERE

    def initial():
        return {"x": ssm.Normal(np.zeros(2), sd=1)}

    def transition(x):
        return {"x": ssm.Normal(x, sd=1)}

    def observation(x):
        return {"y": ssm.Normal(x[0], sd=1)}

    return declare(prior=prior, initial=initial, transition=transition, observation=observation)


@bad("named 'draw'", "dimension of draws")
def name_of_a_dimension():
    def observation(x):
        return {"draw": ssm.Normal(x, sd=1)}  # HERE

    return declare(observation=observation)


@bad("'q' is declared as a state and already a parameter", "rename one of them")
def state_named_as_a_parameter():
    def initial():
        return {"x": ssm.Normal(0, sd=1), "q": ssm.Normal(0, sd=1)}  # HERE

    return declare(initial=initial)


@bad("'x' is given by two @transition functions", "one distribution")
def state_with_two_transitions():
    def again(x):  # HERE
        return {"x": ssm.Normal(x, sd=1)}

    return declare(transition=[GOOD["transition"], again])


@bad("state 'v' has an initial distribution but no transition", "the transitions give: x")
def state_without_transition():
    def initial():
        return {
            "x": ssm.Normal(0, sd=1),
            "v": ssm.Normal(0, sd=1),  # HERE
        }

    return declare(initial=initial)


@bad("@transition gives 'v', which has no initial distribution", "@initial gives: x")
def state_without_initial_law():
    def transition(x):
        return {
            "x": ssm.Normal(x, sd=1),
            "v": ssm.Normal(x, sd=1),  # HERE
        }

    return declare(transition=transition)


@bad("shape (2,) in its transition and shape ()", "same shape")
def state_changes_its_shape():
    def transition(x):
        return {"x": ssm.Normal([x, x], sd=1)}  # HERE

    return declare(transition=transition)


@bad("Normal at first and Wishart in its transition", "symmetric matrix")
def state_becomes_symmetric():
    def transition(x):
        return {"x": ssm.Wishart(3, scale=np.eye(2))}  # HERE

    return declare(initial=lambda: {"x": ssm.Normal(np.zeros((2, 2)), sd=1)}, transition=transition)


@bad("shape (0,)", "at least one component")
def nothing_in_it():
    def initial():
        return {"x": ssm.Normal(np.zeros(0), sd=1)}  # HERE

    return declare(initial=initial)


# -- which distribution may stand where
@bad("the prior of 'phi' is Dirac", "fixed={'phi': value}")
def dirac_prior():
    def prior():
        return {"phi": ssm.Dirac(0.5)}  # HERE

    return declare(prior=prior)


@bad("the prior of 'k' is Poisson", "parameters are continuous")
def discrete_prior():
    def prior():
        return {"k": ssm.Poisson(3)}  # HERE

    return declare(prior=prior)


@bad("the distribution of 'x' is Flat, which is improper", "as a prior")
def flat_state():
    def transition(x):
        return {"x": ssm.Flat()}  # HERE

    return declare(transition=transition)


@bad("the distribution of 'x' is HalfFlat, which is improper", "as a prior")
def half_flat_start():
    def initial():
        return {"x": ssm.HalfFlat()}  # HERE

    return declare(initial=initial)


@bad("@proposal gives no distribution for the state 'v'", "it gives: x")
def proposal_for_one_state_only():
    def proposal(x):  # HERE
        return {"x": ssm.Normal(x, sd=1)}

    return declare(
        initial=lambda: {"x": ssm.Normal(0, sd=1), "v": ssm.Normal(0, sd=1)},
        transition=lambda x, v: {"x": ssm.Normal(x, sd=1), "v": ssm.Normal(v, sd=1)},
        proposal=proposal,
    )


@bad("the transition of 'x' is Normal, its proposal Poisson", "support of the transition")
def proposal_elsewhere():
    def proposal(x):
        return {"x": ssm.Poisson(3)}  # HERE

    return declare(proposal=proposal)


# -- the spread is always named
@bad("Normal takes its spread by name", "sd=, variance= or precision=")
def spread_without_name():
    def transition(x):
        return {"x": ssm.Normal(x, 1)}  # HERE

    return declare(transition=transition)


@bad("exactly one of sd=, variance=, precision=; found sd=, precision=")
def two_spreads():
    def transition(x):
        return {"x": ssm.Normal(x, sd=1, precision=1)}  # HERE

    return declare(transition=transition)


@bad("exactly one of", "found none of them", "Normal(..., sd=1.0)")
def no_spread():
    def transition(x):
        return {"x": ssm.Normal(x)}  # HERE

    return declare(transition=transition)


@bad("'sigma'", "write sd=")
def unknown_spread():
    def transition(x):
        return {"x": ssm.Normal(x, sigma=1)}  # HERE

    return declare(transition=transition)


@bad("sd = -1 is outside", "inside that range")
def negative_spread():
    def transition(x):
        return {"x": ssm.Normal(x, sd=-1)}  # HERE

    return declare(transition=transition)


@bad("shapes do not agree", "one shape")
def shapes_do_not_agree():
    def initial():
        return {"x": ssm.Normal(np.zeros(2), sd=np.ones(3))}  # HERE

    return declare(initial=initial)


@bad("covariance is not positive definite", "exactly zero is ssm.Dirac")
def indefinite_covariance():
    def initial():
        return {"x": ssm.MvNormal(np.zeros(2), covariance=[[1.0, 2.0], [2.0, 1.0]])}  # HERE

    return declare(initial=initial)


@bad("the covariance of 'y' in @observation is singular", "only states may be without noise")
def singular_covariance():
    def observation(x):
        return {"y": ssm.MvNormal([x, x], covariance=np.ones((2, 2)))}  # HERE

    return declare(observation=observation)


@bad("'1'", "no number or symbol")
def text_as_parameter():
    def transition(x):
        return {"x": ssm.Normal(x, sd="1")}  # HERE

    return declare(transition=transition)


@bad("cannot truncate MvNormal", "scalar distribution")
def truncated_vector():
    def initial():
        law = ssm.MvNormal(np.zeros(2), covariance=np.eye(2))
        return {"x": ssm.Truncated(law, lower=0)}  # HERE

    return declare(initial=initial)


@bad("nan", "x")
def mean_is_nan():
    def transition(x):
        return {"x": ssm.Normal(x + np.nan, sd=1)}  # HERE

    return declare(transition=transition)


# -- one particle and one time step, in Python and NumPy
@bad("a Python `if`", "np.where(condition, a, b)", error=UnsupportedOperation)
def python_if():
    def transition(x):
        if x > 0:  # HERE
            x = 0.5 * x
        return {"x": ssm.Normal(x, sd=1)}

    return declare(transition=transition)


@bad("math.*", "np.exp", error=UnsupportedOperation)
def math_instead_of_numpy():
    def transition(x):
        return {"x": ssm.Normal(math.sin(x), sd=1)}  # HERE

    return declare(transition=transition)


@bad("a number was asked of a symbol", "np.stack([...])", error=UnsupportedOperation)
def assignment_into_zeros():
    def transition(x):
        mean = np.zeros(2)
        mean[0] = x  # HERE
        return {"x": ssm.Normal(mean[0], sd=1)}

    return declare(transition=transition)


@bad("asked of a symbol", error=UnsupportedOperation)
def loop_over_a_symbol():
    def transition(x):
        total = sum(k for k in range(x))  # HERE
        return {"x": ssm.Normal(total, sd=1)}

    return declare(transition=transition)


@bad("cdf() of a library takes numbers", "scipy.special.ndtr(z)", error=UnsupportedOperation)
def distribution_function_of_scipy():
    def transition(x):
        return {"x": ssm.Normal(stats.norm.cdf(x), sd=1)}  # HERE

    return declare(transition=transition)


@bad("logsumexp() of a library takes numbers", "np.logaddexp(a, b)")
def sum_of_exponentials_of_scipy():
    def transition(x):
        return {"x": ssm.Normal(scipy.special.logsumexp([x, 1.0]), sd=1)}  # HERE

    return declare(transition=transition)


@bad("np.round", "np.floor(x + 0.5)", error=UnsupportedOperation)
def rounding_by_numpy():
    def transition(x):
        return {"x": ssm.Normal(np.round(x), sd=1)}  # HERE

    return declare(transition=transition)


@bad("np.sort", "np.minimum and np.maximum", error=UnsupportedOperation)
def function_without_meaning():
    def transition(x):
        return {"x": ssm.Normal(np.sort(np.stack([x, x]))[0], sd=1)}  # HERE

    return declare(transition=transition)


@bad("inside of fmean() of a library", "@ssm.primitive", error=UnsupportedOperation)
def library_on_symbols():
    def transition(x):
        middle = statistics.fmean([x, 1.0])  # HERE
        return {"x": ssm.Normal(middle, sd=1)}

    return declare(transition=transition)


@bad("expm() of a library takes numbers", "closed form", error=UnsupportedOperation)
def scipy_on_symbols():
    def transition(x):
        step = scipy.linalg.expm(np.stack([np.stack([x, 0.0]), np.stack([0.0, x])]))  # HERE
        return {"x": ssm.Normal(step[0, 0], sd=1)}

    return declare(transition=transition)


@bad("np.stack([a, b])", "np.block(")
def object_array():
    def transition(x):
        gain = np.linalg.inv(np.array([[x, 1.0], [0.0, x]]))  # HERE
        return {"x": ssm.Normal(gain[0, 0], sd=1)}

    return declare(transition=transition)


@bad("logaddexp", "np.stack([a, b])")
def function_of_an_object_array():
    def transition(x):
        mean = np.logaddexp(np.array([x, 2 * x]), 0.0)  # HERE
        return {"x": ssm.Normal(mean[0], sd=1)}

    return declare(transition=transition)


@bad("maximum", "np.stack([...]) and not by np.array", error=UnsupportedOperation)
def maximum_of_an_object_array():
    def transition(x):
        mean = np.maximum(np.array([x, 2 * x]), 0.0)  # HERE
        return {"x": ssm.Normal(mean[0], sd=1)}

    return declare(transition=transition)


@bad("IndexError", "np.choose(k, table) is table[k]")
def numbers_indexed_by_a_symbol():
    table = np.array([[0.9, 0.1], [0.2, 0.8]])

    def transition(x):
        return {"x": ssm.Categorical(table[x])}  # HERE

    return declare(initial=lambda: {"x": ssm.Categorical([0.5, 0.5])}, transition=transition)


@bad("a whole number was asked of a symbol", "np.choose(k, table)", error=UnsupportedOperation)
def numbers_taken_by_a_symbol():
    table = np.array([[0.9, 0.1], [0.2, 0.8]])

    def transition(x):
        return {"x": ssm.Categorical(np.take(table, x, axis=0))}  # HERE

    return declare(initial=lambda: {"x": ssm.Categorical([0.5, 0.5])}, transition=transition)


@bad("@ of shapes (2, 2) and (3,)", "inner dimensions", error=UnsupportedOperation)
def shapes_in_a_product():
    def transition(x):
        return {"x": ssm.Normal(np.eye(2) @ x, sd=1)}  # HERE

    return declare(initial=lambda: {"x": ssm.Normal(np.zeros(3), sd=1)}, transition=transition)


@bad("IndexError", "x of shape (2,)")
def index_out_of_range():
    def transition(x):
        return {"x": ssm.Normal([x[0], x[2]], sd=1)}  # HERE

    return declare(initial=lambda: {"x": ssm.Normal(np.zeros(2), sd=1)}, transition=transition)


@bad("another distribution when it is called again", "no random numbers")
def random_numbers_inside():
    def transition(x):
        noise = random.gauss(0, 1)
        return {"x": ssm.Normal(x + noise, sd=1)}  # HERE

    return declare(transition=transition)


@bad("ZeroDivisionError", "runs once on symbols")
def any_other_exception():
    def transition(x):
        step = 1 / 0  # HERE
        return {"x": ssm.Normal(step * x, sd=1)}

    return declare(transition=transition)


@bad("takes an element", "without brackets")
def element_of_a_number():
    def transition(x):
        return {"x": ssm.Normal(x[0], sd=1)}  # HERE

    return declare(transition=transition)


@bad("rounds a symbol", "np.floor(x + 0.5)")
def rounding_by_python():
    def transition(x):
        return {"x": ssm.Normal(round(x), sd=1)}  # HERE

    return declare(transition=transition)


@bad("len() of a symbol", "write 1")
def length_of_a_number():
    def transition(x):
        return {"x": ssm.Normal(len(x), sd=1)}  # HERE

    return declare(transition=transition)


@bad("as through a list", "without a loop")
def sum_over_a_number():
    def transition(x):
        return {"x": ssm.Normal(sum(x), sd=1)}  # HERE

    return declare(transition=transition)


@bad("formats a symbol", "out of the distribution")
def formatted_symbol():
    def transition(x):
        return {"x": ssm.Normal(float(f"{x:.2f}"), sd=1)}  # HERE

    return declare(transition=transition)


@bad("calls a symbol", "x * (...)")
def symbol_called():
    def transition(x):
        return {"x": ssm.Normal(x(2), sd=1)}  # HERE

    return declare(transition=transition)


@bad("by @", "write * for")
def matrix_product_of_numbers():
    def transition(x):
        return {"x": ssm.Normal(x @ x, sd=1)}  # HERE

    return declare(transition=transition)


@bad("divmod() of a symbol", "x // n")
def divmod_of_a_symbol():
    def transition(x):
        return {"x": ssm.Normal(divmod(x, 2)[0], sd=1)}  # HERE

    return declare(transition=transition)


@bad("a symbol and a str", "use numbers")
def symbol_plus_text():
    def transition(x):
        return {"x": ssm.Normal(x + "a", sd=1)}  # HERE

    return declare(transition=transition)


@bad("asks a symbol for 'sum'", "NumPy's functions")
def attribute_of_a_symbol():
    def transition(x):
        return {"x": ssm.Normal(x.sum(), sd=1)}  # HERE

    return declare(transition=transition)


@pytest.mark.parametrize(
    ("builder", "error", "fragments"), BAD_MODELS, ids=[b.__name__ for b, *_ in BAD_MODELS]
)
def test_bad_model(builder, error, fragments):
    lines, first = inspect.getsourcelines(builder)
    marked = [first + i for i, text in enumerate(lines) if "# HERE" in text]
    with pytest.raises(ModelError) as caught:
        trace(builder())
    assert type(caught.value) is error
    text = str(caught.value)
    assert f'File "{__file__}", line {marked[0]}' in text, text
    assert "Fix: " in text
    assert "'Expr'" not in text  # the symbols' class is no word of the language
    for fragment in fragments:
        assert fragment in text, text


@pytest.mark.parametrize("thing", ["model.py", None, GOOD["prior"], Model])
def test_what_is_no_model(thing):
    with pytest.raises(ModelError, match=r"expected a Model.*\n?.*Fix: pass the object made by"):
        trace(thing)


def test_enough_rules_are_broken():
    assert len(BAD_MODELS) >= 30
    assert len(BAD_DATA) >= 20


# -- data
def counts():
    """Scalar channels of several supports, an input, and a transition that names a channel."""
    model = Model("counts", inputs=("u",))
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x, rain, u: {"x": ssm.Normal(x + u + 0.1 * rain, sd=1)})

    @model.observation
    def observation(x, u):
        return {
            "rain": ssm.Gamma(2, rate=np.exp(-x)),
            "n": ssm.Poisson(np.exp(x)),
            "hits": ssm.Binomial(10, 0.5),
            "on": ssm.Bernoulli(0.5),
            "kind": ssm.Categorical(np.full(3, 1 / 3)),
            "share": ssm.Beta(2, 2),
            "angle": ssm.Uniform(0, 2 + u),
        }

    return trace(model)


def vectors():
    """A vector, a composition and a matrix channel, and a vector input."""
    model = Model("vectors", inputs={"w": 2})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x, w: {"x": ssm.Normal(x + w.sum(), sd=1)})
    model.observation(
        lambda x: {
            "y": ssm.MvNormal(np.zeros(2) + x, covariance=np.eye(2)),
            "mix": ssm.Dirichlet(np.ones(3)),
            "S": ssm.Wishart(4, scale=np.eye(2)),
        }
    )
    return trace(model)


MODELS = {"counts": counts(), "vectors": vectors()}
ROWS = 5
GOOD_DATA = {
    "counts": {
        "rain": np.full(ROWS, 0.5),
        "n": np.arange(ROWS),
        "hits": np.arange(ROWS),
        "on": np.array([True, False, True, True, False]),
        "kind": np.array([0, 1, 2, 1, 0]),
        "share": np.full(ROWS, 0.3),
        "angle": np.ones(ROWS),
        "u": np.zeros(ROWS),
    },
    "vectors": {
        "y": np.ones((ROWS, 2)),
        "mix": np.tile([0.2, 0.3, 0.5], (ROWS, 1)),
        "S": np.tile(np.eye(2), (ROWS, 1, 1)),
        "w": np.ones((ROWS, 2)),
    },
}


def counts_with(**changes):
    return GOOD_DATA["counts"] | changes


def vectors_with(**changes):
    return GOOD_DATA["vectors"] | changes


def at(name, row, value, model="counts"):
    """Good data with one entry changed; rows from 1."""
    column = np.array(GOOD_DATA[model][name], dtype=object)
    index = (row,) if isinstance(row, int) else row
    column[(index[0] - 1, *index[1:])] = value
    return GOOD_DATA[model] | {name: column}


def without(name):
    return {k: v for k, v in GOOD_DATA["counts"].items() if k != name}


YEARS = [1990, 1991, 1992, 1993, 1994]


def table(data, **kwargs):
    return pd.DataFrame(data, **kwargs)


BAD_DATA = {
    # what the data are
    "None": ("counts", None, ["data is None", "mapping of arrays"]),
    "path": ("counts", "run.csv", ["the text 'run.csv'", "pd.read_csv('run.csv')"]),
    "model": ("counts", Model("m"), ["the model 'm'", "data second"]),
    "array": ("counts", np.zeros(3), ["of type ndarray", "{'rain': data}"]),
    "Series": ("counts", pd.Series([1.0, 2.0]), ["is a Series, one variable", "{'rain': data}"]),
    "list of numbers": ("counts", [1.0, 2.0], ["of type list", "{'rain': data}"]),
    "number": ("counts", 3, ["data is 3", "pandas DataFrame"]),
    "no data sets": ("counts", [], ["empty list", "at least one data set"]),
    "empty mapping": ("counts", {}, ["holds no variables", "'u'"]),
    "no rows": ("counts", {k: v[:0] for k, v in counts_with().items()}, ["no rows", "one row"]),
    # names
    "misspelled channel": (
        "counts",
        {("Rain" if k == "rain" else k): v for k, v in counts_with().items()},
        ["'rain' is missing", "its variables are: Rain, ", "column of NaN"],
    ),
    "missing channel of a table": (
        "counts", table(without("share")), ["'share' is missing", "its columns are:"],
    ),
    "missing input": ("counts", without("u"), ["an input named 'u' is missing", "rename one"]),
    "missing component": (
        "vectors",
        table({"y_0": np.ones(5), "w_0": np.ones(5), "w_1": np.ones(5)}),
        ["'y_1'", "needed are y_0, y_1"],
    ),
    "column twice": (
        "counts",
        pd.concat([table(counts_with()), table({"n": np.ones(5)})], axis=1),
        ["more than one column named 'n'", "rename or drop"],
    ),
    # shapes and lengths
    "different lengths": (
        "counts", counts_with(n=np.arange(4)), ["'rain' has 5", "'n' has 4", "one row for each"],
    ),
    "input one row short": (
        "counts", counts_with(u=np.zeros(4)), ["'u' has 4", "inputs too, the last row included"],
    ),
    "scalar": ("counts", counts_with(u=3.0), ["'u' is the number 3", "np.full(T, 3)"]),
    "column vector": (
        "counts", counts_with(n=np.ones((5, 1))), ["shape (5, 1)", "data['n'][:, 0]"],
    ),
    "transposed": (
        "vectors", vectors_with(y=np.ones((2, 5))), ["shape (2, 5)", "data['y'].T"],
    ),
    "wrong width": ("vectors", vectors_with(y=np.ones((5, 3))), ["(5, 3)", "(T, 2)"]),
    "matrix as vector": ("vectors", vectors_with(S=np.ones((5, 4))), ["(5, 4)", "(T, 2, 2)"]),
    "ragged": ("vectors", vectors_with(y=[[1, 2], [1]]), ["no rectangular array", "same number"]),
    # values that are no numbers
    "words": (
        "counts", counts_with(rain=["one", "two", "three", "four", "five"]),
        ["'rain', row 1", "the text 'one'", "give numbers, NaN where"],
    ),
    "a decimal comma": (
        "counts", at("rain", 3, "1,5"), ["'rain', row 3", "the text '1,5'", "points"],
    ),
    "a thousand": (
        "counts", at("rain", 3, "1,000"), ["'rain', row 3", "the text '1,000'", "thousands="],
    ),
    "text": (
        "counts", at("rain", 3, "n/a"), ["'rain', row 3", "the text 'n/a'", "pd.to_numeric"],
    ),
    "text in a table": (
        "counts",
        table(counts_with(rain=["1", "2", "3", "4", "5"]), index=YEARS),
        ["'rain', row 1 (index 1990)", "the text '1'", "pd.to_numeric"],
    ),
    "complex": ("counts", counts_with(rain=np.ones(5) * 1j), ["is complex", "two channels"]),
    "dates": (
        "counts", counts_with(u=pd.date_range("2020", periods=5)), ["dates", "convert it"],
    ),
    "an object": ("counts", at("rain", 2, {}), ["row 2", "{} stands where a number"]),
    "too large": ("counts", at("n", 2, 10**400), ["'n', row 2", "too large"]),
    "a set": ("counts", counts_with(n={1, 2}), ["'n' is {1, 2}", "array of numbers"]),
    # missing and infinite
    "NaN in an input": (
        "counts", at("u", 4, np.nan), ["'u', row 4", "the input 'u' is nan", "interpolation"],
    ),
    "infinite input": ("counts", at("u", 1, -np.inf), ["'u', row 1", "-inf"]),
    "None in an input": ("counts", at("u", 4, None), ["'u', row 4", "only observations may be"]),
    "infinite observation": (
        "vectors", at("y", (2, 1), np.inf, "vectors"), ["'y'[1], row 2", "is inf", "write NaN"],
    ),
    "missing where a transition needs it": (
        "counts", at("rain", 2, np.nan), ["'rain', row 2", "the transition of 'x' needs it"],
    ),
    "part of a composition": (
        "vectors", at("mix", (3, 0), np.nan, "vectors"), ["row 3", "Dirichlet has no density"],
    ),
    "part of a matrix": (
        "vectors", at("S", (3, 0, 0), np.nan, "vectors"), ["row 3", "Wishart has no density"],
    ),
    # supports
    "Gamma": ("counts", at("rain", 5, -3.2), ["'rain', row 5", "-3.2", "Gamma, (0, inf)"]),
    "Gamma at zero": ("counts", at("rain", 1, 0.0), ["row 1", "0 is outside", "NaN where"]),
    "Poisson": ("counts", at("n", 2, 2.5), ["'n', row 2", "2.5", "whole numbers from 0"]),
    "negative count": ("counts", at("n", 2, -1), ["-1", "whole numbers from 0"]),
    "Binomial": ("counts", at("hits", 3, 11), ["11", "Binomial", "from 0 to 10"]),
    "Bernoulli": ("counts", at("on", 3, 2), ["2 is outside", "Bernoulli", "from 0 to 1"]),
    "Categorical": ("counts", at("kind", 4, 3), ["3", "Categorical", "from 0 to 2"]),
    "Beta": ("counts", at("share", 1, 1.0), ["1 is outside", "Beta, (0, 1)"]),
    "bound from an input": (
        "counts",
        at("angle", 4, 2.5) | {"u": np.array([1.0, 1, 1, 0, 1])},
        ["'angle', row 4", "2.5 is outside", "[0, 2]"],
    ),
    "shares": (
        "vectors", at("mix", (3, 0), 0.3, "vectors"), ["row 3", "sum to 1.1", "divided by"],
    ),
    "share of zero": ("vectors", at("mix", (2, 1), 0.0, "vectors"), ["'mix'[1], row 2", "(0, 1)"]),
    "not symmetric": ("vectors", at("S", (2, 0, 1), 0.5, "vectors"), ["row 2", "not symmetric"]),
    "not positive definite": (
        "vectors", at("S", (4, 1, 1), -1, "vectors"), ["row 4", "not positive definite", "-1"],
    ),
    # rows and their labels
    "time twice": (
        "counts", table(counts_with(), index=[1, 2, 2, 3, 4]), ["index 2 stands in rows 2 and 3"],
    ),
    "time unsorted": (
        "counts",
        counts_with(time=[0.0, 2.0, 1.0, 3.0, 4.0]),
        ["the time is not increasing: 1.0 in row 3 follows 2.0 in row 2", "sort"],
    ),
    "time missing": ("counts", counts_with(time=[0, 1, np.nan, 3, 4]), ["time is nan in row 3"]),
    "time of another length": ("counts", counts_with(time=[0, 1]), ["'time' has 2", "'rain' has"]),
    "index of two levels": (
        "counts",
        table(counts_with(), index=pd.MultiIndex.from_product([["a"], range(5)])),
        ["several levels", "experiment='id'", "data.index.names"],
    ),
    "Series of other rows": (
        "counts",
        counts_with(n=pd.Series(np.ones(5), YEARS), hits=pd.Series(np.ones(5), range(5, 10))),
        ["'n' and 'hits' label their rows differently (index)", "aligns the rows"],
    ),
    "Dataset without time": (
        "counts",
        xr.Dataset({k: ("step", v) for k, v in counts_with().items()}),
        ["no dimension 'time'", "rename"],
    ),
    "variable of a Dataset without time": (
        "counts",
        xr.Dataset({k: ("step" if k == "n" else "time", v) for k, v in counts_with().items()}),
        ["In data, 'n'", "no dimension 'time'", "are: step", "rename({'step': 'time'})"],
    ),
    "structured array": (
        "counts",
        np.ones(5, dtype=[(k, float) for k in counts_with()]),
        ["structured array with the fields", "pd.DataFrame(data)"],
    ),
    "several draws": (
        "counts",
        xr.Dataset(
            {k: ("time", v) for k, v in without("n").items()}
            | {"n": (("draw", "time"), np.ones((2, 5)))}
        ),
        ["'n' holds 2 series along the dimension 'draw'", "data.isel(draw=0)"],
    ),
    "texts in a list": (
        "counts", counts_with(rain=["3"] * 4), ["'rain', row 1", "the text '3' stands"],
    ),
    # which of several data sets
    "second of two": (
        "counts",
        [counts_with(), table(at("rain", 3, -1), index=YEARS)],
        ["In data set 2, 'rain', row 3 (index 1992)", "-1 is outside"],
    ),
    "second is a name": (
        "counts", [counts_with(), "run.csv"], ["data set 2 is the text 'run.csv'"],
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD_DATA)
def test_bad_data(name):
    model, data, fragments = BAD_DATA[name]
    with pytest.raises(DataError) as caught:
        bind(MODELS[model], data)
    text = str(caught.value)
    assert "Fix: " in text
    for fragment in fragments:
        assert fragment in text, text


@pytest.mark.parametrize("model", MODELS)
def test_the_good_data_are_good(model):
    (experiment,) = bind(MODELS[model], GOOD_DATA[model])
    assert experiment.seen.all()


BAD_INPUTS = {
    "none given": ("counts", None, 10, ["has inputs, and none were given", "{'u': ...}"]),
    "not declared": ("none", {"u": np.ones(3)}, 3, ["declares no inputs", "inputs=('u',)"]),
    "no steps": ("none", None, None, ["neither steps nor inputs", "steps=100"]),
    "steps of zero": ("none", None, 0, ["steps=0", "at least 1"]),
    "steps no whole number": ("none", None, 2.5, ["steps=2.5", "whole number"]),
    "wrong length": ("counts", {"u": np.ones(9)}, 10, ["'u' has 9 rows, and steps is 10"]),
    "NaN": ("counts", {"u": [1.0, np.nan]}, None, ["'u', row 2", "interpolation"]),
    "several": ("counts", [{"u": [1.0]}, {"u": [1.0]}], None, ["2 data sets", "one experiment"]),
    "misspelled": ("counts", {"U": np.ones(9)}, 9, ["'u' is missing", "are: U"]),
}


@pytest.mark.parametrize("name", BAD_INPUTS)
def test_bad_inputs(name):
    model, inputs, steps, fragments = BAD_INPUTS[name]
    traced = trace(declare()) if model == "none" else MODELS[model]
    with pytest.raises((DataError, ArgumentError)) as caught:
        bind_inputs(traced, inputs, steps)
    text = str(caught.value)
    assert "Fix: " in text
    for fragment in fragments:
        assert fragment in text, text


# -- parameters
def parameters_trace():
    model = declare(
        prior=[
            GOOD["prior"],
            lambda: {
                "S": ssm.InverseWishart(4, scale=np.eye(2)),
                "p": ssm.Dirichlet(np.ones(3)),
                "b": ssm.Normal(np.zeros(2), sd=1),
                "top": ssm.HalfNormal(sd=1),
            },
            lambda top: {"level": ssm.Uniform(0, top)},
        ]
    )
    return trace(model)


GOOD_PARAMETERS = {
    "phi": 0.5, "q": 1.0, "S": np.eye(2), "p": [0.2, 0.3, 0.5], "b": [0.0, 1.0],
    "top": 2.0, "level": 1.0,
}  # fmt: skip
BAD_PARAMETERS = {
    "unknown": ({"phy": 1.0}, ["'phy', which is no parameter", "are: phi, "]),
    "a state": ({"x": 1.0}, ["'x', which is a state, no parameter"]),
    "no number": ({"phi": "0.5"}, ["'phi' is '0.5'", "give a number"]),
    "None": ({"phi": None}, ["'phi'", "give a"]),
    "an array for a scalar": ({"phi": [0.5]}, ["shape (1,)", "one number"]),
    "wrong shape": ({"b": [1.0, 2.0, 3.0]}, ["'b' has shape (3,)", "shape (2,)"]),
    "NaN": ({"b": [1.0, np.nan]}, ["'b'[1] is nan", "finite"]),
    "infinite": ({"q": np.inf}, ["'q' is inf", "finite"]),
    "outside an interval": ({"phi": 1.5}, ["'phi': 1.5", "Uniform, [-1, 1]", __file__]),
    "zero": ({"q": 0.0}, ["'q': 0 is outside", "Gamma, (0, inf)"]),
    "outside by another's value": ({"level": 3.0}, ["'level': 3", "[0, 2]"]),
    "not symmetric": ({"S": [[1.0, 0.5], [0.0, 1.0]]}, ["'S'[0, 1]", "not symmetric"]),
    "indefinite": ({"S": [[1.0, 2.0], [2.0, 1.0]]}, ["'S'", "not positive definite"]),
    "no composition": ({"p": [0.5, 0.5, 0.5]}, ["'p'", "sum to 1.5"]),
}


@pytest.mark.parametrize("name", BAD_PARAMETERS)
def test_bad_parameters(name):
    changes, fragments = BAD_PARAMETERS[name]
    with pytest.raises(ArgumentError) as caught:
        check_parameters(parameters_trace(), GOOD_PARAMETERS | changes)
    text = str(caught.value)
    assert "Fix: " in text
    for fragment in fragments:
        assert fragment in text, text


def test_missing_and_contradicting_parameters():
    t = parameters_trace()
    with pytest.raises(ArgumentError, match="no value is given for parameters 'q', 'S'"):
        check_parameters(t, {"phi": 0.5})
    with pytest.raises(ArgumentError, match=r"in parameters and 0\.25 in fixed"):
        check_parameters(t, GOOD_PARAMETERS, fixed={"phi": 0.25})
    with pytest.raises(ArgumentError, match="fixed is 3 of type int"):
        check_parameters(t, GOOD_PARAMETERS, fixed=3)
    with pytest.raises(ArgumentError, match="start names 'phy'"):
        check_values(t, {"phy": 0.25}, argument="start")


# -- errors as such
def test_errors_cross_process_borders():
    with pytest.raises(ModelError) as caught:
        trace(python_if())
    assert caught.value.__cause__ is not caught.value
    copy = pickle.loads(pickle.dumps(caught.value))
    assert str(copy) == str(caught.value)
    assert type(copy) is type(caught.value)
    assert copy.where == caught.value.where


def test_the_families_of_errors():
    assert issubclass(ArgumentError, ValueError)
    assert issubclass(UnsupportedOperation, TypeError)
    for error in (ModelError, DataError, ArgumentError, UnsupportedOperation):
        assert issubclass(error, SSMError)


def test_cells_of_a_notebook_have_the_names_that_its_tracebacks_use(monkeypatch):
    names = {"kernel/123.py": ("Cell", "In[4]")}
    shell = SimpleNamespace(compile=SimpleNamespace(format_code_name=names.get))
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: shell))
    cell = Location("kernel/123.py", 3, "prior")
    assert str(cell) == "Cell In[4], line 3 in prior()"
    assert cell.short == "In[4]:3"
    file = Location("models/model.py", 3, "prior")
    assert str(file) == 'File "models/model.py", line 3 in prior()'
    assert file.short == "model.py:3"
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: None))
    assert cell.short == "123.py:3"


def test_a_file_edited_and_run_again_is_quoted_as_it_is_now(tmp_path):
    file, quoted = tmp_path / "own.py", []
    for law in ("Normal(0, 1)", "Gamma(2,   1)"):
        file.write_text(f"law = ssm.{law}\n")
        with pytest.raises(ModelError) as caught:
            exec(compile(file.read_text(), file, "exec"), {"ssm": ssm})
        quoted.append(caught.value.where.text)
    assert quoted == ["law = ssm.Normal(0, 1)", "law = ssm.Gamma(2,   1)"]
