"""The candidates of a model: which effects apply to its equations, with their shapes in numbers."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from ssmppl.analysis.structure import simulators
from ssmppl.diagnosis.effects.candidate import DATED, OF_ROLE, Candidate
from ssmppl.diagnosis.effects.catalogue import effects as catalogue
from ssmppl.diagnosis.effects.effect import ON, Effect
from ssmppl.diagnosis.model.binding import bind, check_base, quantity, unknown
from ssmppl.diagnosis.model.changed_laws import has_scale, has_tail, scale_of_mean
from ssmppl.diagnosis.model.equations import Equations, Part, SharedTerms, as_it_was
from ssmppl.diagnosis.model.scales import Scales, value_of
from ssmppl.diagnosis.run.failures import Failures
from ssmppl.errors import ArgumentError, NotApplicable, SSMError
from ssmppl.expressions.arrays import array
from ssmppl.expressions.calculus import jumps
from ssmppl.expressions.expr import symbols_of, topological
from ssmppl.expressions.loops.affine import scaling_of_exponentials
from ssmppl.language.checks.rules import RESERVED
from ssmppl.language.model.trace import Trace

# What an effect of each kind can be bound to.
BOUND_TO = {
    "transition": ("state",), "observation": ("channel",), "input": ("input",),
    "noise": ("state", "channel"), "tail": ("state", "channel"), "parameter": ("parameter",),
    "initial": ("state",), "state": ("state", "channel", "input", "parameter"),
}  # fmt: skip


@dataclass(frozen=True)
class Refused:
    """An effect that is not offered for an equation ("" for the whole model), and why."""

    effect: str
    equation: str
    reason: str
    form: str = ""

    def __str__(self) -> str:
        where = f" in {self.equation}" if self.equation else ""
        return f"{self.effect}{f' ({self.form})' if self.form else ''}{where}: {self.reason}"


SAWTOOTH = frozenset({"floor", "ceil", "mod", "arctan2"})  # operations that jump again and again
Chosen = Iterable["Effect | str"] | Mapping[str, "Effect | str"] | None


def offers(
    trace: Trace, scales: Scales, effects: Chosen = None, failures: Failures | None = None
) -> tuple[list[Candidate], list[Refused]]:
    """The candidates that apply to a model, and what does not with the reason.

    Parameters
    ----------
    effects : names restrict the catalogue to them; own effects alone are added to it, in place of
        what has the same name there; both together are just these. A mapping renames and
        restricts: ``{"my name": "coulomb friction"}``.
    failures : takes the effects that a fault of this package ends; None: faults are raised.

    Raises
    ------
    ArgumentError : a name is not in the catalogue.
    ModelError : an effect's function does not fit its kind or the model; names its line.
    """
    equations = Equations(as_it_was(trace))  # what was added is no part of the model
    shared = SharedTerms.of(equations)
    out: list[Candidate] = []
    refused: list[Refused] = []
    failures = Failures(raised=True) if failures is None else failures
    for effect in chosen(effects):
        try:
            found, not_for = _of_effect(effect, equations, scales, shared)
        except SSMError:  # of the user's own effect, or of their model
            raise
        except Exception as error:
            failures.record(f"the effect {effect.name!r}", error)
            continue
        out += found
        refused += not_for
    return _named(out, Equations(trace)), refused


def chosen(effects: Chosen = None) -> list[Effect]:
    """The effects that the user's choice stands for."""
    if effects is None:
        return list(catalogue)
    if isinstance(effects, (str, Effect)):
        effects = [effects]
    pairs: list[tuple[str, Any]] = (
        list(effects.items()) if isinstance(effects, Mapping) else [("", e) for e in effects]
    )
    out: list[Effect] = []
    for new_name, e in pairs:
        if not isinstance(e, (str, Effect)):
            raise ArgumentError(
                f"effects holds {e!r}",
                fix="give names, ssm.effects.names() lists them, or what @ssm.effect made",
            )
        for one in catalogue.get(e) if isinstance(e, str) else [e]:
            out.append(replace(one, name=new_name) if new_name else one)
    own: set[tuple[str, str]] = set()
    for e in out:
        if (e.name, e.form) in own:
            raise ArgumentError(
                f"effects holds {e.name!r} twice" + (f" as {e.form!r}" if e.form else ""),
                fix="name each once; @ssm.effect(name=, form=) tells two apart",
            )
        own.add((e.name, e.form))
    if not any(isinstance(e, str) for _, e in pairs) and not isinstance(effects, Mapping):
        return [*(e for e in catalogue if (e.name, e.form) not in own), *out]
    return out


