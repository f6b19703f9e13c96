"""Seasons and cycles (Harvey 1989, sections 2.3.3, 2.3.4 and 4.1; Durbin and Koopman 2012, section
3.2)."""

from __future__ import annotations

from typing import Any

import numpy as np

from ssmppl.arguments import checked
from ssmppl.errors import ArgumentError
from ssmppl.expressions.expr import user_location
from ssmppl.structural.component import Component, Quantity, Writer, noise, number
from ssmppl.structural.trends import UNIT

FORMS = ("dummy", "trigonometric")


@checked
def seasonal(
    model: Any, period: int, *, form: str = "dummy", harmonics: int | None = None, sd: Any = None,
    initial: Any = None, name: str = "season",
) -> Component:  # fmt: skip
    """A season: a pattern that repeats, and changes slowly.

    form="dummy" (Harvey 1989, section 2.3.4): the effects of the last `period` rows sum to a noise,

        season_t = - season_{t-1} - ... - season_{t-period+1} + N(0, sd^2)

    form="trigonometric" (section 2.3.4 too): a sum of harmonics j = 1, 2, ..., each of them turned
    by 2 pi j / period a row, with noise N(0, sd^2) on both of its components; `rotation` has the
    matrix. The last harmonic of an even period has one component.

    Parameters
    ----------
    model : it is written into this.
    period : rows after which it repeats, such as 12 of months; at least 2.
    form : "dummy" or "trigonometric".
    harmonics : how many of them, of the trigonometric form; by default all, period // 2. A long
        period, such as 365 days, takes few.
    sd : standard deviation of its step, as of `level`; 0: the pattern never changes.
    initial : distribution of each of its states at the first row, `ssm.Normal(0, sd=...)`; by
        default flat, as of `level`.
    name : of the component and of its state. In the dummy form `<name>_past` has the effects of
        earlier rows.

    Returns
    -------
    Component : to be handed to `observe` and `plot_components`.

    Raises
    ------
    ArgumentError : an argument is of the wrong kind, or the model has a component of this name.
    """
    w = Writer(model, "seasonal", name)
    period = _whole(w, "period", period, 2)
    if form not in FORMS:
        raise w.wrong("form", form, f"give one of: {', '.join(map(repr, FORMS))}")
    if form == "dummy" and harmonics is not None:
        raise w.wrong("harmonics", harmonics, 'give form="trigonometric" with it')
    step = w.sd(f"{name}_sd", "sd", sd)
    reads = [step.reads] if step.reads else []
    if form == "trigonometric":
        n = _whole(w, "harmonics", period // 2 if harmonics is None else harmonics, 1)
        if n > period // 2:
            raise w.wrong("harmonics", harmonics, f"at most {period // 2}, of a period of {period}")
        turn = f"ssm.structural.rotation({period}, {n})"
        size = 2 * n - (2 * n == period)
        w.state(name, w.start("initial", initial, size), noise(f"{turn} @ {name}", step))
        return w.add(f"sum({name}[::2])", parameters=reads)
    past = f"{name}_past"
    if period == 2:
        w.state(name, w.start("initial", initial), noise(f"-{name}", step))
        return w.add(name, parameters=reads)
    w.state(name, w.start("initial", initial), noise(f"-{name} - {past}.sum()", step))
    moved = f"ssm.Dirac(np.append({name}, {past}[:-1]))"
    w.state(past, w.start("initial", initial, period - 2), moved)
    return w.add(name, parameters=reads)


@checked
def cycle(
    model: Any, period: Any, *, damping: Any = None, sd: Any = None, initial: Any = None,
    name: str = "cycle",
) -> Component:  # fmt: skip
    """A cycle of a length that is not known exactly (Harvey 1989, section 2.3.3).

        cycle_t = damping R cycle_{t-1} + N(0, sd^2 I),  R the rotation by 2 pi / period

    The state is a vector (2,), of which the first component is the cycle. Damped, it is stationary,
    and starts so, with the variance sd^2 / (1 - damping^2).

    Parameters
    ----------
    model : it is written into this.
    period : rows of a turn: a pair (low, high), between which it is uniform; a distribution as its
        prior; a number where it is known; or the name of a parameter. More than 2. What is shorter
        than the bounds, or longer, is a season's or a trend's: without bounds they are not told
        apart.
    damping : what is left of it after a row: by default a parameter, uniform on (0, 1); else a
        distribution as its prior, a number, or the name of a parameter. 1: it is not damped, and
        starts diffuse.
    sd : standard deviation of its step, as of `level`.
    initial : distribution of both components at the first row, `ssm.Normal(0, sd=...)`; by default
        the stationary one, or where there is none a flat one. statsmodels has a flat one always:
        `ssm.Flat()`.
    name : of the component and of its state; its parameters are `<name>_period`, `<name>_damping`
        and `<name>_sd`.

    Returns
    -------
    Component : to be handed to `observe` and `plot_components`.

    Raises
    ------
    ArgumentError : an argument is of the wrong kind, or the model has a component of this name.
    """
    w = Writer(model, "cycle", name)
    length = _period(w, period)
    share = w.quantity(f"{name}_damping", "damping", damping, UNIT)
    if not share.reads and not 0.0 < float(share.text) <= 1.0:
        raise w.wrong("damping", damping, "it is a share, above 0 and at most 1")
    step = w.sd(f"{name}_sd", "sd", sd)
    still = share.text == "1" or step.zero
    if initial is None and not still:
        spread = f"{step.text} / np.sqrt(1 - {share.text}**2)"
        start = f"ssm.Normal(np.zeros(2), sd={spread})"
    else:
        start = w.start("initial", initial, 2)
    damped = "" if share.text == "1" else f"{share.text} * "
    turned = f"{damped}ssm.structural.rotation({length.text}) @ {name}"
    w.state(name, start, noise(turned, step))
    reads = [q.reads for q in (length, share, step) if q.reads]
    return w.add(f"{name}[0]", parameters=reads)


def _period(w: Writer, given: Any) -> Quantity:
    name, fix = f"{w.name}_period", "give bounds in rows, such as period=(18, 150), of more than 2"
    if isinstance(given, (tuple, list)):
        try:
            low, high = map(float, given)
        except (TypeError, ValueError):
            raise w.wrong("period", given, fix) from None
        if not 2.0 <= low < high < np.inf:
            raise w.wrong("period", given, fix)
        prior = f"ssm.Uniform({number(low)}, {number(high)})"
        w.priors[name] = prior
        return Quantity(name, name, prior)
    found = w.quantity(name, "period", given)
    if not found.reads and float(found.text) <= 2.0:
        raise w.wrong("period", given, fix)
    return found


def _whole(w: Writer, argument: str, given: Any, least: int) -> int:
    value = np.asarray(given)
    if value.shape != () or value.dtype.kind not in "iuf" or float(value) != int(value) \
            or value < least:  # fmt: skip
        raise w.wrong(argument, given, f"give a whole number of at least {least}")
    return int(value)


def rotation(period: Any, harmonics: int = 1) -> Any:
    """The matrix that turns each harmonic of a period by one row.

    Parameters
    ----------
    period : rows of a turn; a number, or a parameter.
    harmonics : how many, n. At most period / 2 where the period is a number.

    Returns
    -------
    array (2 n, 2 n)
        Blocks [[cos, sin], [-sin, cos]] of 2 pi j / period, j = 1, ..., n. Where 2 n is the period
        the last block is the number -1, as its second component would never be seen: (2 n - 1,
        2 n - 1).

    Raises
    ------
    ArgumentError : harmonics is no whole number from 1 on, or more than half of the period.
    """
    known = isinstance(period, (int, float, np.number))
    if not isinstance(harmonics, (int, np.integer)) or harmonics < 1 \
            or (known and 2 * harmonics > max(period, 2)):  # fmt: skip
        raise ArgumentError(
            f"rotation: harmonics={harmonics!r} of a period of {period}",
            fix="give a whole number from 1 to half of the period",
            where=user_location(),
        )
    blocks = []
    for j in range(1, harmonics + 1):
        angle = 2.0 * np.pi * j / period
        if known and 2 * j == period:
            blocks.append([[-1.0]])
        else:
            cos, sin = np.cos(angle), np.sin(angle)
            blocks.append([[cos, sin], [-sin, cos]])
    n = sum(map(len, blocks))
    out: list[list[Any]] = [[0.0] * n for _ in range(n)]
    at = 0
    for block in blocks:
        for i, row in enumerate(block):
            out[at + i][at : at + len(row)] = row
        at += len(block)
    return np.array(out) if known else np.stack([np.stack(row) for row in out])
