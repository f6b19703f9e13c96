"""Every rule of laws of a user's own, broken: the error names the line, the find and the fix.

A bad law is a function that declares or uses one; the line at fault is marked `# HERE`.
"""

import inspect

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.errors import ModelError
from ssmppl.language.tracing import trace
from tests.language.user_defined.user_defined_laws import Gumbel, Lomax

BAD = []  # (builder, fragments)


def bad(*fragments):
    def register(builder):
        BAD.append((builder, fragments))
        return builder

    return register


def used(law):
    """A model that observes a state through the law of location and scale."""
    model = ssm.Model("used")
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x: {"x": ssm.Normal(x, sd=1)})
    model.observation(lambda x: {"y": law(x, 1.0)})
    return model


# -- declarations
@bad("decorates 3, which is not a function", "on the line above a def")
def declared_on_a_number():
    ssm.distribution(3)  # HERE


@bad("takes no argument", "def Law(y, shape, scale)")
def declared_without_a_value():
    @ssm.distribution
    def Law():  # HERE
        return 0.0


@bad("takes 'rest'", "bound by name")
def declared_with_any_arguments():
    @ssm.distribution(lower=0)
    def Law(y, *rest):  # HERE
        return 0.0


@bad("lower='lo' of @distribution Law is no argument of it", "its arguments are low, scale")
def bound_by_an_unknown_name():
    @ssm.distribution(lower="lo")
    def Law(y, low, scale):  # HERE
        return 0.0


@bad("positive='skale'", "its arguments are scale")
def positive_by_an_unknown_name():
    @ssm.distribution(positive=("skale",))
    def Law(y, scale):  # HERE
        return 0.0


@bad("lower=[0] of @distribution Law is no number", 'lower="loc"')
def bound_is_a_list():
    @ssm.distribution(lower=[0])
    def Law(y):  # HERE
        return 0.0


@bad("upper=2.5 of @distribution Law is no whole number")
def bound_of_counts_is_no_whole_number():
    @ssm.distribution(lower=0, upper=2.5, discrete=True)
    def Law(k):  # HERE
        return 0.0


@bad("lower=1 of @distribution Law is not below upper=0", "lower < upper")
def bounds_in_the_wrong_order():
    @ssm.distribution(lower=1, upper=0)
    def Law(y):  # HERE
        return 0.0


@bad("@Gumbel.sampler is called without a function", "without parentheses")
def sampler_with_parentheses():
    @Gumbel.sampler()  # HERE
    def draw(rng):
        return rng.normal()


@bad("@Gumbel.mean decorates 2.0", "make one first by giving its arguments")
def a_mean_of_the_declaration():
    Gumbel.mean(2.0)  # HERE


@bad("@Gumbel.sampler draw asks for 'rate'", "behind rng, its arguments are scale, loc")
def sampler_of_an_unknown_argument():
    @Gumbel.sampler
    def draw(rng, rate):  # HERE
        return rng.normal()


# -- arguments
@bad("Gumbel has no argument 'scal'", "write scale=")
def unknown_argument():
    return Gumbel(0.0, scal=1.0)  # HERE


@bad("Lomax: missing a required argument: 'scale'", "write Lomax(shape, scale)")
def too_few_arguments():
    return Lomax(2.0)  # HERE


@bad("Lomax: shape = -1 is outside (0, inf)")
def number_out_of_range():
    return Lomax(-1.0, 1.0)  # HERE


@bad("Lomax: shape is 'two', which is no number or symbol")
def argument_is_a_text():
    return Lomax("two", 1.0)  # HERE


@bad("shapes do not agree: loc (2,), scale (3,)")
def shapes_that_do_not_agree():
    return Gumbel(np.zeros(2), np.ones(3))  # HERE


@bad("its lower bound 2 is not below its upper bound 1")
def bounds_that_leave_nothing():
    @ssm.distribution(lower="a", upper="b")
    def Law(y, a, b):
        return -np.log(b - a)

    return Law(2.0, 1.0)  # HERE


# -- the functions
@bad("@distribution Law returned nothing", "end it by `return`")
def density_without_return():
    @ssm.distribution
    def Law(y, loc, scale):
        np.log(scale) - np.abs(y - loc)  # HERE

    return used(Law)


@bad("@distribution Law returned 'much'")
def density_is_a_text():
    @ssm.distribution
    def Law(y, loc, scale):
        return "much"  # HERE

    return used(Law)


@bad("@distribution Law returned an array of shape (2,)", "one expression")
def density_is_an_array():
    @ssm.distribution
    def Law(y, loc, scale):
        return np.stack([y, loc])  # HERE

    return used(Law)


@bad("needs the truth of a symbol", "np.where(condition, a, b)")
def density_with_an_if():
    @ssm.distribution
    def Law(y, loc, scale):
        if y > loc:  # HERE
            return -(y - loc)
        return y - loc

    return used(Law)


