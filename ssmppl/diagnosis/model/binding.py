"""An effect's function called with the symbols of one equation of one model."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ssmppl.diagnosis.effects.candidate import Candidate
from ssmppl.diagnosis.effects.effect import PROFILES, Auxiliary, Effect
from ssmppl.diagnosis.model.equations import Equations, Part, components, time_symbol
from ssmppl.errors import ModelError, NotApplicable, listing
from ssmppl.expressions.arrays import array
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import Expr, as_expr, constant, substitute, symbol, symbols_of, to_text
from ssmppl.expressions.zero import wide_points
from ssmppl.language.distributions import Distribution
from ssmppl.language.model.calling import call
from ssmppl.language.model.trace import previous, symbols

_POINTS = 200  # at which an effect of strength 0 is held against the model
_WITHOUT_STATES = ("parameter", "input", "time")  # what an initial law may depend on


@dataclass
class Bound:
    """The changes that a candidate makes to one distribution of the model.

    changes : label of the part -> increment, or value in its place.
    transition, initial : distributions of its auxiliary states, by name in the model.
    """

    changes: dict[str, Expr] = field(default_factory=dict)
    transition: dict[str, Distribution] = field(default_factory=dict)
    initial: dict[str, Distribution] = field(default_factory=dict)


def bind(
    candidate: Candidate, equations: Equations, role: str, names: Mapping[str, str] | None = None,
    *, own: bool = False,
) -> Bound:  # fmt: skip
    """Call the effect's function as part of a distribution.

    Parameters
    ----------
    role : "initial", "transition" or "observation": whose symbols it sees.
    own : without what moves with its equation.
    names : auxiliary state -> its name in the model; by default its own.

    Raises
    ------
    ModelError : the function raises, asks for what the model does not have, or returns something
        else than its kind says; names its line.
    """
    effect, part = candidate.effect, equations.parts[candidate.equation]
    names = dict(names or {})
    arguments = _arguments(candidate, equations, part, role, names)
    known = {p.name: p.role for p in equations.parts.values()}
    returned = call(effect.function, "effect", arguments, known)
    out = Bound()
    if effect.kind == "state":
        if not isinstance(returned, Auxiliary):
            raise _refuse(effect, f"it returned {returned!r}",
                          "return ssm.effects.Auxiliary(change, transition, initial)")  # fmt: skip
        if not candidate.held:
            out.transition, out.initial = _laws(effect, returned, names, role)
        returned = returned.change
    out.changes = _changes(candidate, returned, part)
    also = () if own else (*candidate.reaction, *candidate.carried, *candidate.halfway)
    if also and len(out.changes) == 1:
        (increment,) = out.changes.values()
        out.changes |= {label: increment * factor for label, factor in also}
    return out


def _refuse(effect: Effect, found: str, fix: str) -> ModelError:
    return ModelError(f"the effect {effect.name!r}: {found}", fix=fix, where=effect.where)


def _laws(
    effect: Effect, returned: Auxiliary, names: dict[str, str], role: str
) -> tuple[dict[str, Distribution], dict[str, Distribution]]:
    out: list[dict[str, Distribution]] = []
    for which, laws in (("transition", returned.transition), ("initial", returned.initial)):
        if set(laws) != set(effect.states) or not all(
            isinstance(d, Distribution) for d in laws.values()
        ):
            raise _refuse(
                effect,
                f"its {which} distributions are {dict(laws)!r}",
                f"give a distribution for each of: {', '.join(effect.states)}",
            )
        out.append({names.get(n, n): d for n, d in laws.items()})
    if role == "initial":
        for name, d in out[1].items():
            inside = symbols_of([e for a in d.parameters.values() for e in array(a).ravel()])
            states = sorted(s.data[1] for s in inside if s.data[0] not in _WITHOUT_STATES)
            if states:
                raise _refuse(
                    effect,
                    f"the initial distribution of {name!r} depends on {states[0]!r}",
                    "let it depend on parameters, inputs and shape parameters only",
                )
    return out[0], out[1]


def _changes(candidate: Candidate, returned: Any, part: Part) -> dict[str, Expr]:
    effect = candidate.effect
    if not isinstance(returned, Mapping):
        returned = {effect.arguments[0]: returned}
    elif effect.kind != "transition":
        raise _refuse(effect, f"it returned {dict(returned)!r}", "return one expression")
    labels = {effect.arguments[0]: part.label, **dict(candidate.bound)}
    out: dict[str, Expr] = {}
    for argument, value in returned.items():
        if argument not in labels:
            raise _refuse(
                effect,
                f"it returned an increment for {argument!r}",
                f"name arguments that are states: {listing(str(argument), labels)}",
            )
        try:
            out[labels[argument]] = as_expr(value)
        except TypeError:
            raise _refuse(
                effect, f"it returned {value!r}", "return one number, or an expression"
            ) from None
    return out


# -- arguments
def _arguments(
    candidate: Candidate, equations: Equations, part: Part, role: str, names: dict[str, str]
) -> dict[str, Any]:
    effect, shape, bound = candidate.effect, dict(candidate.shape), dict(candidate.bound)
    parameters = inspect.signature(effect.function).parameters
    out: dict[str, Any] = {}
    for i, (name, parameter) in enumerate(parameters.items()):
        if i == 0:
            out[name] = _first(effect, equations, part, role)
        elif name == "strength":
            out[name] = symbol("parameter", candidate.strength)
        elif name in shape:
            value = shape[name]
            symbolic = isinstance(value, Expr)
            out[name] = value if symbolic or value != int(value) else int(value)
        elif name in effect.states:
            length = effect.states[name]
            if candidate.held:
                out[name] = constant(1.0)
            else:
                form = () if length is None else (int(shape[length]),)
                out[name] = _auxiliary(names.get(name, name), form, role)
        elif name in effect.given:
            out[name] = _given(candidate, equations, part, role, name, bound)
        elif name == "t":
            out[name] = time_symbol(role)
        elif (value := quantity(equations, name, role)) is not None:
            out[name] = value
        elif parameter.default is not parameter.empty:
            continue
        else:
            raise unknown(effect, name, equations)
    return out


def unknown(effect: Effect, name: str, equations: Equations) -> ModelError:
    """The error on an argument that is nothing the effect or the model knows."""
    known = [*dict.fromkeys(p.name for p in equations.parts.values()), *effect.shapes,
             *effect.states, *effect.given, "strength", "t"]  # fmt: skip
    return _refuse(
        effect,
        f"its function asks for {name!r}, which is neither its own nor the model's",
        f"use one of: {listing(name, known)}",
    )


def quantity(equations: Equations, name: str, role: str) -> Any:
    """A quantity of the model seen from a distribution; None where it has none of that name
    there."""
    parts = [p for p in equations.parts.values() if p.name == name]
    if not parts or (parts[0].role == "channel" and role != "transition"):
        return None
    shape = equations.trace.inputs.get(name, ())
    value = components(equations.trace, parts[0].role, name, shape)
    return _lagged(value) if role == "transition" and parts[0].role != "parameter" else value


def _lagged(value: Any) -> Any:
    if isinstance(value, Expr):
        return previous(value)
    return array(array([previous(s) for s in value.ravel()]).reshape(value.shape))


def _auxiliary(name: str, shape: tuple[int, ...], role: str) -> Any:
    value = symbols("state_prev" if role == "transition" else "state", name, shape)
    return value[()] if shape == () else value


def _first(effect: Effect, equations: Equations, part: Part, role: str) -> Expr:
    if effect.kind == "initial":
        return _value(equations.mean(part, "initial"), effect)
    if part.role != "channel":
        return part.seen_from(role)
    mean = _value(equations.reading(part), effect)
    if role != "transition":
        return mean
    moved = ("state", "input", "time")
    return substitute([mean], {s: previous(s) for s in symbols_of(mean) if s.data[0] in moved})[0]


def _value(found: Expr | NotApplicable, effect: Effect) -> Expr:
    if isinstance(found, NotApplicable):
        raise _refuse(effect, str(found), "bind it to another equation")
    return found


def _given(
    candidate: Candidate,
    equations: Equations,
    part: Part,
    role: str,
    name: str,
    bound: dict[str, str],
) -> Any:
    effect = candidate.effect
    what = effect.given[name]
    if what == "profile":
        if candidate.held:
            return constant(1.0)
        function = PROFILES[effect.profile]
        wanted = inspect.signature(function).parameters
        return function(time_symbol(role), **{k: v for k, v in candidate.shape if k in wanted})
    if what == "second order":
        return _value(equations.second_order(part), effect)
    if what == "next":
        return _value(equations.reading(part), effect)
    if what == "moved":
        position = equations.position(part)
        if position is None:
            raise _refuse(effect, f"no state is the integral of {part.label}, whose move it asks "
                          "for", "bind it to the rate of a position")  # fmt: skip
        return _value(equations.step(position), effect)
    if name not in bound:
        raise _refuse(effect, f"nothing is bound to {name!r}, which is to be {what!r}",
                      "make its candidates by offers()")  # fmt: skip
    value = equations.parts[bound[name]].seen_from(role)
    if what == "ahead" and bound[name] != part.label and equations.force(part):
        value = value + _value(equations.step(equations.parts[bound[name]]), effect)
    return value


def check_base(candidate: Candidate, equations: Equations, bound: Bound, role: str) -> None:
    """Check that strength 0 gives the model back.

    Raises
    ------
    ModelError : it does not; names the effect's line.
    """
    part = equations.parts[candidate.equation]
    zero = {symbol("parameter", candidate.strength): constant(0.0)}
    kept = candidate.change in ("input", "parameter")
    base = part.seen_from(role) if kept else constant(0.0)
    for value in bound.changes.values():
        (left,) = substitute([value], zero)
        if left is base:
            continue
        names = sorted(symbols_of([left, base]), key=to_text)
        at = wide_points(names, _POINTS, np.random.default_rng(1))
        with np.errstate(all="ignore"):
            one, two = (evaluate(e, at) + np.zeros(_POINTS) for e in (left, base))
            off = np.abs(one - two) > 1e-9 * (1.0 + np.abs(one) + np.abs(two))
        if np.any(off & np.isfinite(one) & np.isfinite(two)):
            raise _refuse(
                candidate.effect,
                f"at strength 0 it gives {left!r} in place of {base!r}",
                "write it so that strength 0 reproduces the original model",
            )
