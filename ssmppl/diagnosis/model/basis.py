"""The basis in which a missing term is written, as candidates that need no form to be guessed.

For every equation with noise: increments of its mean by smooth functions of each state and input,
by products of two of them, by what goes up and down with a state (a cogging, a ripple, a kink: a
Fourier series, alone and times each input), and by the past of what moves the system; and
increments of the log of its variance by smooth functions. Their scores tell where the gap is,
whatever its form.

The functions are polynomials in s = tanh(z / `BEND`), z the standardised variable, orthonormal over
its values: next to polynomials in z where the data are, and level beyond them. (Hermite functions,
which vanish there, leave a third of a quadratic drag over normal values unexplained.) Written with
NumPy's functions alone: the same object is called on numbers and on symbols of a model.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np

from ssmppl.analysis.structure import simulators
from ssmppl.diagnosis.effects.candidate import Candidate
from ssmppl.diagnosis.effects.effect import Auxiliary, Effect, numbers
from ssmppl.diagnosis.model.candidates import slug
from ssmppl.diagnosis.model.changed_laws import has_scale, scale_of_mean
from ssmppl.diagnosis.model.equations import Equations, Part, Reaction, as_it_was, carried
from ssmppl.diagnosis.model.scales import Scales
from ssmppl.errors import ArgumentError, NotApplicable
from ssmppl.expressions.arrays import array
from ssmppl.expressions.expr import symbol, symbols_of
from ssmppl.language.distributions import Dirac, Distribution
from ssmppl.language.model.trace import Trace

BEND = 2.0  # standard deviations at which the functions begin to level off
MEAN, SCALE = 4, 2  # functions of a variable, for the mean and for the scale
# Degrees of the functions in a product of two variables; with more than `FEW` of these the first.
DEGREES, FEW, FIRST = ((1, 1), (2, 1), (1, 2), (2, 2), (3, 1), (1, 3)), 4, 3
PAST = ("past_1", "past_2", "past_3")  # low-passes in a row
REACH = 6.0  # the time constant of each, in rows
RING = ("ring_1", "ring_2")  # a resonance: what is in step with it, and a quarter turn behind
# Rows to a turn: so close that with a ring that dies away within a turn none between two is missed.
TURNS = tuple(6.0 * 1.4**k for k in range(7))
# Waves of a state in four of its standard deviations: finer than the curves follow, and so close
# that of a wave between two of them these hold four fifths. Beyond, they are level. Apart by how
# fine they are, as many functions see less than few; times inputs the first alone.
SERIES = {"Fourier": range(2, 7), "fine Fourier": range(7, 13), "very fine Fourier": range(13, 25)}
EITHER_SIDE = 2.0
WHERE = " where "  # a curve of one variable, at a value of another


@dataclass(frozen=True)
class Smooth:
    """Polynomial in tanh((x - centre) / width) by its coefficients, the constant first."""

    centre: float
    width: float
    coefficients: tuple[float, ...]

    @property
    def order(self) -> int:
        """Degree of the polynomial."""
        return len(self.coefficients) - 1

    def __call__(self, x: Any) -> Any:
        s = np.tanh((x - self.centre) / self.width)
        value: Any = self.coefficients[-1] + 0.0 * s
        for c in self.coefficients[-2::-1]:
            value = value * s + c
        return value


def bases(x: Any, count: int = 6) -> tuple[Smooth, ...]:
    """The constant and `count - 1` functions of one variable, orthonormal over its values.

    Fewer where the variable takes fewer values than that.

    Parameters
    ----------
    x : values (any shape; NaN left out), or (centre, sd) as a tuple of two numbers: the functions
        are then orthonormal under a normal distribution.

    Raises
    ------
    ArgumentError : no finite value, or all the same.
    """
    if isinstance(x, tuple):
        centre, sd = float(x[0]), float(x[1])
        nodes, weights = np.polynomial.hermite_e.hermegauss(60)
        values, weights = centre + sd * nodes, weights / weights.sum()
    else:
        values = np.asarray(x, float).ravel()
        values = values[np.isfinite(values)]
        centre, sd = (float(values.mean()), float(values.std())) if values.size else (0.0, 0.0)
        weights = np.full(values.shape, 1.0 / max(values.size, 1))
    if not sd > 1e-12 * abs(centre):
        raise ArgumentError(
            f"a variable with centre {centre:g} and standard deviation {sd:g}",
            fix="leave a variable that does not vary out of the basis",
        )
    powers = np.tanh((values - centre) / (BEND * sd))[:, None] ** np.arange(count)
    _, r = np.linalg.qr(powers * np.sqrt(weights)[:, None])
    distinct = int(np.sum(np.abs(np.diagonal(r)) > 1e-8))
    signs = np.sign(np.diagonal(r))[:distinct]
    # powers = Q r, so that Q = powers r^-1: column n holds the coefficients of the n-th function.
    mixed = np.linalg.inv(r[:distinct, :distinct]) * signs
    return tuple(Smooth(centre, BEND * sd, tuple(mixed[: n + 1, n].tolist()))
                 for n in range(distinct))  # fmt: skip


CURVES = bases((0.0, 1.0), MEAN + 1)[1:]  # of a standardised variable, without the constant


@dataclass(frozen=True)
class BasisTerm:
    """One basis function in one equation.

    moment : "mean" or "scale". variable : what it is a function of, in words. function : of a
    single variable, with its centre and width; None of products and of what is past. factors : the
    variables, each with the number of its function in `CURVES`, from 1; none of what is past.
    over : of the Fourier series, which are looked at apart, as they are many, the state, with where
    the input is that it is multiplied by: one standard deviation above its mean.
    """

    candidate: Candidate
    equation: str
    moment: str
    variable: str
    function: Callable[..., Any] | None = None
    centre: float = 0.0
    width: float = 1.0
    factors: tuple[tuple[str, int], ...] = ()
    over: str = ""

    @property
    def is_curve(self) -> bool:
        """Whether it is a smooth function of the present value of one variable."""
        return self.function is not None and not self.series

    @property
    def series(self) -> str:
        """The Fourier series that it is of; "" where it is of none."""
        return self.variable if self.over else ""

    def at(self, values: Any) -> Any:
        """The function at values of the variable, or of the state that it is `over`."""
        assert self.function is not None
        return self.function((values - self.centre) / self.width)


def basis(trace: Trace, scales: Scales) -> list[BasisTerm]:
    """The terms of all equations that have noise."""
    equations = Equations(as_it_was(trace))
    states, inputs = equations.of_role("state"), equations.of_role("input")
    varying = [p for p in [*states, *inputs] if scales.scale[p.label].sd > 0.0]
    noisy = [p for p in states if not equations.deterministic(p)]
    out: list[BasisTerm] = []
    for part in [*noisy, *equations.of_role("channel")]:
        state = part.role == "state"
        own = [v for v in varying if state or v.role != "input"]
        law = equations.law(part)
        if not isinstance(scale_of_mean(law), NotApplicable):
            kind = "transition" if state else "observation"
            read = own if state else _measured(equations.law(part), own)
            out += [_curve(part, "mean", kind, v, k, scales) for v in read for k in range(MEAN)]
            if state:
                out += _products(part, own, scales)
                out += _fourier(part, own, scales, bool(simulators(trace)))
                moving = [v for v in own if v in noisy or v.role == "input"]
                out += [_past(part, v, k, scales) for v in moving for k in range(len(PAST))]
                driving = [v for v in moving if v is part or v.role == "input"]
                out += [_ring(part, v, turn, k, scales)
                        for v in driving for turn in TURNS for k in range(len(RING))]  # fmt: skip
        if not isinstance(has_scale(law), NotApplicable):
            out += [_curve(part, "scale", "noise", v, k, scales) for v in own for k in range(SCALE)]
    moved = carried(equations)
    return [_with_it(t, moved) if t.candidate.change == "transition" else t for t in out]


def _with_it(term: BasisTerm, moved: Mapping[str, Reaction]) -> BasisTerm:
    """The term with what moves within the step."""
    along = moved.get(term.equation, ())
    return replace(term, candidate=replace(term.candidate, carried=along)) if along else term


def _measured(law: Distribution, states: Sequence[Part]) -> list[Part]:
    """The states that a channel's distribution depends on; all of them where it depends on none."""
    inside = symbols_of([e for p in law.parameters.values() for e in array(p).ravel()])
    return [s for s in states if s.seen_from("observation") in inside] or list(states)


