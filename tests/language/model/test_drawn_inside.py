"""Distributions that a function computes with: what the error says, and that its fix works."""

from __future__ import annotations

import linecache
import textwrap

import numpy as np
import pytest

import ssmppl as ssm

REST = """
import numpy as np
import ssmppl as ssm

m = ssm.Model("m")


@m.initial
def initial():
    return {"S": ssm.Dirac(990), "I": ssm.Dirac(10)}


@m.observation
def observation(I):
    return {"cases": ssm.Poisson(I + 0.1)}

"""
PRIOR = """
@m.prior
def prior():
    return {"beta": ssm.Gamma(2, rate=4), "p": ssm.Beta(2, 2)}

"""


def run(tmp_path, *texts: str) -> ssm.Model:
    """The model of a file of these texts."""
    text = "".join(textwrap.dedent(t) for t in texts)
    path = tmp_path / f"m{abs(hash(text))}.py"
    path.write_text(text)
    linecache.checkcache()
    names: dict = {}
    exec(compile(text, str(path), "exec"), names)
    return names["m"]


def refused(tmp_path, *texts: str) -> ssm.ModelError:
    with pytest.raises(ssm.ModelError) as found:
        ssm.explain(run(tmp_path, REST, *texts))
    return found.value


def code_of(error: ssm.ModelError) -> str:
    return textwrap.dedent(error.fix.partition(":\n")[2])


def explained(model: ssm.Model) -> str:
    """The distributions: what follows quotes lines of the file."""
    return str(ssm.explain(model)).partition("\nStructure")[0]


STEPS = {
    "two flows": (
        """
        @m.transition
        def step(S, I, beta, p):
            new = ssm.Binomial(S, 1 - np.exp(-beta * I / 1000))
            rec = ssm.Binomial(I, p)
            return {"S": S - new, "I": I + new - rec}
        """,
        """
        @m.transition
        def draws(S, I, beta, p):
            return {"new": ssm.Binomial(S, 1 - np.exp(-beta * I / 1000)), "rec": ssm.Binomial(I, p)}

        @m.transition
        def step(S, I, new_next, rec_next):
            return {"S": ssm.Dirac(S - new_next), "I": ssm.Dirac(I + new_next - rec_next)}
        """,
    ),
    "one after the other, by way of a variable": (
        """
        @m.transition
        def step(S, I, beta, p):
            force = beta * I / 1000
            new = ssm.Binomial(S, 1 - np.exp(-force))
            left = I + new
            rec = ssm.Binomial(left, p)
            after = left - rec
            return {"S": ssm.Poisson(S - new + 1), "I": after}
        """,
        """
        @m.transition
        def draws(S, I, beta):
            force = beta * I / 1000
            return {"new": ssm.Binomial(S, 1 - np.exp(-force))}

        @m.transition
        def draws_2(I, p, new_next):
            left = I + new_next
            return {"rec": ssm.Binomial(left, p)}

        @m.transition
        def step(S, I, new_next, rec_next):
            left = I + new_next
            after = left - rec_next
            return {"S": ssm.Poisson(S - new_next + 1), "I": ssm.Dirac(after)}
        """,
    ),
    "in a function of NumPy, and beside a distribution that is only returned": (
        """
        @m.transition
        def step(S, I, beta, p):
            e = ssm.Normal(0, sd=p)
            own = ssm.Poisson(S)
            return {"S": own, "I": I * np.exp(e)}
        """,
        """
        @m.transition
        def draws(p):
            return {"e": ssm.Normal(0, sd=p)}

        @m.transition
        def step(S, I, e_next):
            own = ssm.Poisson(S)
            return {"S": own, "I": ssm.Dirac(I * np.exp(e_next))}
        """,
    ),
    "as a parameter of another": (
        """
        @m.transition
        def step(S, I, beta, p):
            e = ssm.Gamma(2, rate=beta)
            return {"e": e, "S": ssm.Poisson(e), "I": ssm.Dirac(I)}
        """,
        """
        @m.transition
        def draws(beta):
            return {"e": ssm.Gamma(2, rate=beta)}

        @m.transition
        def step(I, e_next):
            return {"S": ssm.Poisson(e_next), "I": ssm.Dirac(I)}
        """,
    ),
}


@pytest.mark.parametrize("case", list(STEPS))
def test_the_fix_of_a_step_is_the_model_that_was_meant(tmp_path, case):
    """Run as it is printed, it is what somebody wrote by hand."""
    written, expected = STEPS[case]
    error = refused(tmp_path, PRIOR, written)
    assert "as if it were a draw" in error.found
    assert "NAME_next" in error.fix
    fixed = run(tmp_path, REST, PRIOR, code_of(error))
    assert explained(fixed) == explained(run(tmp_path, REST, PRIOR, expected))
    drawn = ssm.simulate(fixed, steps=5, parameters={"beta": 0.5, "p": 0.3}, seed=1)
    assert np.isfinite(drawn["cases"].values).all()


def test_the_name_is_said_and_the_line(tmp_path):
    error = refused(tmp_path, PRIOR, STEPS["two flows"][0])
    assert "'new', a Binomial distribution" in error.found
    assert error.where.function == "step"
    text = (tmp_path / error.where.file).read_text().split("\n")[error.where.line - 1]
    assert text.strip().startswith('return {"S": S - new')


