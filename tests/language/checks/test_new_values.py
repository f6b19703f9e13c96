"""`NAME_next` in transitions: what it stands for, and what is refused, with the fix."""

import pickle

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.errors import ModelError
from ssmppl.language.distributions import Dirac
from ssmppl.language.tracing import trace


def model_of(*transitions, initial=("x", "v"), observed=None, prior=None, inputs=()):
    """States of a normal law at first, and these transition functions in turn."""
    model = ssm.Model("steps", inputs=inputs)
    model.prior(prior or (lambda: {"a": ssm.Normal(0, sd=1)}))
    model.initial(lambda: {name: ssm.Normal(0, sd=1) for name in initial})
    for function in transitions:
        model.transition(function)
    model.observation(observed or (lambda x: {"y": ssm.Normal(x, sd=1)}))
    return model


def give_x(x, a):
    return {"x": ssm.Normal(a * x, sd=1)}


def give_v(v, x_next):
    return {"v": ssm.Normal(v + x_next, sd=1)}


def refusal(*transitions, **others):
    with pytest.raises(ModelError) as caught:
        trace(model_of(*transitions, **others))
    return caught.value


# -- what it stands for
def test_a_new_value_is_the_symbol_of_the_state_in_the_row_to_come():
    traced = trace(model_of(give_x, give_v))
    assert list(traced.transition) == ["x", "v"]
    x, v_prev = traced.state_symbols[0], traced.state_prev_symbols[1]
    (mean,) = traced.transition["v"].distribution.parameters["mean_"].ravel()
    assert mean is v_prev + x


def test_transitions_stand_in_the_order_of_the_functions_and_states_in_their_own():
    traced = trace(model_of(give_x, give_v, initial=("v", "x")))
    assert [repr(s) for s in traced.state_symbols] == ["v", "x"]
    assert list(traced.transition) == ["x", "v"]


def test_without_new_values_transitions_stand_in_the_order_of_the_states():
    traced = trace(model_of(lambda v: {"v": ssm.Normal(v, sd=1)}, give_x))
    assert list(traced.transition) == ["x", "v"]


def test_the_new_value_of_a_deterministic_state_is_its_expression():
    traced = trace(model_of(lambda x, a: {"x": ssm.Dirac(a * x)}, give_v))
    a, (x_prev, v_prev) = traced.parameter_symbols[0], traced.state_prev_symbols
    (mean,) = traced.transition["v"].distribution.parameters["mean_"].ravel()
    assert mean is v_prev + a * x_prev


def test_a_draw_of_the_step_is_a_state_that_is_zero_at_first():
    def flow(x):
        return {"flow": ssm.Normal(np.stack([x, 2 * x]), sd=1)}

    def move(x, flow_next):
        return {"x": ssm.Dirac(x + flow_next[0] - flow_next[1])}

    traced = trace(model_of(flow, move, initial=("x",)))
    assert traced.auxiliary == {"flow"}
    assert list(traced.initial) == ["x", "flow"]
    first = traced.initial["flow"].distribution
    assert isinstance(first, Dirac)
    assert [e.data for e in first.value.ravel()] == [0.0, 0.0]
    assert pickle.loads(pickle.dumps(traced)).auxiliary == {"flow"}


def test_a_deterministic_draw_of_the_step_is_but_a_name():
    """So that it does not stand in the way of conjugate updates of what it is made of."""

    def mean(x, a):
        return {"mean": ssm.Dirac(a * x)}

    traced = trace(
        model_of(mean, lambda mean_next: {"x": ssm.Normal(mean_next, sd=1)}, initial=("x",))
    )
    plain = trace(model_of(give_x, initial=("x",)))
    assert list(traced.initial) == ["x"]
    assert not traced.auxiliary
    found, own = (t.transition["x"].distribution.arguments() for t in (traced, plain))
    assert all(e is f for e, f in zip(found, own, strict=True))


def test_a_quantity_of_that_very_name_comes_first():
    def give(v, x_next):
        return {"v": ssm.Normal(v + x_next, sd=1)}

    traced = trace(model_of(give_x, give, inputs=("x_next",)))
    (mean,) = traced.transition["v"].distribution.parameters["mean_"].ravel()
    assert {s.data[0] for s in mean.args} == {"state_prev", "input_prev"}


