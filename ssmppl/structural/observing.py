"""`observe`: the observation of a sum of components."""

from __future__ import annotations

from typing import Any

from ssmppl.arguments import checked
from ssmppl.errors import ArgumentError
from ssmppl.expressions.expr import user_location
from ssmppl.structural.component import (
    Component,
    Quantity,
    Writer,
    check_components,
    function_text,
    summed,
    write,
)

# Of each distribution: its law, and its parameters beside the mean, with their default priors.
# link : the scale on which the components are summed.
LAWS: dict[str, tuple[str, str, dict[str, str]]] = {
    "normal": ("identity", "ssm.Normal({mean}, sd={sd})", {"sd": "ssm.HalfFlat()"}),
    "student_t": (
        "identity",
        "ssm.StudentT({df}, {mean}, scale={sd})",
        {"df": "ssm.Gamma(2, rate=0.1)", "sd": "ssm.HalfFlat()"},
    ),
    "poisson": ("log", "ssm.Poisson(np.exp({mean}))", {}),
    "negative_binomial": (
        "log",
        "ssm.NegativeBinomial(np.exp({mean}), dispersion={dispersion})",
        {"dispersion": "ssm.Gamma(2, rate=0.1)"},
    ),
    "bernoulli": ("logit", "ssm.Bernoulli(1 / (1 + np.exp(-({mean}))))", {}),
}


@checked
def observe(
    model: Any, channel: str, *components: Component | str, distribution: str = "normal",
    sd: Any = None, df: Any = None, dispersion: Any = None,
) -> None:  # fmt: skip
    """Write the observation of a sum of components into a model.

    A function of your own does as well: it names the states of the components among its arguments.

    Parameters
    ----------
    model : it is written into this.
    channel : name of the observed quantity, as the data have it.
    *components : what is summed, each by itself or by its name; in the docstring of `Component`,
        `value`.
    distribution : "normal", with the sum for its mean; "student_t", for data with outliers, with
        the sum for its location; "poisson" and "negative_binomial", of counts, with the sum for the
        logarithm of their mean; "bernoulli", of 0 and 1, with the sum for the logarithm of the
        odds. All but the first leave no exact likelihood, and no state may start diffuse: give the
        components `initial=`.
    sd : standard deviation of "normal", or scale of "student_t", as `sd` of `level`: by default the
        parameter `<channel>_sd` with a flat prior. 0 is no distribution: give an autoregression, or
        a level, to sum up to the data without noise.
    df : degrees of freedom of "student_t": by default the parameter `<channel>_df` with the prior
        Gamma(2, rate=0.1) (Juárez and Steel 2010, J. Business & Economic Statistics 28, 52-66).
    dispersion : of "negative_binomial", whose variance is mean + mean^2 / dispersion: by default
        the parameter `<channel>_dispersion` with the same prior.

    Raises
    ------
    ArgumentError : an argument is of the wrong kind, a component is not of this model, or starts
        diffuse where it cannot.
    """
    w = Writer(model, "observe", channel)
    found = check_components(model, components, "observe")
    if distribution not in LAWS:
        raise w.wrong(
            "distribution", distribution, f"give one of: {', '.join(map(repr, LAWS))}; or write "
            "an @observation function of your own, which names the states of the components",
        )  # fmt: skip
    link, law, priors = LAWS[distribution]
    given = {"sd": sd, "df": df, "dispersion": dispersion}
    quantities: dict[str, Quantity] = {}
    for argument, value in given.items():
        if argument in priors:
            own = f"{channel}_{argument}"
            quantities[argument] = w.quantity(own, argument, value, priors[argument])
            if not quantities[argument].reads and not float(quantities[argument].text) > 0.0:
                raise w.wrong(argument, value, "give a positive number, or a prior")
        elif value is not None:
            raise w.wrong(argument, value, f"leave it out of distribution={distribution!r}")
    flat = [c for c in found if c.diffuse]
    if flat and distribution != "normal":
        raise ArgumentError(
            f"the component {flat[0].name!r} starts diffuse, as only a model with an exact "
            f"likelihood may, and {distribution!r} leaves none",
            fix=f"give it a start: ssm.structural.{flat[0].kind}(m, ..., name={flat[0].name!r}, "
            "initial=ssm.Normal(mean, sd=...)), wide enough for the first row, on the scale of "
            "the sum",
            where=user_location(),
        )
    mean, setup = summed([c.value for c in found], "mean")
    laws = {channel: law.format(mean=mean, **{n: q.text for n, q in quantities.items()})}
    read = [n for c in found for n in c.arguments]
    read += [q.reads for q in quantities.values() if q.reads]
    texts = [function_text("prior", f"{channel}_prior", w.priors, [])] if w.priors else []
    texts.append(function_text("observation", f"{channel}_observation", laws, read, setup))
    text = "\n\n\n".join(texts) + "\n"
    write(model, text, f"observation {channel!r} of {model.name}")

    def all_of(kind: str) -> tuple[str, ...]:
        return tuple(dict.fromkeys(n for c in found for n in getattr(c, kind)))

    model.components[channel] = Component(
        channel, "observation", all_of("states"), all_of("parameters"), all_of("inputs"),
        " + ".join(c.value for c in found), text, False, any(c.reads_time for c in found), link,
    )  # fmt: skip
