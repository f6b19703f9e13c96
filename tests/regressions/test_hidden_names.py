"""Names of quantities that a law would not read: hidden by a default, or spelled otherwise."""

import pandas as pd
import pytest

import ssmppl as ssm
from ssmppl.language.tracing import trace


def walk(**laws):
    model = ssm.Model("walk")
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(laws.pop("transition", lambda x: {"x": ssm.Normal(x, sd=1)}))
    model.observation(laws.pop("observation", lambda x: {"y": ssm.Normal(x, sd=1)}))
    for prior in laws.get("priors", ()):
        model.prior(prior)
    return model


@pytest.mark.parametrize(
    ("name", "laws"),
    [
        (
            "scale",
            {
                "priors": [
                    lambda scale=1.0: {"k": ssm.Normal(0, sd=scale)},
                    lambda: {"scale": ssm.HalfNormal(sd=5)},
                ]
            },
        ),
        ("y", {"observation": lambda x, y=0.0: {"y": ssm.Normal(x + y, sd=1)}}),
        ("t", {"priors": [lambda t=2.0: {"k": ssm.Normal(t, sd=1)}]}),
    ],
)
def test_a_default_does_not_hide_a_quantity(name, laws):
    with pytest.raises(ssm.ModelError, match=f"takes the default of '{name}', which hides"):
        trace(walk(**laws))


def test_a_name_that_python_reads_otherwise_is_told():
    model = walk(priors=[lambda: {"\u00b5": ssm.Normal(0, sd=1)}])
    with pytest.raises(ssm.ModelError, match="MICRO SIGN") as caught:
        trace(model)
    assert "write '\\u03bc'" in caught.value.fix
    trace(walk(priors=[lambda: {"\u03bc": ssm.Normal(0, sd=1)}]))


SUMMER, RATES, INDEX = {6.0, 7.0, 8.0}, {1.0: 0.5}, pd.Index([1.0, 2.0])


def literal(x, u):
    return {"y": ssm.Normal(x + (1.0 if u in {6.0, 7.0} else 0.0), sd=1)}


def computed(x, u):
    return {"y": ssm.Normal(x + (1.0 if u % 12 in SUMMER else 0.0), sd=1)}


def absent(x, u):
    if u not in RATES:
        x = 2 * x
    return {"y": ssm.Normal(x, sd=1)}


def got(x, u):
    return {"y": ssm.Normal(x + RATES.get(u, 0.0), sd=1)}


def got_of_a_sum(x, u):
    return {"y": ssm.Normal(x + RATES.get(u + 1.0, 0.0), sd=1)}


def of_pandas(x, u):
    return {"y": ssm.Normal(x + (1.0 if u in INDEX else 0.0), sd=1)}


@pytest.mark.parametrize("law", [literal, computed, absent, got, got_of_a_sum, of_pandas])
def test_a_symbol_is_not_looked_for_in_a_set(law):
    model = ssm.Model("months", inputs=("u",))
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x: {"x": ssm.Normal(x, sd=1)})
    model.observation(law)
    with pytest.raises(ssm.ModelError, match="looks 'u', a symbol, up in a") as caught:
        trace(model)
    assert caught.value.where.line == law.__code__.co_firstlineno + 1
    assert "np.where((u == 1) | (u == 2)" in caught.value.fix


def of_numbers(x, u, k=6.0):
    parts = [n for n in (1.0, 6.0) if n in SUMMER]
    if u.ndim in {0, 1} and "a" not in RATES and k in SUMMER and len([u]) in {1}:
        x = len(parts) * 3 * x + RATES.get(k, 0.0) + RATES.get(u.ndim, 0.0)
    return {"y": ssm.Normal(x + u, sd=1)}


def of_namesakes(x, u):
    inner = sum(1.0 for u in (1.0, 6.0) if u in SUMMER) + (lambda u: RATES.get(u, 0.0))(2.0)
    return {"y": ssm.Normal(3 * x + u + inner, sd=1)}


def of_a_name_anew(x, u):
    for u in (1.0, 2.0):
        x = 3 * x if u in RATES else x + RATES.get(u, 0.0)
    return {"y": ssm.Normal(x + (1.0 if u in SUMMER else 0.0), sd=1)}


@pytest.mark.parametrize("law", [of_numbers, of_namesakes, of_a_name_anew])
def test_numbers_are_looked_for_in_sets_as_ever(law):
    model = ssm.Model("months", inputs=("u",))
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x: {"x": ssm.Normal(x, sd=1)})
    model.observation(law)
    assert "3*x" in repr(trace(model).observations["y"].distribution)


def test_what_one_law_keeps_is_not_read_by_another():
    store = {}

    def transition(x):
        store["gain"] = 0.5 * x
        return {"x": ssm.Normal(x, sd=1)}

    def observation(x):
        return {"y": ssm.Normal(x + store.get("gain", 0.0), sd=1)}

    model = walk(transition=transition, observation=observation)
    trace(model)  # the transition comes after
    with pytest.raises(ssm.ModelError, match="'y' reads x_prev, a symbol of another distribution"):
        trace(model)