@bad("@distribution Law raised NameError: name 'sigma' is not defined")
def density_of_an_unknown_name():
    @ssm.distribution
    def Law(y, loc, scale):
        return -np.abs(y - loc) / sigma  # noqa: F821  # HERE

    return used(Law)


@bad("@distribution Law is nan at scale=1")
def density_that_is_nan():
    @ssm.distribution
    def Law(y, loc, scale):
        with np.errstate(all="ignore"):
            constant = np.log(-np.float64(scale))
        return constant - np.abs(y - loc)  # HERE

    return used(Law)


@bad("@distribution Law gives something else when it is called again")
def density_with_random_numbers():
    @ssm.distribution
    def Law(y, loc, scale):
        return -np.abs(y - loc) - np.random.default_rng().random()  # HERE

    return used(Law)


@bad("reads x of the model from outside of its arguments", "an argument for x")
def density_that_reads_a_state():
    def law(x, scale):
        @ssm.distribution
        def Law(y, scale):
            return -np.abs(y - x) / scale  # HERE

        return Law(scale)

    return used(law)


@bad("@Law.sampler draw returned nothing", "end it by `return`")
def sampler_without_return():
    @ssm.distribution
    def Law(y, loc, scale):
        return -np.abs(y - loc)

    @Law.sampler
    def draw(rng, loc):
        rng.normal()  # HERE

    return used(Law)


@bad("@Law.sampler draw returned loc + 0.4", "which holds no draw")
def sampler_that_draws_nothing():
    @ssm.distribution
    def Law(y, loc, scale):
        return -np.abs(y - loc)

    @Law.sampler
    def draw(rng, loc):
        return loc + 0.4  # HERE

    return used(Law)


@bad("rng.beta", "uniform", "a / (a + b)")
def sampler_of_what_there_is_not():
    @ssm.distribution
    def Law(y, loc, scale):
        return -np.abs(y - loc)

    @Law.sampler
    def draw(rng, loc):
        return loc + rng.beta(2, 3)  # HERE

    return used(Law)


# -- in a model
@bad(
    "Law has no sampler, and 'x' is a state, which particles draw", "@Law.sampler", "def draw(rng,"
)
def a_state_without_a_sampler():
    @ssm.distribution
    def Law(y, loc):
        return -np.abs(y - loc) - np.log(2)

    model = ssm.Model("bare")
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x: {"x": Law(x)})  # HERE
    return model


@bad("Law has no sampler, and 'y' has to be drawn here", "@Law.sampler")
def an_observation_without_a_sampler_is_simulated():
    @ssm.distribution
    def Law(y, loc):
        return -np.abs(y - loc) - np.log(2)

    model = ssm.Model("bare")
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x: {"x": ssm.Normal(x, sd=1)})
    model.observation(lambda x: {"y": Law(x)})  # HERE
    found = ssm.log_likelihood(model, {"y": [0.0, 1.0]}, {}, particles=100, seed=1)
    assert np.isfinite(found)
    ssm.simulate(model, {}, steps=3)


@bad("Law has no sampler, and the prior of 'a' has to be drawn from here")
def a_prior_without_a_sampler_is_drawn_from():
    @ssm.distribution
    def Law(y):
        return -np.abs(y) - np.log(2)

    model = ssm.Model("bare")
    model.prior(lambda: {"a": Law()})  # HERE
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x, a: {"x": ssm.Normal(a * x, sd=1)})
    ssm.simulate(model, {"a": 0.5}, steps=3)
    ssm.simulate(model, steps=3)


@bad("the prior of 'a' is Law: parameters are continuous")
def a_discrete_prior():
    @ssm.distribution(lower=0, discrete=True)
    def Law(k):
        return -np.log(2) * (k + 1)

    model = ssm.Model("bare")
    model.prior(lambda: {"a": Law()})  # HERE
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x, a: {"x": ssm.Normal(a * x, sd=1)})
    return model


@bad("Law has no distribution function, or no inverse of it", "@Law.cdf and @Law.quantile")
def truncated_without_an_inverse():
    @ssm.distribution
    def Law(y, loc):
        return -np.abs(y - loc) - np.log(2)

    return ssm.Truncated(Law(0.0), lower=0)  # HERE


@bad("check takes one number for each argument; found Gumbel(loc=0, scale=1) of shape (2,)")
def checked_with_an_array():
    Gumbel.check(np.zeros(2))  # HERE


@pytest.mark.parametrize(("builder", "fragments"), BAD, ids=[b.__name__ for b, _ in BAD])
def test_bad_law(builder, fragments):
    lines, first = inspect.getsourcelines(builder)
    (marked,) = (first + i for i, text in enumerate(lines) if "# HERE" in text)
    with pytest.raises(ModelError) as caught:
        trace(builder())
    text = str(caught.value)
    assert f'File "{__file__}", line {marked}' in text, text
    assert "Fix: " in text
    assert "'Expr'" not in text
    for fragment in fragments:
        assert fragment in text, text