# -- what is refused
def both(x, v, x_next):
    return {"x": ssm.Normal(x, sd=1), "v": ssm.Normal(v + x_next, sd=1)}


def x_by_v(x, v_next):
    return {"x": ssm.Normal(x + v_next, sd=1)}


def v_by_typo(v, xx_next):
    return {"v": ssm.Normal(v + xx_next, sd=1)}


def v_by_parameter(v, a_next):
    return {"v": ssm.Normal(v + a_next, sd=1)}


def flow_of(x):
    return {"flow": ssm.Poisson(np.exp(x))}


def x_by_flow(x, flow_next):
    return {"x": ssm.Normal(x + flow_next, sd=1)}


def v_by_flow_before(v, flow):
    return {"v": ssm.Normal(v + flow, sd=1)}


REFUSED = {
    "below": ((give_v, give_x), {}, "gives further below", "write give_x above give_v"),
    "itself": ((both,), {}, "'x_next', the new value of 'x' that it gives itself",
               "give 'x' in a @transition function of its own, above"),
    "circle": ((x_by_v, give_v), {}, "a cycle", "depend on the value before, 'v', or draw both"),
    "typo": ((give_x, v_by_typo), {}, "no @transition function gives 'xx'", "give: x_next"),
    "parameter": ((give_x, v_by_parameter), {}, "'a' is a parameter", "name 'a' itself"),
    "before": ((flow_of, x_by_flow, v_by_flow_before), {}, "has no value before",
               "ask for 'flow_next'"),
    "unused": ((flow_of, give_x, lambda v: {"v": ssm.Normal(v, sd=1)}), {},
               "'flow', which has no initial distribution", "read as 'flow_next' by a later"),
    "observed": ((flow_of, x_by_flow), {"initial": ("x",),
                  "observed": lambda flow: {"y": ssm.Poisson(flow)}},
                 "no value at the first row", "give 'flow' an initial distribution"),
    "observation": ((give_x, give_v), {"observed": lambda x_next: {"y": ssm.Normal(x_next, sd=1)}},
                    "'x_next' is the new value of 'x' in a step", "name 'x'"),
    "prior": ((give_x, give_v), {"prior": lambda x_next: {"a": ssm.Normal(x_next, sd=1)}},
              "this is @prior", "parameters only"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_refused(name):
    transitions, others, found, fix = REFUSED[name]
    error = refusal(*transitions, **others)
    assert found in error.found
    assert fix in error.fix
    assert error.where.file == __file__


def test_an_initial_law_knows_no_new_value():
    model = model_of(give_x, give_v)
    model.functions["initial"] = []
    model.initial(lambda x_next: {"x": ssm.Normal(x_next, sd=1), "v": ssm.Normal(0, sd=1)})
    with pytest.raises(ModelError, match="this is @initial"):
        trace(model)


def test_a_proposal_draws_from_the_state_before():
    model = model_of(give_x, give_v)
    model.proposal(lambda x, x_next, v: {"x": ssm.Normal(x, sd=1), "v": ssm.Normal(x_next, sd=1)})
    with pytest.raises(ModelError, match="which only @transition functions know"):
        trace(model)


def test_a_default_does_not_hide_a_new_value():
    """One that stands below would be read as the default: refused, as with all quantities."""

    def give_first(v, x_next=0.0):
        return {"v": ssm.Normal(v + x_next, sd=1)}

    error = refusal(give_first, give_x)
    assert "takes the default of 'x_next'" in error.found
    assert "write give_x above give_first" in error.fix


def test_what_another_law_kept_is_refused_all_the_same():
    kept = []

    def give(x):
        kept.append(x)
        return {"x": ssm.Normal(x, sd=1)}

    def observed(x):
        kept.append(x)
        return {"y": ssm.Normal(x, sd=1)}

    def borrow(v):
        return {"v": ssm.Normal(v + kept[0], sd=1)}

    assert "a symbol of another distribution" in refusal(give, borrow, observed=observed).found