# -- one effect
def _of_effect(
    effect: Effect, equations: Equations, scales: Scales, shared: SharedTerms
) -> tuple[list[Candidate], list[Refused]]:
    out: list[Candidate] = []
    refused: list[Refused] = []

    def refuse(equation: str, reason: str) -> None:
        refused.append(Refused(effect.name, equation, reason, effect.form))

    own = {*effect.shapes, *effect.states, *effect.given, "strength", "t"}
    for name in effect.arguments[1:]:
        if name not in own and quantity(equations, name, "transition") is None:
            raise unknown(effect, name, equations)
    parts = _parts(effect, equations)
    if not parts:
        refuse("", f"the model has no {_wanted(effect)}")
    single: dict[str, list[Candidate]] = {}  # by input, of an effect that may be common to all
    for part in parts:
        reason = _reason(effect, part, equations, scales)
        if reason:
            refuse(part.label, reason)
            continue
        for bound in _bindings(effect, part, equations):
            if isinstance(bound, str):
                refuse(part.label, bound)
                continue
            shapes = _shapes(effect, part, bound, scales)
            if isinstance(shapes, str):
                refuse(part.label, shapes)
                continue
            made = [Candidate(effect, part.label, shape, bound, part.role) for shape in shapes]
            moves = made[0].change == "transition" and effect.profile not in DATED
            force = equations.force(part) if made[0].change == "transition" else None
            if force and len(bind(made[0], equations, "transition", own=True).changes) == 1:
                made, moves = [replace(c, force=force.name) for c in made], False
            if moves and part.label in shared.carried:
                made = [replace(c, carried=shared.carried[part.label]) for c in made]
            if moves and part.label in shared.halfway:
                made = [replace(c, halfway=shared.halfway[part.label]) for c in made]
            reason = _check(made[0], equations)
            if reason:
                refuse(part.label, reason)
                continue
            out += made
            if effect.common:
                single.setdefault(part.label, made)
            alone = moves and len(bind(made[0], equations, "transition", own=True).changes) == 1
            if effect.on in ("rate", "state") and alone:
                for reaction in shared.reactions.get(part.label, []):
                    acting = [replace(c, reaction=reaction) for c in made]
                    if not _check(acting[0], equations):
                        out += acting
    if len(single) > 1:
        first, *others = single
        out += [replace(c, alike=tuple(others)) for c in single[first]]
    return out, refused


def _wanted(effect: Effect) -> str:
    if effect.on not in ON:
        return f"{effect.on!r} that it could be bound to"
    role = {"rate": "state", "state": "state"}.get(effect.on, effect.on)
    return role if role != "any" else " or ".join(BOUND_TO[effect.kind])


def _parts(effect: Effect, equations: Equations) -> list[Part]:
    """The parts that an effect is bound to, by its kind and `on`."""
    parts = [p for p in equations.parts.values()
             if p.role in BOUND_TO[effect.kind] and not _is_clock(p, equations)]  # fmt: skip
    on = effect.on
    if on not in ON:
        return [p for p in parts if on in (p.label, p.name)]
    if on == "any":
        return parts
    if on in ("rate", "state"):
        return [p for p in parts if p.role == "state"]
    if on in ("channel", "input", "parameter"):
        return [p for p in parts if p.role == on]
    positive = on == "positive parameter"
    return [p for p in parts if p.role == "parameter" and _positive(p, equations) == positive]