def _term(
    part: Part, moment: str, variable: str, name: str, kind: str, function: Callable[..., Any],
    shape: Mapping[str, float], bound: Mapping[str, Part], strength: str, *,
    states: Sequence[str] = (), shares: str = "",
) -> BasisTerm:  # fmt: skip
    """A basis function as an effect that is bound: argument -> the state or input it stands for."""
    effect = Effect(
        name=name, kind=kind, function=function, on=part.label,
        shapes={n: numbers(v) for n, v in shape.items()},
        given=dict.fromkeys(bound, "other state"), states=dict.fromkeys(states),
    )  # fmt: skip
    candidate = Candidate(
        effect, part.label, tuple(shape.items()), tuple((a, v.label) for a, v in bound.items()),
        part.role, slug(strength), shares=slug(shares) if shares else "",
    )  # fmt: skip
    return BasisTerm(candidate, part.label, moment, variable)


def _curve(part: Part, moment: str, kind: str, variable: Part, k: int, scales: Scales) -> BasisTerm:
    curve = CURVES[k]

    def term(own, z, strength, centre, width):
        return strength * curve((z - centre) / width)

    label, scale = variable.label, scales.scale[variable.label]
    found = _term(
        part, moment, label, f"curve {k + 1} of {label}", kind, term,
        {"centre": scale.mean, "width": scale.sd}, {"z": variable},
        f"curve {k + 1} {moment} {part.label} {label}",
    )  # fmt: skip
    return replace(
        found, function=curve, centre=scale.mean, width=scale.sd, factors=((label, k + 1),)
    )