def test_a_prior_given_by_a_parameter(tmp_path):
    """As PyMC writes it: new values have no suffix there."""
    step = """
    @m.transition
    def step(S, I, beta, p):
        return {"S": ssm.Poisson(beta), "I": ssm.Binomial(I, p)}
    """
    error = refused(
        tmp_path,
        """
        @m.prior
        def prior():
            mean = ssm.Gamma(2, rate=1)
            return {"mean": mean, "beta": ssm.Normal(mean, sd=1), "p": ssm.Beta(2, 2)}
        """,
        step,
    )
    assert "'mean', a Gamma distribution" in error.found
    fixed = run(tmp_path, REST, code_of(error), step)
    assert "mean  ~ Gamma(" in str(ssm.explain(fixed))
    assert "beta  ~ Normal(mean=mean" in str(ssm.explain(fixed))


@pytest.mark.parametrize(
    "line",
    [
        "S - ssm.Binomial(S, p)",
        "float(ssm.Binomial(S, p)) + S",
        "[S - n for n in [ssm.Poisson(S)]][0]",
    ],
)
def test_without_a_name_it_is_said_in_words(tmp_path, line):
    error = refused(tmp_path, PRIOR, f"""
        @m.transition
        def step(S, I, p):
            return {{"S": ssm.Dirac({line}), "I": ssm.Dirac(I)}}
        """)  # fmt: skip
    assert "computes with" in error.found
    assert "NAME_next" in error.fix
    assert "\n" not in error.fix


@pytest.mark.parametrize(
    "use",
    ["np.where(new == 0, S, S - 1)", "np.where(0 == new, S, S - 1)", "np.where(new > 2, S, 0)",
     "-new", "new[0]", "np.stack([S, new])[0]", "abs(new)", "new.clip(0)"],
)  # fmt: skip
def test_whatever_is_asked_of_it(tmp_path, use):
    """Comparisons too, which Python would answer without a word."""
    error = refused(tmp_path, PRIOR, f"""
        @m.transition
        def step(S, I, p):
            new = ssm.Binomial(S, p)
            return {{"S": ssm.Dirac({use}), "I": ssm.Dirac(I)}}
        """)  # fmt: skip
    assert "'new', a Binomial distribution" in error.found


@pytest.mark.parametrize(("role", "word"), [("initial", "prior"), ("observation", "as a state")])
def test_elsewhere_there_is_another_way(tmp_path, role, word):
    lines = {
        "initial": 'return {"S": ssm.Dirac(3 + e), "I": ssm.Dirac(2)}',
        "observation": 'return {"cases": ssm.Poisson(I * np.exp(e))}',
    }
    text = REST.replace(
        {"initial": 'return {"S": ssm.Dirac(990), "I": ssm.Dirac(10)}',
         "observation": 'return {"cases": ssm.Poisson(I + 0.1)}'}[role],
        "e = ssm.Normal(0, sd=1)\n    " + lines[role],
    )  # fmt: skip
    with pytest.raises(ssm.ModelError, match="'e', a Normal distribution") as found:
        ssm.explain(run(tmp_path, text, PRIOR, STEPS["two flows"][1]))
    assert word in found.value.fix


def test_functions_that_cannot_be_taken_apart(tmp_path):
    error = refused(tmp_path, PRIOR, """
        @m.transition
        def step(S, I, p):
            for _ in range(2):
                new = ssm.Binomial(S, p)
                S = S - new
            return {"S": ssm.Dirac(S), "I": ssm.Dirac(I)}
        """)  # fmt: skip
    assert "'new', a Binomial distribution" in error.found
    assert "NAME_next" in error.fix


@pytest.mark.parametrize(
    ("arguments", "lines"),
    [
        ("S, I, p, scale=2.0", "new = ssm.Binomial(S, p / scale)"),
        ("S, I, p", "new = ssm.Binomial(S, p)\n            new = ssm.Binomial(S, 0.5 * p)"),
    ],
)
def test_what_a_rewritten_function_would_lose_is_not_rewritten(tmp_path, arguments, lines):
    """A default, or a name that is given twice."""
    error = refused(tmp_path, PRIOR, f"""
        @m.transition
        def step({arguments}):
            {lines}
            return {{"S": ssm.Dirac(S - new), "I": ssm.Dirac(I)}}
        """)  # fmt: skip
    assert "'new', a Binomial distribution" in error.found
    assert "\n" not in error.fix


def test_an_error_of_the_users_own_is_told_as_it_is(tmp_path):
    error = refused(tmp_path, PRIOR, """
        @m.transition
        def step(S, I, p):
            raise TypeError("Gamma and Beta rays are not modelled")
        """)  # fmt: skip
    assert "raised TypeError: Gamma and Beta rays" in error.found


def test_distributions_are_still_what_mixtures_are_made_of(tmp_path):
    model = run(tmp_path, REST, PRIOR, """
        @m.transition
        def step(S, I, p):
            near, far = ssm.Normal(S, sd=1), ssm.Normal(S, sd=10)
            return {"S": ssm.Mixture([p, 1 - p], [near, far]), "I": ssm.Dirac(I)}
        """)  # fmt: skip
    assert "Mixture" in str(ssm.explain(model))
    one = ssm.Normal(0, sd=1)
    assert one == one
    assert one != ssm.Normal(0, sd=1)