def _is_clock(part: Part, equations: Equations) -> bool:
    """Whether it is the model's time step, which nothing acts on or through."""
    step = equations.trace.time_step
    return part.role == "input" and step is not None and part.name == step[0]


def _positive(part: Part, equations: Equations) -> bool:
    support = equations.trace.parameters[part.name].distribution.support()
    lower = array(support.lower)
    bound = lower[part.index] if lower.ndim == len(part.index) else lower.ravel()[0]
    return support.kind == "interval" and bound.op == "const" and bound.data >= 0.0


def _reason(effect: Effect, part: Part, equations: Equations, scales: Scales) -> str:
    """Why an effect is not offered for a part; "" where it is."""
    change = OF_ROLE[part.role] if effect.kind == "state" else effect.kind
    found: NotApplicable | str | None = None
    if effect.on == "rate":
        found = equations.fixed_by_others(part)
    elif effect.on == "state" and part.role == "state" and equations.deterministic(part):
        found = equations.fixed_by_others(part)
        found = f"{found}, without noise" if found else ""
    if found:
        return str(found)
    if change in ("transition", "observation", "initial"):
        found = scale_of_mean(equations.law(part, change))
        found = found if isinstance(found, NotApplicable) else None
    elif change == "noise":
        found = has_scale(equations.law(part))
    elif change == "tail":
        found = has_tail(equations.law(part))
        if equations.place(part)[0] != part.name and part.role == "state":
            found = f"it is a component of {part.name!r}, of which others have no noise"
    else:
        found = _unused(part, equations)
    if isinstance(found, NotApplicable):
        return found.reason
    if found:
        return found
    if effect.requires == "additive":
        law = equations.law(part)
        scale = scale_of_mean(law)
        kind = "logit" if scale == "logit" else "logarithm"
        act = f"its distribution is {type(law).__name__}: effects act on the {kind} of its mean"
        return "" if scale == "identity" else act
    if effect.requires:
        low, high = (scales.scale[part.label].quantile(level) for level in (0.02, 0.98))
        if effect.requires == "both signs" and low == high:
            return f"{part.label} does not vary"
        if effect.requires == "positive" and low <= 0.0:
            return "it takes values below 0"
        if effect.requires == "both signs" and (low > 0.0 or high < 0.0):
            return "it never changes its sign"
    if "second order" in effect.given.values():
        term = equations.second_order(part)
        if isinstance(term, NotApplicable):
            return term.reason
        # Beside it no score could be taken, in no parameter that is in it.
        smooth = scaling_of_exponentials([term])
        jumping = any(jumps(n) and n not in smooth for n in topological([term]))
        return "the derivative of its transition jumps" * jumping
    return ""


def _unused(part: Part, equations: Equations) -> str:
    """Why an input or a parameter cannot be changed over time."""
    trace = equations.trace
    if part.role == "parameter":
        support = trace.parameters[part.name].distribution.support()
        if support.tied:
            return f"its components are bound to each other ({support.kind})"
    laws = [*trace.transition.values(), *trace.observations.values()]
    inside = symbols_of(
        [e for s in laws for a in s.distribution.parameters.values() for e in array(a).ravel()]
    )
    if not {part.symbol, part.seen_from("transition")} & inside:
        return "no transition or observation depends on it"
    return ""


# -- what its arguments are
def _bindings(
    effect: Effect, part: Part, equations: Equations
) -> list[tuple[tuple[str, str], ...] | str]:
    """(argument, label) for each argument that is given; a text where there is nothing to bind."""
    options: list[list[tuple[str, str]]] = []
    for argument, what in effect.given.items():
        if what in ("profile", "second order"):
            continue
        if what == "next":
            if equations.force(part) is not None:
                return [f"{part.label} is moved by a force of its simulator"]
            continue
        labels = _options(what, part, equations)
        if isinstance(labels, str):
            return [labels]
        if what != "moved":
            options.append([(argument, label) for label in labels])
    return list(itertools.product(*options))


