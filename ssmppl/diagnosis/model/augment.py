"""A traced model with effects added: their strengths are parameters, and 0 gives the model back.

Inputs and parameters are replaced first, in transitions and observations; means, variances, tails
and starts are changed after that. Several effects on one equation add up. Auxiliary states join the
model's own; those with the same distributions are shared. Each effect is bound to the model as it
was, not to what others make of it: one after the other they are the same as all at once
(`equations.py`). Only what is given the "next" mean comes behind the others and reads theirs.
"""

from __future__ import annotations

import itertools
import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from ssmppl.analysis.new_values import in_order
from ssmppl.diagnosis.effects.candidate import Candidate
from ssmppl.diagnosis.model.binding import bind
from ssmppl.diagnosis.model.candidates import slug
from ssmppl.diagnosis.model.changed_laws import (
    has_scale,
    has_tail,
    heavier,
    scale_of_mean,
    scaled,
    shifted,
    substituted,
)
from ssmppl.diagnosis.model.equations import Augmented, Equations, Part, as_it_was
from ssmppl.diagnosis.model.forces import Force, linear, pushed, with_forces
from ssmppl.errors import ArgumentError, Location, NotApplicable
from ssmppl.expressions.arrays import array
from ssmppl.expressions.expr import Expr, attributed, substitute
from ssmppl.language.distributions import Distribution, Flat, HalfFlat, Uniform
from ssmppl.language.model.trace import Site, Trace, symbols

Sum = dict[tuple[str, tuple[int, ...]], Expr]  # (name, index) -> what is added
_LAWS = {"transition": shifted, "observation": shifted, "initial": shifted, "noise": scaled,
         "tail": heavier}  # fmt: skip


def augment(
    trace: Trace, candidates: Sequence[Candidate], *, prior: bool = True, first_order: bool = False
) -> Trace:
    """The model with the effects added, as an `Augmented` one.

    Parameters
    ----------
    trace : the model; where effects were added to it before, these join them.
    candidates : their strengths become scalar parameters, in this order behind the model's own.
    prior : whether they get a prior: Flat, HalfFlat where the strength is at least 0, Uniform
        between two bounds. False leaves them as symbols that no site declares, for derivatives.
    first_order : for scores at strength 0. What acts by a simulator's force only has to have the
        right one there (`forces.linear`); what moves `halfway` stays: where it has no noise, and is
        measured next to exactly, a complete-data score through it is nothing but Monte Carlo error.

    Raises
    ------
    ArgumentError : two candidates have a strength of the same name, or one does not fit the model.
    ModelError : an effect's function does not do what its kind says.
    """
    if first_order:
        candidates = [replace(c, halfway=()) for c in candidates]
    origin = as_it_was(trace)
    equations = Equations(origin)
    _check(candidates, trace, equations)
    before = trace if isinstance(trace, Augmented) else None
    every = [*(before.added if before else ()), *candidates]
    locations = dict(trace.locations)
    auxiliary = _Auxiliary(trace, origin, before.names if before else {})
    early = [c for c in every if c.change in ("input", "parameter")]
    late = [c for c in every if c.change not in ("input", "parameter")]
    names: dict[str, dict[str, str]] = {}  # strength -> its auxiliary states
    for c in early:
        for one in c.each:
            names[_key(c, one)] = auxiliary.add(one, _key(c, one), equations, locations)
    new = _replaced(origin, early, equations, names, locations)
    equations = Equations(new, equations)
    for c in late:
        names[c.strength] = auxiliary.add(c, c.strength, equations, locations)
    forced = [c for c in late if c.force]
    pushes = _pushes(forced, equations, names, locations)
    inside, rest = pushes, []
    if first_order:  # what is in the model already acts as it does there
        known = before.names if before else {}
        inside = [p for c, p in zip(forced, pushes, strict=True) if c.strength in known]
        rest = [(pushed(f, inside), by) for c, (f, by) in zip(forced, pushes, strict=True)
                if c.strength not in known]  # fmt: skip
    # Before means are moved, which then are no more than what the simulator gives.
    new = linear(with_forces(new, inside), rest) if forced else new
    plain = [c for c in late if not c.force and not c.reads_next]
    new = _moved(new, plain, equations, names, locations)
    for c in late:  # what holds a state back does so against all others, and one after the other
        if c.reads_next:
            new = _moved(new, [c], Equations(new, equations), names, locations)
    parameters = dict(trace.parameters)  # those of the shapes of earlier effects among them
    for c in candidates:
        if prior:
            with attributed(locations, c.effect.where):
                parameters[c.strength] = _prior_site(c)
    transition = in_order(_in_order(trace.transition, {**new.transition, **auxiliary.transition}))
    assert transition is not None, new.transition  # none reads itself
    return Augmented(
        name=trace.name,
        parameters=parameters,
        initial=_in_order(trace.initial, {**new.initial, **auxiliary.initial}),
        transition=transition,
        observations=new.observations,
        proposal={**new.proposal, **auxiliary.transition} if new.proposal else {},
        inputs=trace.inputs,
        locations=locations,
        functions=trace.functions,
        choices=trace.choices,
        origin=origin,
        added=tuple(every),
        names=names,
    )


