"""The equations of a traced model: what effects can be bound to, and what they say of each other.

What an effect is bound to (the state that integrates a rate, how far that moves in a step, what
moves along) is read off the model as it was: with the terms of another effect in its equations a
position is no plain integral any more, and means, steps and inputs are others. So a further effect
is added to the model as it was (`Augmented.origin`), beside those that are in already, and means
the same as if all had been added at once.

What one equation lacks others lack with it where they share a term. The acceleration of a cart
turns the pole on it; who is infected leaves the susceptible. A force or a loss that is missing
there is missing in every equation that holds the term: an increment g of x_i is then one of g (d
f_j / d F) / (d f_i / d F) of x_j, f the transitions' means and F the term.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ssmppl.analysis.structure import simulators
from ssmppl.diagnosis.effects.candidate import Candidate
from ssmppl.diagnosis.model.changed_laws import Index, noise_free, on_its_scale, scale_of_mean
from ssmppl.diagnosis.model.forces import Force, force_on
from ssmppl.errors import NotApplicable, SSMError
from ssmppl.expressions.arrays import array
from ssmppl.expressions.calculus import NotDifferentiable, gradient
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import (
    Expr,
    constant,
    several,
    substitute,
    symbol,
    symbols_of,
    topological,
)
from ssmppl.expressions.node import SEVERAL
from ssmppl.inference.preparation.initial_values import ordinary_values
from ssmppl.language.distributions import Dirac, Distribution
from ssmppl.language.model.trace import Site, Trace, previous, symbols

Reaction = tuple[tuple[str, Expr], ...]  # (label of another state, its increment over the own one)

_POINTS, _SMALL = 12, 1e-9  # random points of a numerical identity; its relative tolerance
_NEAR = 0.02  # that of what moves in small steps
_SHORT = 1e-3  # a length of row at which almost everything moves in small steps
_HALF = 0.1  # how far the share of the new value may then be from a half, for the higher orders
_TERM = symbol("flow", "F")  # stands for a shared term


@dataclass(frozen=True)
class Augmented(Trace):
    """A traced model with effects added, as of `augment`.

    origin : the model as it was. added : the effects, in the order in which they were added.
    names : strength -> the names of its auxiliary states in the model.
    """

    origin: Trace | None = None
    added: tuple[Candidate, ...] = ()
    names: Mapping[str, Mapping[str, str]] = field(default_factory=dict)


def as_it_was(trace: Trace) -> Trace:
    """The model without what was added to it; itself where nothing was."""
    if isinstance(trace, Augmented) and trace.origin is not None:
        return trace.origin
    return trace


def label_of(name: str, index: Index) -> str:
    """`v`, `x[0]`, `A[0, 1]`."""
    return f"{name}[{', '.join(map(str, index))}]" if index else name


@dataclass(frozen=True)
class Part:
    """One scalar component of a state, channel, input or parameter.

    symbol : its symbol where it is current (not that of the step before).
    """

    label: str
    role: str
    name: str
    index: Index
    symbol: Expr

    def seen_from(self, role: str) -> Expr:
        """Its symbol in a transition (of the step before) or in another distribution."""
        lagging = role == "transition" and self.role != "parameter"
        return previous(self.symbol) if lagging else self.symbol


class Equations:
    """The parts of a traced model by label, and which state is the integral of which.

    integral_of : state -> the state that it integrates (a position's velocity).
    share_of_new : such a state -> b of its step a v_prev + b mean(v), where b is not 0.
    copies : state -> the quantity that its transition only hands on.
    """

    def __init__(self, trace: Trace, base: Equations | None = None):
        """base : of the same model before effects were added; of itself where it has none."""
        if base is None and as_it_was(trace) is not trace:
            base = Equations(as_it_was(trace))
        self.trace = trace
        self.parts: dict[str, Part] = {}
        for role, sites in (("state", trace.initial), ("channel", trace.observations),
                            ("parameter", trace.parameters)):  # fmt: skip
            for site in sites.values():
                if site.name in trace.auxiliary:
                    continue  # of which nothing is read a row later
                for s in site.components:
                    self._add(role, s)
        for name, shape in trace.inputs.items():
            for s in symbols("input", name, shape).ravel():
                self._add("input", s)
        self.copies: dict[str, str] = base.copies if base else self._copies()
        self.integral_of: dict[str, str]
        self.share_of_new: dict[str, Expr]
        known = (base.integral_of, base.share_of_new) if base else self._integrals()
        self.integral_of, self.share_of_new = known

    def _add(self, role: str, s: Expr) -> None:
        _, name, index = s.data
        label = label_of(name, index)
        self.parts[label] = Part(label, role, name, index, s)

    def of_role(self, role: str) -> list[Part]:
        """The parts of one role, in the model's order."""
        return [p for p in self.parts.values() if p.role == role]

    def law(self, part: Part, role: str = "") -> Distribution:
        """The distribution of a state (in the transition unless role is "initial") or of a
        channel."""
        return self.site(part, role).distribution

    def site(self, part: Part, role: str = "") -> Site:
        """The site of that distribution."""
        if part.role == "channel":
            return self.trace.observations[part.name]
        return self.trace.law_of(part.symbol, "initial" if role == "initial" else "transition")

    def place(self, part: Part, role: str = "") -> tuple[str, tuple[int, ...]]:
        """The name of the site, and where in it the part is."""
        site = self.site(part, role)
        return site.name, site.index_of(part.symbol)

    def mean(self, part: Part, role: str = "") -> Expr | NotApplicable:
        """The value without noise of a state's or channel's distribution; why there is none."""
        d, (_, index) = self.law(part, role), self.place(part, role)
        scale = scale_of_mean(d)
        return scale if isinstance(scale, NotApplicable) else noise_free(d, index)

    def reading(self, part: Part) -> Expr | NotApplicable:
        """What a channel reads without noise, on the scale on which increments of its mean act."""
        d = self.law(part)
        scale = scale_of_mean(d)
        index = self.place(part)[1]
        return scale if isinstance(scale, NotApplicable) else on_its_scale(d, index)

    def step(self, part: Part) -> Expr | NotApplicable:
        """mean - x_prev: how far a state moves in a step, without noise in it nor in new values of
        others that its distribution reads."""
        mean = self._from_before(self.mean(part))
        if isinstance(mean, NotApplicable):
            return mean
        if scale_of_mean(self.law(part)) != "identity":
            return NotApplicable("its transition is no step from where it was")
        return mean - previous(part.symbol)

    def _from_before(self, mean: Expr | NotApplicable) -> Expr | NotApplicable:
        """A mean with new values that it reads replaced by their own means."""
        if isinstance(mean, NotApplicable):
            return mean
        own: dict[Expr, Expr] = {}
        for s in symbols_of(mean):
            if s.data[0] == "state":
                _, name, index = s.data
                read = Part(label_of(name, index), "state", name, index, s)
                value = self._from_before(self.mean(read))
                if isinstance(value, NotApplicable):
                    return NotApplicable(f"it reads the new value of {s!r}: {value.reason}")
                own[s] = value
        return substitute([mean], own)[0] if own else mean

    def position(self, part: Part) -> Part | None:
        """The state that integrates this one."""
        found = [p for p, v in self.integral_of.items() if v == part.label]
        return self.parts[found[0]] if found else None

    def force(self, part: Part) -> Force | None:
        """The simulator's force that acts on a state; None where it has none."""
        return force_on(self.mean(part)) if part.role == "state" else None

    def fixed_by_others(self, part: Part) -> str:
        """Why a state is no rate: what its transition does instead; "" where it is one."""
        if part.label in self.integral_of:
            return f"its transition is only the integral of {self.integral_of[part.label]}"
        if part.label in self.copies:
            return f"its transition only hands on {self.copies[part.label]}"
        return ""

    def deterministic(self, part: Part) -> bool:
        """Whether a state's transition has no noise."""
        return isinstance(self.law(part), Dirac)

    def second_order(self, part: Part) -> Expr | NotApplicable:
        """(F'F)_i / 2 of the step x_prev + F(x_prev): what an Euler step leaves out."""
        step = self.step(part)
        if isinstance(step, NotApplicable):
            return step
        total = constant(0.0)
        try:
            for other in self.of_role("state"):
                slope = gradient(step, [previous(other.symbol)])[0]
                if slope.op == "const" and slope.data == 0.0:
                    continue
                by = self.step(other)
                if isinstance(by, NotApplicable):
                    return NotApplicable(f"it depends on {other.label}: {by.reason}")
                total = total + slope * by
        except NotDifferentiable as error:
            return NotApplicable(f"its transition has no derivative: {error.found}")
        if total.op == "const":
            return NotApplicable("its transition has no second-order term")
        return 0.5 * total

    # -- kinematics
    def _copies(self) -> dict[str, str]:
        out = {}
        for part in self.of_role("state"):
            mean = self.mean(part)
            if isinstance(mean, Expr) and mean.op == "symbol":
                if mean is not previous(part.symbol) and mean.data[0] != "parameter":
                    out[part.label] = label_of(*mean.data[1:])
        return out

    def _integrals(self) -> tuple[dict[str, str], dict[str, Expr]]:
        """x with mean - x_prev = a v_prev + b mean(v), a, b >= 0 the same whatever the parameters;
        and b.

        Which covers explicit, semi-implicit and trapezoidal steps; of what moves in small steps
        within a row it is so up to their higher orders, with a = b. The parameters are varied, so
        that -k x in the equation of v does not make v an integral of x.
        """
        states = [p for p in self.of_role("state") if isinstance(self.step(p), Expr)]
        steps = {p.label: self.step(p) for p in states}
        small = {k: _in_small_steps(step) for k, step in steps.items()}
        rng = np.random.default_rng(1)
        ordinary: dict[Expr, float] = {}
        scales: dict[Expr, float] = {}
        if any(small.values()):  # which a row's length of any size is not
            ordinary = _ordinary(self.trace)
            scales = dict.fromkeys(_lengths_of_step(self.trace, steps), _SHORT)
        samples = [_values(self.trace, steps, rng, ordinary, scales) for _ in range(3)]
        out: dict[str, str] = {}
        shares: dict[str, Expr] = {}
        for p in states:
            if p.label in self.copies:
                continue
            for v in states:
                near = _NEAR if small[p.label] else _SMALL
                found = [_integral(p.label, v.label, s, near) for s in samples]
                weights = [w for w in found if w is not None]
                if v is not p and len(weights) == len(found):
                    if out.get(v.label) != p.label:
                        out[p.label] = v.label
                        share = _share_of_new(np.array(weights), small[p.label], samples)
                        shares |= {p.label: share} if share is not None else {}
                    break
        return out, shares


def _share_of_new(
    weights: np.ndarray, small: bool, samples: Sequence[dict[Any, Any]]
) -> Expr | None:
    """b of a step a v_prev + b mean(v): a number, or one times an input; None where it is 0, or is
    neither.

    weights : (3, 2) a and b at three values of parameters and inputs. small : it moves in small
    steps, which make a = b up to their higher orders.
    """
    whole = weights.sum(axis=1)
    share = weights[:, 1] / whole
    near = _NEAR if small else _SMALL
    if small:
        share = np.where(np.abs(share - 0.5) < _HALF, 0.5, share)
    if np.ptp(share) > near or np.mean(share) <= near:
        return None
    lengths = {constant(1.0): np.ones(len(samples))}
    for s in samples[0]:
        if isinstance(s, Expr) and s.data[0] == "input_prev":
            lengths[s] = np.array([float(sample[s]) for sample in samples])
    for s, length in lengths.items():
        ratio = whole / length
        if np.ptp(ratio) <= near * np.mean(ratio):
            return float(np.mean(share) * np.mean(ratio)) * s
    return None


def _ordinary(trace: Trace) -> dict[Expr, float]:
    """An ordinary value of each parameter: small steps are small where a damping is not of any
    size."""
    try:
        values = ordinary_values(trace, {}, {})
    except SSMError:
        return {}
    return {
        s: float(v)
        for name, site in trace.parameters.items()
        for s, v in zip(site.components, np.ravel(values[name]), strict=True)
    }


def _values(
    trace: Trace, steps: dict[str, Any], rng: Any, ordinary: Mapping[Expr, float],
    scales: Mapping[Expr, float],
) -> dict[Any, Any]:  # fmt: skip
    """By label, values and steps of the states at random points; by symbol, the inputs and time,
    the same at all of them.

    ordinary : values of parameters, round which these are drawn. scales : of inputs that are not
    of the size of 1.
    """
    roots = list(steps.values())
    known: dict[Any, Any] = {}
    same: dict[Any, Any] = {}
    for s in symbols_of(roots):
        fixed = s.data[0] in ("input_prev", "time_prev")
        known[s] = rng.uniform(0.3, 1.5, None if fixed else _POINTS) * scales.get(s, 1.0)
        same |= {s: known[s]} if fixed else {}
        if s in ordinary:
            known[s] = ordinary[s] * rng.uniform(0.7, 1.4, _POINTS)
    for s in trace.state_prev_symbols:
        known.setdefault(s, rng.uniform(0.3, 1.5, _POINTS))
    moved = evaluate(roots, known)
    own = {label_of(*s.data[1:]): known[s] for s in trace.state_prev_symbols}
    wide = np.zeros(_POINTS)
    return {k: (own[k], wide + m) for k, m in zip(steps, moved, strict=True)} | same


def _lengths_of_step(trace: Trace, steps: Mapping[str, Any]) -> list[Expr]:
    """The inputs without which no state moves that has an equation: lengths of a row."""
    rng, out = np.random.default_rng(2), []
    for s in {s for step in steps.values() for s in symbols_of(step)}:
        if s.data[0] == "input_prev":
            values = _values(trace, dict(steps), rng, {}, {s: 0.0})
            moved = [values[k][1] for k in steps]
            if all(np.all(np.isfinite(m)) and np.all(np.abs(m) <= _SMALL) for m in moved):
                out.append(s)
    return out


def _in_small_steps(step: Any) -> bool:
    """Whether it is made by a loop, or by a simulator, whose steps are not known."""
    return any(n.op in SEVERAL for n in topological([step]))


def _integral(x: str, v: str, values: dict[Any, Any], near: float) -> np.ndarray | None:
    """(2,) a and b with which x moves by a v_prev + b mean(v); None where it does not."""
    moved = values[x][1]
    own, by = values[v]
    if not (np.all(np.isfinite(moved)) and np.all(np.isfinite(by))):
        return None
    if not np.any(np.abs(moved) > _SMALL):
        return None
    basis = np.stack([own, own + by], axis=1)
    coefficients, *_ = np.linalg.lstsq(basis, moved, rcond=1e-10)
    rest = moved - basis @ coefficients
    exact = np.max(np.abs(rest)) <= near * np.max(np.abs(moved))
    return coefficients if exact and np.all(coefficients >= -_SMALL) else None


def time_symbol(role: str) -> Expr:
    """`t` in a transition, and in another distribution."""
    return symbol("time_prev" if role == "transition" else "time", "t")


def components(trace: Trace, role: str, name: str, shape: tuple[int, ...]) -> Any:
    """The symbols of a named quantity seen from a distribution, a node for a scalar."""
    if role == "state":
        value = trace.states[name]
    elif role in ("channel", "parameter"):
        value = (trace.observations if role == "channel" else trace.parameters)[name].value
    else:
        value = symbols("input", name, shape)
    return value[()] if array(value).shape == () else value


@dataclass(frozen=True)
class SharedTerms:
    """What moves with each state: by terms that are shared, what is `carried`, and `halfway`."""

    reactions: Mapping[str, list[Reaction]]
    carried: Mapping[str, Reaction]
    halfway: Mapping[str, Reaction]

    @classmethod
    def of(cls, equations: Equations) -> SharedTerms:
        """The shared terms of a model."""
        return cls(shared_terms(equations), carried(equations), halfway(equations))


def shared_terms(equations: Equations) -> dict[str, list[Reaction]]:
    """Label of a state -> how the others move with it, once for each set of others.

    A shared term is an expression of states or inputs, the largest of its kind, that enters the
    state's own equation with a constant factor, and the others' linearly. What integrates the state
    is not moved: see `carried`.
    """
    means = {}
    for part in equations.of_role("state"):
        mean = equations.mean(part)
        if isinstance(mean, Expr) and scale_of_mean(equations.law(part)) == "identity":
            means[part.label] = mean
    out: dict[str, list[Reaction]] = {}
    for label in means:
        part = equations.parts[label]
        if not equations.fixed_by_others(part):
            found: dict[tuple[str, ...], Reaction] = {}
            others = {k: m for k, m in means.items()
                      if k != label and equations.integral_of.get(k) != label}  # fmt: skip
            for term in _shared(means[label], others):
                reaction = _reaction(term, means[label], others)
                found.setdefault(tuple(other for other, _ in reaction), reaction)
            out[label] = [r for r in found.values() if r]
    return out


def carried(equations: Equations) -> dict[str, Reaction]:
    """Label of a state -> what integrates its new value, and so moves within the same step, as
    in semi-implicit steps, x + h v_new."""
    out: dict[str, Reaction] = {}
    for x, v in equations.integral_of.items():
        mean, whole = (equations.mean(equations.parts[label]) for label in (v, x))
        if not (isinstance(mean, Expr) and isinstance(whole, Expr)):
            continue
        if mean in set(topological([whole])):
            try:
                (slope,) = gradient(substitute([whole], {mean: _TERM})[0], [_TERM])
            except NotDifferentiable:
                continue
            if not _moving(slope) and _TERM not in symbols_of(slope):
                out[v] = ((x, slope),)
    return out


def halfway(equations: Equations) -> dict[str, Reaction]:
    """Label of a state -> what moves by half as much as in semi-implicit steps, since the row is
    integrated: a push that is constant over a row of length h, and has made a speed of g by its
    end, has moved the position by h g / 2."""
    out: dict[str, Reaction] = {}
    if simulators(equations.trace):  # a step that is not known
        return out
    known = carried(equations)
    for x, v in equations.integral_of.items():
        whole = equations.mean(equations.parts[x])
        if not isinstance(whole, Expr) or v in known or x not in equations.share_of_new:
            continue
        if equations.parts[v].symbol not in symbols_of(whole):  # else it is moved by that
            out[v] = ((x, equations.share_of_new[x]),)
    return out


def _moving(e: Expr) -> bool:
    """Whether it depends on states or inputs."""
    return any(s.data[0] in ("state_prev", "input_prev") for s in symbols_of(e))


def _shared(mean: Expr, others: Mapping[str, Expr]) -> list[Expr]:
    """What a state's equation and some other one hold, the larger first. Without a parameter,
    as h v, cos x or x_1 - x_2, it is geometry and no force or loss."""
    elsewhere = set(topological(others.values()))
    out: list[Expr] = []
    seen: set[Expr] = set()
    stack = [mean]
    while stack:
        node = stack.pop()
        if node in seen or node.op in ("symbol", "const") or not _moving(node):
            continue
        seen.add(node)
        law = any(s.data[0] == "parameter" for s in symbols_of(node))
        if law and node in elsewhere and node is not mean and not several(node):
            out.append(node)
        stack += node.args
    return out


def _reaction(term: Expr, mean: Expr, others: Mapping[str, Expr]) -> Reaction:
    """How the other equations move with one; () where the term does not enter as it has to."""
    out = []
    try:
        (own,) = gradient(substitute([mean], {term: _TERM})[0], [_TERM])
        if _moving(own) or _TERM in symbols_of(own):
            return ()
        for label, other in others.items():
            (slope,) = gradient(substitute([other], {term: _TERM})[0], [_TERM])
            if slope.op == "const" and slope.data == 0.0:
                continue
            if _TERM in symbols_of(slope):
                return ()
            out.append((label, slope / own))
    except NotDifferentiable:
        return ()
    return tuple(out)
