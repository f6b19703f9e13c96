"""Regressions, interventions and autoregressions."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from ssmppl.arguments import checked
from ssmppl.errors import ArgumentError, listing
from ssmppl.expressions.expr import user_location
from ssmppl.language.distributions import Distribution
from ssmppl.structural.component import (
    Component,
    Writer,
    constant_of,
    noise,
    number,
)

KINDS = {  # what an effect of 1 adds at row t
    "step": "np.where(t >= {row}, 1, 0)",
    "pulse": "np.where(t == {row}, 1, 0)",
    "ramp": "np.maximum(t - {row} + 1, 0)",
}


@checked
def regression(
    model: Any, inputs: Any, *, coefficients: Any = None, random_walk: bool = False,
    sd: Any = None, name: str = "regression",
) -> Component:  # fmt: skip
    """A linear effect of inputs, of coefficients that are fixed or move as random walks.

        input_1 input_1_coefficient + input_2 input_2_coefficient + ...

    Parameters
    ----------
    model : it is written into this; its inputs are declared there, ssm.Model(..., inputs=(...)).
    inputs : names of inputs; a single one may be given as it is.
    coefficients : a distribution as the prior of each of them, or of their values at the first row
        where they move; by default flat.
    random_walk : whether they move, as states: coefficient_t = coefficient_{t-1} + N(0, sd^2), with
        a standard deviation `<input>_coefficient_sd` for each. Else they are parameters.
    sd : of random walks, for each of them, as of `level`; 0: states that never move, so that the
        likelihood is that with the coefficients integrated out.
    name : of the component.

    Returns
    -------
    Component
        Its parameters, or states, are `<input>_coefficient`.

    Raises
    ------
    ArgumentError : the model has no such input, another argument is of the wrong kind, or the model
        has a component of this name.
    """
    w = Writer(model, "regression", name)
    names = [inputs] if isinstance(inputs, str) else inputs
    if not isinstance(names, Iterable):
        raise w.wrong("inputs", inputs, 'give names of inputs of the model, ("temperature",)')
    names = list(dict.fromkeys(names))
    if not names:
        raise w.wrong("inputs", inputs, "give at least one input of the model")
    for n in names:
        if n not in w.model.inputs:
            wanted = ", ".join(map(repr, [*w.model.inputs, n]))
            raise ArgumentError(
                f"ssm.structural.regression: the model has no input {n!r}; it has "
                f"{listing(str(n), w.model.inputs)}",
                fix=f"declare it: ssm.Model(..., inputs=({wanted},))",
                where=user_location(),
            )
    if sd is not None and not random_walk:
        raise w.wrong("sd", sd, "give random_walk=True with it, or leave it out")
    terms, reads = [], []
    for n in names:
        own, shape = f"{n}_coefficient", w.model.inputs[n]
        size = shape[0] if shape else None
        terms.append(f"sum({own} * {n})" if shape else f"{own} * {n}")
        start = w.start("coefficients", coefficients, size)
        if not random_walk:
            w.priors[own] = start
            if start.startswith("ssm.Dirac"):
                raise w.wrong("coefficients", coefficients, "give a distribution as their prior")
            continue
        step = w.sd(f"{own}_sd", "sd", sd)
        reads += [step.reads] if step.reads else []
        w.state(own, start, noise(own, step))
    return w.add(" + ".join(terms), names, reads)


@checked
def intervention(
    model: Any, row: int, *, kind: str = "step", effect: Any = None, name: str | None = None
) -> Component:
    """A change at a known row (Box and Tiao 1975, JASA 70, 70-79).

    Parameters
    ----------
    model : it is written into this.
    row : the first row that has it, counted from 1. Of a date it is
        ``np.searchsorted(dates, np.datetime64("1983-02-01")) + 1``.
    kind : "step", which stays; "pulse", at this row alone; "ramp", which grows by 1 with each row
        from it on.
    effect : a distribution as the prior of its size, a number, or the name of a parameter; by
        default flat.
    name : of the component and of its parameter; by default `<kind>_<row>`.

    Returns
    -------
    Component : to be handed to `observe` and `plot_components`.

    Raises
    ------
    ArgumentError : an argument is of the wrong kind, or the model has a component of this name.
    """
    value = np.asarray(row)
    numbered = value.shape == () and value.dtype.kind in "iu" and value >= 1
    own = f"{kind}_{row}" if numbered and kind in KINDS else "change"
    w = Writer(model, "intervention", own if name is None else name)
    if kind not in KINDS:
        raise w.wrong("kind", kind, f"give one of: {', '.join(map(repr, KINDS))}")
    if not numbered:
        raise w.wrong(
            "row", row, "give the number of a row, counted from 1; of a date it is "
            "np.searchsorted(dates, date) + 1",
        )  # fmt: skip
    size = w.quantity(w.name, "effect", effect, "ssm.Flat()")
    shape = KINDS[kind].format(row=int(value))
    return w.add(
        f"{size.text} * {shape}", parameters=[size.reads] if size.reads else [], reads_time=True
    )


@checked
def autoregression(
    model: Any, order: int = 1, *, coefficients: Any = None, sd: Any = None, initial: Any = None,
    name: str = "ar",
) -> Component:  # fmt: skip
    """A stationary autoregression, round 0.

        ar_t = c_1 ar_{t-1} + ... + c_p ar_{t-p} + N(0, sd^2)

    By default it starts in its stationary distribution. Of order 1 its parameter is
    `<name>_coefficient`, uniform on (-1, 1). Of a higher order it is `<name>_partial`, the partial
    autocorrelations, each uniform on (-1, 1): these are all stationary autoregressions, and no
    others (Barndorff-Nielsen and Schou 1973, J. Multivariate Analysis 3, 408-419);
    `ar_coefficients` gives the coefficients.

    Parameters
    ----------
    model : it is written into this.
    order : p, from 1 on.
    coefficients : the prior of the coefficients themselves, the parameter `<name>_coefficients`
        (p,), as a distribution of numbers or of a vector; or their values. What is not stationary
        has density 0 under the stationary start: of priors that allow it, give `initial` too.
    sd : standard deviation of its step, as of `level`.
    initial : distribution of the first p values, `ssm.Normal(0, sd=...)` for each; by default the
        stationary one.
    name : of the component and of its state, which is a vector (p,) of the last values where p > 1.

    Returns
    -------
    Component : to be handed to `observe` and `plot_components`.

    Raises
    ------
    ArgumentError : an argument is of the wrong kind, or the model has a component of this name.
    """
    w = Writer(model, "autoregression", name)
    value = np.asarray(order)
    if value.shape != () or value.dtype.kind not in "iu" or value < 1:
        raise w.wrong("order", order, "give a whole number from 1 on")
    p = int(value)
    step = w.sd(f"{name}_sd", "sd", sd)
    reads = [step.reads] if step.reads else []
    if step.zero:
        raise w.wrong("sd", sd, "an autoregression without noise is none: give a positive number")
    if p == 1:
        one = f"{name}_coefficient"
        own = w.quantity(one, "coefficients", coefficients, "ssm.Uniform(-1, 1)")
        start = f"ssm.Normal(0, sd={step.text} / np.sqrt(1 - {own.text}**2))"
        if initial is not None:
            start = w.start("initial", initial)
        w.state(name, start, noise(f"{own.text} * {name}", step))
        return w.add(name, parameters=[*reads, *([own.reads] if own.reads else [])])
    told, lines, by = _coefficients(w, p, coefficients)
    reads += [told] if told else []
    start = (
        f"ssm.MvNormal(np.zeros({p}), covariance=ssm.structural.ar_covariance({step.text}, {by}))"
    )
    w.setup["transition"] = lines
    if initial is not None:
        start = w.start("initial", initial, p)
    zeros = ", ".join([f"{step.text}**2", *["0"] * (p - 1)])
    if p > 4:
        zeros = f"{step.text}**2, *[0] * {p - 1}"
    ahead = f"np.append(c @ {name}, {name}[:-1])"
    w.state(name, start, f"ssm.MvNormal({ahead}, covariance=np.diag([{zeros}]))")
    return w.add(f"{name}[0]", parameters=reads)


def _coefficients(w: Writer, p: int, given: Any) -> tuple[str, tuple[str, ...], str]:
    """(the parameter, the statements that make `c` of it, the argument of `ar_covariance`)."""
    if given is None:
        own = f"{w.name}_partial"
        w.priors[own] = f"ssm.Uniform(np.full({p}, -1), np.full({p}, 1))"
        return own, (f"c = ssm.structural.ar_coefficients({own})",), f"partial={own}"
    own = f"{w.name}_coefficients"
    if isinstance(given, str):
        w.quantity(own, "coefficients", given)
        own = given
    elif isinstance(given, Distribution):
        shapes = [constant_of(v) for v in given.parameters.values()]
        if given.shape == (p,) and all(v is not None for v in shapes):
            w.quantity(own, "coefficients", given)
        else:
            w.priors[own] = w.start("coefficients", given, p)
    else:
        values = np.asarray(given)
        if values.dtype.kind not in "iuf" or values.shape != (p,) or not np.isfinite(values).all():
            raise w.wrong(
                "coefficients", given, f"give {p} numbers, or a distribution as their prior"
            )
        own = f"np.array([{', '.join(number(float(v)) for v in values)}])"
        return "", (f"c = {own}",), f"coefficients={own}"
    return own, (f"c = {own}",), f"coefficients={own}"


def ar_coefficients(partial: Any) -> Any:
    """The coefficients of an autoregression of its partial autocorrelations (Durbin 1960, Review of
    the International Statistical Institute 28, 233-244; Monahan 1984, Biometrika 71, 403-404).

    Parameters
    ----------
    partial : (p,) numbers, or a parameter of a model, each in (-1, 1).

    Returns
    -------
    array (p,)
        Of the value of the row before, of that before it, and so on. Of draws, apply it to each.
    """
    c = partial[:1]
    for k in range(1, len(partial)):
        c = np.append(c - partial[k] * c[::-1], partial[k])
    return c


def ar_covariance(sd: Any, *, coefficients: Any = None, partial: Any = None) -> Any:
    """The covariance of p successive values of a stationary autoregression, by Durbin's and
    Levinson's recursions (Brockwell and Davis 1991, "Time series: theory and methods", section
    5.2).

    Parameters
    ----------
    sd : standard deviation of its step; a number, or a parameter of a model, as the others.
    coefficients, partial : exactly one of them, (p,): the coefficients, or the partial
        autocorrelations.

    Returns
    -------
    array (p, p)
        Of coefficients, positive definite if and only if they are stationary.

    Raises
    ------
    ArgumentError : not exactly one of the two is given.
    """
    if (coefficients is None) == (partial is None):
        raise ArgumentError(
            "ar_covariance takes one of coefficients= and partial=",
            fix="write ssm.structural.ar_covariance(sd, coefficients=c)",
            where=user_location(),
        )
    steps: list[Any] = []  # the coefficients of each order, from the last on where they are given
    if partial is None:
        c = coefficients
        while len(c) > 1:
            steps.insert(0, c)
            c = (c[:-1] + c[-1] * c[:-1][::-1]) / (1.0 - c[-1] ** 2)
        steps.insert(0, c)
    else:
        steps = [ar_coefficients(partial[: k + 1]) for k in range(len(partial))]
    variance = sd**2
    for c in steps:
        variance = variance / (1.0 - c[-1] ** 2)
    rho = [1.0]  # autocorrelations, each from those before
    for k in range(1, len(steps)):
        rho.append(sum(steps[k - 1][i] * rho[k - 1 - i] for i in range(k)))
    p = len(steps)
    return np.stack([np.stack([variance * rho[abs(i - j)] for j in range(p)]) for i in range(p)])