def with_given_parameters(
    trace: Trace, names: Iterable[str], prior: Callable[[], Distribution] = Flat
) -> Trace:
    """The trace with further parameters: by default such as are given."""
    location = next(iter(trace.transition.values())).distribution.location
    parameters = dict(trace.parameters)
    for name in names:
        law = prior()
        law.location = location
        own = symbols("parameter", name, ())
        parameters[name] = Site(name, "parameter", law, own, location)
    return replace(trace, parameters=parameters)


def _key(c: Candidate, one: Candidate) -> str:
    """By which the auxiliary states of `one` of the inputs are kept in which a candidate acts."""
    return c.strength if one.equation == c.equation else f"{c.strength} in {one.equation}"


def _in_order(before: Mapping[str, Site], new: dict[str, Site]) -> dict[str, Site]:
    """The sites with those that there were before first, in their order."""
    return {n: new[n] for n in [*before, *(n for n in new if n not in before)]}


def _check(candidates: Sequence[Candidate], trace: Trace, equations: Equations) -> None:
    """Check that names are free, and candidates fit the model. equations : of it as it was."""
    taken = {p.name: f"the model's {p.role}" for p in Equations(trace, equations).parts.values()}
    for c in candidates:
        if c.strength in taken:
            raise ArgumentError(
                f"the strength of {c} is named {c.strength!r}, as is {taken[c.strength]}",
                fix="give each candidate a name of its own: replace(candidate, strength=...)",
            )
        taken[c.strength] = f"the strength of {c}"
        moved = [label for label, _ in (*c.reaction, *c.carried, *c.halfway)]
        for label in (c.equation, *c.alike, *dict(c.bound).values(), *moved):
            if label not in equations.parts:
                raise ArgumentError(
                    f"{c}: the model {equations.trace.name!r} has no {label!r}",
                    fix="make the candidates by offers() of the same model",
                )
        _check_law(c, equations)


def _check_law(c: Candidate, equations: Equations) -> None:
    """Check that the distribution can be changed so."""
    found: Any = None
    part = equations.parts[c.equation]
    if c.change in ("transition", "observation", "initial"):
        found = scale_of_mean(equations.law(part, c.change))
    elif c.change in ("noise", "tail"):
        found = {"noise": has_scale, "tail": has_tail}[c.change](equations.law(part))
    if isinstance(found, NotApplicable):
        raise ArgumentError(f"{c} cannot be added: {found}", fix="leave it out")


def _prior_site(c: Candidate) -> Site:
    e = c.effect
    law: Distribution
    if math.isfinite(e.lower) and math.isfinite(e.upper):
        law = Uniform(e.lower, e.upper)
    else:
        law = HalfFlat() if e.lower == 0.0 else Flat()
    law.location = e.where
    return Site(c.strength, "parameter", law, symbols("parameter", c.strength, ()), e.where)


# -- auxiliary states
class _Auxiliary:
    """The auxiliary states of all candidates, by name in the model.

    earlier : the names of those that are in it already.
    """

    def __init__(self, trace: Trace, origin: Trace, earlier: Mapping[str, Mapping[str, str]]):
        self.earlier = {strength: dict(names) for strength, names in earlier.items()}
        self.kept = {n for names in self.earlier.values() for n in names.values()}
        self.taken = {*trace.parameters, *origin.initial, *trace.observations, *trace.inputs}
        self.initial: dict[str, Site] = {}
        self.transition: dict[str, Site] = {}

    def add(
        self, c: Candidate, key: str, equations: Equations, locations: dict[Expr, Location]
    ) -> dict[str, str]:
        """The names of a candidate's states: those of an earlier one where their distributions
        agree. key : by which `earlier` has them."""
        if not c.effect.states or c.held:
            return {}
        for number in itertools.count(1):
            suffix = "" if number == 1 else f"_{number}"
            names = {n: slug(f"{n} {c.equation}") + suffix for n in c.effect.states}
            names = self.earlier.get(key, names)
            # A name that an earlier candidate keeps is not given away before it is asked for.
            kept = self.kept if key not in self.earlier else set()
            if (self.taken | kept - set(self.initial)) & set(names.values()):
                continue
            with attributed(locations, c.effect.where):
                first = bind(c, equations, "initial", names).initial
                step = bind(c, equations, "transition", names).transition
            if all(n not in self.initial for n in names.values()):
                for n in names.values():
                    self.initial[n] = _site(n, first[n], c)
                    self.transition[n] = _site(n, step[n], c)
                return names
            if all(
                n in self.initial
                and _alike(self.initial[n].distribution, first[n])
                and _alike(self.transition[n].distribution, step[n])
                for n in names.values()
            ):
                return names
        raise AssertionError("unreachable")


