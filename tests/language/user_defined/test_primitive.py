"""Opaque functions of numbers inside a model."""

import inspect
import math

import numba
import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.errors import NotApplicable
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import symbol
from ssmppl.language.model.closure_digest import fingerprint
from ssmppl.language.tracing import trace

LEVEL = 0.25


@ssm.primitive
def friction(v, strength):
    return -strength if v > LEVEL else strength * math.tanh(v)


def written(v, strength):
    """The same in the language."""
    return np.where(v > LEVEL, -strength, strength * np.tanh(v))


def build(law):
    model = ssm.Model("friction")

    @model.prior
    def prior():
        return {"k": ssm.Gamma(2, rate=10), "q": ssm.Gamma(20, rate=1)}

    @model.initial
    def initial():
        return {"v": ssm.Normal(0, sd=1)}

    @model.transition
    def transition(v, k, q):
        return {"v": ssm.Normal(0.9 * v + law(v, k), precision=q)}

    @model.observation
    def observation(v):
        return {"y": ssm.Normal(v, sd=0.3)}

    return model


def test_numbers_and_symbols():
    v = symbol("state", "v")
    values = np.array([-1.0, 0.1, 2.0])
    assert friction(2.0, 0.5) == -0.5
    node = friction(v, 0.5)
    np.testing.assert_allclose(
        evaluate(node, {v: values}), [friction(x, 0.5) for x in values], rtol=1e-15
    )
    assert friction(np.stack([v, 2 * v]), 0.5).shape == (2,)


def test_same_numbers_as_the_law_written_out():
    y = {"y": np.sin(np.arange(40) / 4.0)}
    parameters = {"k": 0.3, "q": 30.0}
    opaque, plain = (
        ssm.log_likelihood(
            build(law), y, parameters, proposal="bootstrap", repeats=3, particles=200, seed=4
        )
        for law in (friction, written)
    )
    np.testing.assert_allclose(opaque, plain, rtol=1e-10)


def test_what_can_still_be_derived():
    plan = ssm.explain(build(friction))
    updates = {u.block: u for u in plan.updates}
    assert updates[("q",)].family_name == "Gamma"
    assert updates[("k",)].family_name == "slice"
    assert updates[("k",)].needs_log_joint
    assert isinstance(plan.structure, NotApplicable)


def test_a_changed_constant_changes_the_generated_module():
    def make(level):
        def f(v):
            return v * level

        return ssm.primitive(f)

    assert make(1.0).name != make(2.0).name
    assert make(1.0).name == make(1.0).name


def test_bad_primitives():
    with pytest.raises(ssm.ModelError, match="cannot compile") as error:

        @ssm.primitive
        def opens_a_file(v):
            return open(v)

    assert __file__ in str(error.value)
    with pytest.raises(ssm.ModelError, match="not a function"):
        ssm.primitive(3.0)
    with pytest.raises(ssm.ModelError, match="returns"):

        @ssm.primitive
        def pair(v):
            return [v, v]

    with pytest.raises(ssm.ModelError, match="arguments"):

        @ssm.primitive
        def many(*v):
            return 0.0

    with pytest.raises(ssm.ModelError, match="takes 2 arguments"):
        friction(1.0)


def test_wrong_number_of_arguments_in_a_law_names_the_place():
    model = build(lambda v, k: friction(v))
    with pytest.raises(ssm.ModelError, match="takes 2 arguments") as error:
        trace(model)
    assert "test_primitive.py" in str(error.value)
    assert inspect.getsource(friction.function).splitlines()[1].strip() in str(error.value)


def test_a_name_follows_called_functions_and_not_their_addresses():
    """A name with an address in it would be new in every process: nothing cached, no checkpoint."""

    def make(power):
        def cube(v):
            return v**power if v > 0 else cube(-v)

        compiled = numba.njit(cube)

        def friction(v):
            return cube(v) * 2.0 + compiled(v)

        return friction

    assert fingerprint(make(3)) == fingerprint(make(3)) != fingerprint(make(2))


def test_what_it_reads_may_not_change_unseen():
    """The compiled form went on with the old number, in new models too."""
    gain = 1.0

    def amplified(v):
        return gain * v

    law = ssm.primitive(amplified)

    def likelihood(model):
        y = {"y": np.ones(3)}
        return ssm.log_likelihood(model, y, {"k": 0.3, "q": 30.0}, particles=50, seed=1)

    model = build(lambda v, k: law(v))
    before = likelihood(model)
    assert likelihood(model) == before
    gain = 3.0
    for changed in (model, build(lambda v, k: law(v))):
        with pytest.raises(ssm.ModelError, match=r"amplified was .* with other .*gain"):
            likelihood(changed)
    law = ssm.primitive(law.function)
    assert likelihood(model) != before


def test_outside_of_its_domain_a_primitive_is_no_number():
    """As in the kernels, and not an error of Python's `math`, where a prior's draw leads there."""

    @ssm.primitive
    def lg(a):
        return math.log(a)

    @ssm.primitive
    def one_over(a):
        return 1.0 / a

    x = symbol("parameter", "a", ())
    at = {x: np.array([-1.0, 0.0, 1.0])}
    np.testing.assert_array_equal(evaluate(lg(x), at), [np.nan, -np.inf, 0.0])
    np.testing.assert_array_equal(evaluate(one_over(x), at), [-1.0, np.inf, 1.0])