def _options(what: str, part: Part, equations: Equations) -> list[str] | str:
    if what == "other state":
        labels = [p.label for p in equations.of_role("state") if p.label != part.label]
        return labels or "the model has no other state"
    if what == "any input":
        labels = [p.label for p in equations.of_role("input") if not _is_clock(p, equations)]
        return labels or "the model has no input"
    position = equations.position(part)
    if position is None:
        return (
            [part.label]
            if what in ("position", "ahead")
            else f"no state is the integral of {part.label}"
        )
    return [position.label]


def _shapes(
    effect: Effect, part: Part, bound: tuple[tuple[str, str], ...], scales: Scales
) -> list[tuple[tuple[str, float], ...]] | str:
    """Every combination of the shape parameters' values; a text where a scale is missing."""
    bare = Candidate(effect, part.label, bound=bound)
    axes: list[list[tuple[str, float]]] = []
    for name, grid in effect.shapes.items():
        label = bare.variable(grid.of)
        scale = scales.scale.get(label)
        if scale is None and grid.unit not in ("number", "rows"):
            return f"there is no scale of {label} for its shape parameter {name}"
        if grid.unit in ("sd", "size") and scale is not None and not scale.sd > 0.0:
            return f"{label} does not vary"
        values = dict.fromkeys(value_of(grid, v, scale, scales.rows) for v in grid.values)
        if grid.unit == "size":
            values = {v: None for v in values if v > 0.0}
            if not values:
                return f"{label} is 0 most of the time"
        axes.append([(name, v) for v in values])
    return list(itertools.product(*axes))


def _check(candidate: Candidate, equations: Equations) -> str:
    """Call the function once: it has to give the model back at strength 0.

    Returns why an equation that it changes besides its own cannot be changed, or why no refit could
    be trusted; "" where there is nothing of the kind.
    """
    change = candidate.change
    role = change if change in ("initial", "observation") else "transition"
    if candidate.effect.kind in ("noise", "tail"):
        role = OF_ROLE[candidate.role]
    bound = bind(candidate, equations, role)
    check_base(candidate, equations, bound, role)
    if change == "observation" and simulators(equations.trace):
        if any(n.op in SAWTOOTH for n in topological(bound.changes.values())):
            return (
                "a measured value that jumps is not followed by the extended Kalman filter, by "
                "which a model that calls a simulator is fitted"
            )
    for label in bound.changes:
        part = equations.parts[label]
        reason = equations.fixed_by_others(part) if label != candidate.equation else ""
        if not reason and part.role == "state" and change == "transition":
            scale = scale_of_mean(equations.law(part))
            reason = scale.reason if isinstance(scale, NotApplicable) else ""
        if reason and label not in dict((*candidate.carried, *candidate.halfway)):
            return f"it changes {label} too: {reason}"
    return ""


# -- names
def _named(candidates: Sequence[Candidate], equations: Equations) -> list[Candidate]:
    """The candidates with a readable name for each strength, none of which the model has."""
    taken = {p.name for p in equations.parts.values()} | set(RESERVED) | {"np", "ssm", "model"}
    out = []
    for c in candidates:
        plain = slug(f"{c.effect.name} {c.place}")
        name = next(n for n in _numbered(plain) if n not in taken)
        taken.add(name)
        out.append(replace(c, strength=name))
    return out


def slug(text: str) -> str:
    """A text as a Python identifier: "bouc-wen hysteresis v[0]" is bouc_wen_hysteresis_v_0."""
    plain = re.sub(r"\W+", "_", text).strip("_").lower()
    return plain if plain.isidentifier() else f"effect_{plain}".rstrip("_")


def _numbered(name: str) -> Iterable[str]:
    return itertools.chain([name], (f"{name}_{i}" for i in itertools.count(2)))