def _site(name: str, law: Distribution, c: Candidate) -> Site:
    law.location = c.effect.where
    return Site(name, "state", law, symbols("state", name, law.shape), c.effect.where)


def _alike(a: Distribution, b: Distribution) -> bool:
    if type(a) is not type(b) or a.shape != b.shape or list(a.parameters) != list(b.parameters):
        return False
    nodes = [[e for p in d.parameters.values() for e in array(p).ravel()] for d in (a, b)]
    return all(x is y for x, y in zip(*nodes, strict=True))


# -- inputs and parameters
def _replaced(
    trace: Trace, candidates: Sequence[Candidate], equations: Equations,
    names: Mapping[str, dict[str, str]], locations: dict[Expr, Location],
) -> Trace:  # fmt: skip
    """The trace with what acts in place of inputs and parameters: what several effects add to an
    input, and a parameter that one changes after the other, as their factors belong together."""
    out = {}
    for role in ("transition", "observation"):
        replacement: dict[Expr, Expr] = {}
        for c in candidates:
            for one in c.each:
                with attributed(locations, c.effect.where):
                    (new,) = bind(one, equations, role, names[_key(c, one)]).changes.values()
                    s = equations.parts[one.equation].seen_from(role)
                    if s in replacement and c.change == "input":
                        new = replacement[s] + (new - s)
                    elif s in replacement:
                        (new,) = substitute([new], {s: replacement[s]})
                replacement[s] = new
        sites = trace.transition if role == "transition" else trace.observations
        out[role] = {n: _with_law(site, substituted, replacement, locations)
                     for n, site in sites.items()}  # fmt: skip
    return replace(trace, transition=out["transition"], observations=out["observation"])


def _with_law(site: Site, change: Any, how: Any, locations: dict[Expr, Location]) -> Site:
    if not how:
        return site
    with attributed(locations, site.distribution.location):
        return replace(site, distribution=change(site.distribution, how))


# -- means, variances, tails, starts
def _moved(
    trace: Trace, candidates: Sequence[Candidate], equations: Equations,
    names: Mapping[str, dict[str, str]], locations: dict[Expr, Location],
) -> Trace:  # fmt: skip
    layers: dict[tuple[str, str], list[Sum]] = defaultdict(list)  # (which laws, change)
    for c in candidates:
        part = equations.parts[c.equation]
        role = _role(c, part)
        with attributed(locations, c.effect.where):
            for label, by in bind(c, equations, role, names[c.strength]).changes.items():
                target = equations.parts[label]
                at = equations.place(target, role)
                free = [into for into in layers[role, c.change] if at not in into]
                if not free:
                    layers[role, c.change].append({})
                    free = layers[role, c.change][-1:]
                free[0][at] = by
    groups = {"initial": trace.initial, "transition": trace.transition,
              "observation": trace.observations}  # fmt: skip
    for role, sites in groups.items():
        new = dict(sites)
        # Scales before tails: Student's t takes over the scale of the normal law.
        for change in (role, "noise", "tail"):
            for layer in layers.get((role, change), []):
                for name in dict.fromkeys(n for n, _ in layer):
                    how = {i: by for (n, i), by in layer.items() if n == name}
                    new[name] = _with_law(new[name], _LAWS[change], how, locations)
        groups[role] = new
    return replace(trace, initial=groups["initial"], transition=groups["transition"],
                   observations=groups["observation"])  # fmt: skip


def _pushes(
    candidates: Sequence[Candidate], equations: Equations, names: Mapping[str, dict[str, str]],
    locations: dict[Expr, Location],
) -> list[tuple[Force, Expr]]:  # fmt: skip
    """The increments of simulators' forces."""
    out = []
    for c in candidates:
        force = equations.force(equations.parts[c.equation])
        assert force is not None, c
        with attributed(locations, c.effect.where):
            (by,) = bind(c, equations, "transition", names[c.strength]).changes.values()
        out.append((force, by))
    return out


def _role(c: Candidate, part: Part) -> str:
    """Whose distribution a change belongs to."""
    if c.change in ("noise", "tail"):
        return "transition" if part.role == "state" else "observation"
    return c.change