def _products(part: Part, variables: Sequence[Part], scales: Scales) -> list[BasisTerm]:
    """Terms that are products of functions of two variables."""
    degrees = DEGREES if len(variables) <= FEW else DEGREES[:FIRST]
    out = []
    for a, b in combinations(variables, 2):
        x, y = scales.scale[a.label], scales.scale[b.label]
        shape = {"centre": x.mean, "width": x.sd, "centre_w": y.mean, "width_w": y.sd}
        for i, j in degrees:
            found = _term(
                part, "mean", f"{a.label} and {b.label}",
                f"product {i} {j} of {a.label} and {b.label}", "transition",
                _product(CURVES[i - 1], CURVES[j - 1]), shape, {"z": a, "w": b},
                f"product {i} {j} {part.label} {a.label} {b.label}",
            )  # fmt: skip
            out.append(replace(found, factors=((a.label, i), (b.label, j))))
    return out


def _product(first: Smooth, second: Smooth) -> Callable[..., Any]:
    def term(own, z, w, strength, centre, width, centre_w, width_w):
        return strength * first((z - centre) / width) * second((w - centre_w) / width_w)

    return term


def _fourier(
    part: Part, variables: Sequence[Part], scales: Scales, called: bool
) -> list[BasisTerm]:
    """Waves of each state, and the longer ones times each input; with many variables the waves
    alone, and where a simulator is called the longer ones, as its functions are not compiled."""
    inputs = [v for v in variables if v.role == "input"] if len(variables) <= FEW else []
    out = []
    for state in (v for v in variables if v.role == "state"):
        for series, waves in list(SERIES.items())[: 1 if called else None]:
            for times in (None, *inputs) if series == "Fourier" else (None,):
                out += _waves(part, state, times, series, waves, scales)
    return out


def _waves(
    part: Part, state: Part, times: Part | None, series: str, waves: range, scales: Scales
) -> list[BasisTerm]:
    """So many waves of a state, cosines and sines; all of them share what they are made of."""
    x, over = scales.scale[state.label], state.label
    name, shares = f"a {series} series in {over}", f"waves {part.label} {over}"
    shape, bound = {"centre": x.mean, "width": x.sd}, {"z": state}
    if times is not None:
        y = scales.scale[times.label]
        shape |= {"centre_w": y.mean, "width_w": y.sd}
        bound, shares = {**bound, "w": times}, f"{shares} {times.label}"
        name, over = (
            f"{name} times {times.label}",
            f"{over}{WHERE}{times.label} = {y.mean + y.sd:.3g}",
        )
    out = []
    for number in waves:
        for of in ("cos", "sin"):
            function = _wave(number, of == "sin")
            found = _term(
                part, "mean", name, f"{of} {number} of {name}", "transition",
                _along(function, times is not None), shape, bound, f"{of} {number} {shares}",
                shares=shares,
            )  # fmt: skip
            out.append(replace(found, function=function, centre=x.mean, width=x.sd, over=over))
    return out


