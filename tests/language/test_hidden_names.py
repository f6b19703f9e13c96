"""Names of quantities that a law would not read: hidden by a default, or spelled otherwise."""

import pytest

import ssmppl as ssm
from ssmppl.language.trace import trace


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