def _wave(number: int, sine: bool) -> Callable[..., Any]:
    """Of a standardised variable; by the angles' addition, so that one cosine serves all."""

    def function(z: Any) -> Any:
        angle = np.pi / EITHER_SIDE * np.clip(z, -EITHER_SIDE, EITHER_SIDE)
        c, s = np.cos(angle), np.sin(angle)
        even, odd = c, s
        for _ in range(number - 1):
            even, odd = even * c - odd * s, odd * c + even * s
        return odd if sine else even

    return function


def _along(function: Callable[..., Any], with_input: bool) -> Callable[..., Any]:
    def alone(own, z, strength, centre, width):
        return strength * function((z - centre) / width)

    def times(own, z, w, strength, centre, width, centre_w, width_w):
        return alone(own, z, strength, centre, width) * (w - centre_w) / width_w

    return times if with_input else alone


def _past(part: Part, variable: Part, k: int, scales: Scales) -> BasisTerm:
    """The variable through k + 1 low-passes in a row: B. de Vries and J. Principe, *Neural
    Networks* 5, 1992. All k of a variable share these states."""

    def term(own, z, past_1, past_2, past_3, strength, centre, width):
        past = past_1, past_2, past_3
        before = (z - centre) / width, past_1, past_2
        laws = {n: Dirac(p + (b - p) / REACH) for n, p, b in zip(PAST, past, before, strict=True)}
        return Auxiliary(strength * past[k], laws, {n: Dirac(0.0) for n in PAST})

    label, scale = variable.label, scales.scale[variable.label]
    return _term(
        part, "mean", f"the past of {label}", f"past {k + 1} of {label}", "state", term,
        {"centre": scale.mean, "width": scale.sd}, {"z": variable},
        f"past {k + 1} {part.label} {label}", states=PAST, shares=f"past {label}",
    )  # fmt: skip


def _ring(part: Part, variable: Part, turn: float, k: int, scales: Scales) -> BasisTerm:
    """What a resonator with `turn` rows to a turn makes of the variable: both phases share its
    states. It dies away by a factor e within a turn."""
    keep, angle = np.exp(-1.0 / turn), 2.0 * np.pi / turn
    ring = {"along": keep * np.cos(angle), "across": keep * np.sin(angle), "gain": 2 * (1 - keep)}

    def term(own, z, ring_1, ring_2, strength, centre, width, along, across, gain):
        driven = along * ring_1 - across * ring_2 + gain * (z - centre) / width
        laws = {"ring_1": Dirac(driven), "ring_2": Dirac(across * ring_1 + along * ring_2)}
        return Auxiliary(strength * (ring_1, ring_2)[k], laws, {n: Dirac(0.0) for n in RING})

    label, scale = variable.label, scales.scale[variable.label]
    shape = {"centre": scale.mean, "width": scale.sd, **{n: float(v) for n, v in ring.items()}}
    name = f"ring {turn:.0f} of {label}"
    return _term(
        part, "mean", f"the ringing of {label} at {turn:.0f} rows", f"{name}, phase {k + 1}",
        "state", term, shape, {"z": variable}, f"ring {k + 1} {turn:.0f} {part.label} {label}",
        states=RING, shares=name,
    )  # fmt: skip


def symbolic_shapes(
    candidates: Sequence[Candidate], *, of_time: bool = False
) -> tuple[list[Candidate], dict[str, float]]:
    """Candidates whose shapes are symbols, and the values of these: code that fits all data.

    Shapes that tell a number of states stay numbers, and those of functions of time unless
    `of_time`, whose symbols come last.
    """
    out: list[Candidate] = []
    values: dict[str, float] = {}
    dates: dict[str, float] = {}
    for c in candidates:
        lengths = {n for n in c.effect.states.values() if n is not None}
        shape: list[tuple[str, Any]] = []
        for name, value in c.shape:
            timed = bool(c.effect.profile)
            if name in lengths or (timed and (c.held or not of_time)):
                shape.append((name, value))
                continue
            own = f"{c.shares or c.strength}_{name}"
            (dates if timed else values)[own] = value
            shape.append((name, symbol("parameter", own, ())))
        out.append(replace(c, shape=tuple(shape)))
    return out, values | {n: float(v) for n, v in dates.items()}
