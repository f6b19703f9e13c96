"""Rules on what a distribution may give: names, kinds of distributions, agreement of a state's
distributions."""

from __future__ import annotations

import keyword
import math
import unicodedata
from collections.abc import Collection, Mapping
from typing import Any

from ssmppl.errors import Location, ModelError, listing
from ssmppl.expressions.expr import Expr, symbols_of, to_text, topological
from ssmppl.language.distributions import Dirac, Distribution

RESERVED = {
    "t": "the row number",
    "time": "the dimension of the rows in results",
    "draw": "the dimension of draws in results",
    "chain": "the dimension of chains in results",
    "trajectory": "the dimension of trajectories in results",
}


def a(role: str) -> str:
    """The role with its article."""
    return f"an {role}" if role[0] in "aeiou" else f"a {role}"


def check_name(name: Any, role: str, where: Location) -> None:
    """Names must be arguments that a distribution can have, and no dimension of results."""
    if not isinstance(name, str) or not name.isidentifier() or keyword.iskeyword(name):
        raise ModelError(
            f"{a(role)} has the name {name!r}, which no argument of a Python function can have",
            fix="use letters, digits and underscores, starting with a letter, and no keyword",
            where=where,
        )
    if (read := unicodedata.normalize("NFKC", name)) != name:
        raise ModelError(
            f"{a(role)} is named {name!r} with the characters {_characters(name, read)}, which "
            f"Python reads as {read!r} in an argument",
            fix=f"write {read!a} for the name, or choose one of plain letters",
            where=where,
        )
    if name in RESERVED:
        raise ModelError(
            f"{a(role)} is named {name!r}, which means {RESERVED[name]}",
            fix=f"choose another name, for example {name + '_'!r}",
            where=where,
        )


def _characters(name: str, read: str) -> str:
    """Those of a name that are not in what Python reads for it, by their Unicode names."""
    return ", ".join(unicodedata.name(c, repr(c)) for c in dict.fromkeys(name) if c not in read)


def check_dims(
    known: Mapping[str, tuple[str, tuple[int, ...]]], where: Mapping[str, Location]
) -> None:
    """No name is that of a dimension of another quantity in results; known : role and shape."""
    for name, (role, shape) in known.items():
        for k in range(len(shape)):
            if (own := f"{name}_dim_{k}") in known:
                raise ModelError(
                    f"{a(known[own][0])} is named {own!r}, which is in results a dimension of the "
                    f"{role} {name!r}",
                    fix=f"choose another name, for example '{name}_{k}_dim'",
                    where=where.get(own),
                )


def check_returned(
    returned: Any, role: str, function: str, where: Location
) -> dict[str, Distribution]:
    """The distributions by name."""
    if not isinstance(returned, Mapping) or not returned:
        found = "nothing" if returned is None else repr(returned)
        raise ModelError(
            f"@{role} {function} returned {found}",
            fix='return a dictionary {"name": distribution}',
            where=where,
        )
    for name, distribution in returned.items():
        if isinstance(distribution, Distribution):
            continue
        called = isinstance(distribution, type) and issubclass(distribution, Distribution)
        if called:
            found, fix = f"the class {distribution.__name__}", "call it with its parameters"
        else:
            found = repr(distribution)
            fix = f"return ssm.Dirac(...) if {name!r} is deterministic, or a distribution such "
            fix += "as ssm.Normal(mean, sd=...)"
        raise ModelError(
            f"@{role} {function}: {name!r} is {found}, which is no distribution",
            fix=fix,
            where=where,
        )
    return dict(returned)


def check_law(name: str, distribution: Distribution, role: str) -> None:
    """What may stand as a prior, as a distribution of states, as an observation."""
    where = distribution.location
    kind = type(distribution).__name__
    if role == "prior" and isinstance(distribution, Dirac):
        raise ModelError(
            f"the prior of {name!r} is Dirac",
            fix=f"fix it by fixed={{{name!r}: value}} in the verb, or compute it inside "
            "the functions that use it",
            where=where,
        )
    if role == "prior" and distribution.discrete:
        raise ModelError(
            f"the prior of {name!r} is {kind}: parameters are continuous",
            fix="make it a state with a Dirac transition, or compare models",
            where=where,
        )
    if role != "prior" and distribution.prior_only:
        raise ModelError(
            f"the distribution of {name!r} is {kind}, a prior of parameters only",
            fix=f"declare it in @prior, and name {name!r} as an argument where its value acts",
            where=where,
        )
    if role != "observation" and distribution.atoms:
        raise ModelError(
            f"the distribution of {name!r} is {kind}, which observations alone have",
            fix="give a state that stops at its limits a draw of the step and "
            "ssm.Dirac(np.clip(draw_next, lower, upper)), or cut its distribution off by "
            "ssm.Truncated",
            where=where,
        )
    if role != "observation" and not distribution.measured:
        raise ModelError(
            f"the distribution of {name!r} is {kind}, a term of the log density, which stands in "
            "the place of an observation",
            fix="return it from @observation, where it may be of parameters and states: "
            f"{{{name!r}: ssm.{kind}(...)}}; a term of the first row alone is "
            "np.where(t == 1, term, 0)",
            where=where,
        )
    allowed = role == "prior" or (role == "initial" and kind == "Flat")
    if not distribution.proper and not allowed:
        raise ModelError(
            f"the distribution of {name!r} is {kind}, which is improper",
            fix=f"use {kind} as a prior"
            + (", or in @initial of a linear Gaussian model" if kind == "Flat" else "")
            + "; a vague distribution is one of large spread",
            where=where,
        )
    if role in ("initial", "transition", "proposal") and not distribution.drawable:
        raise distribution.undrawable(f"{name!r} is a state, which particles draw")
    if 0 in distribution.shape:
        raise ModelError(
            f"{name!r} has shape {distribution.shape}, which holds nothing",
            fix="give it at least one component",
            where=where,
        )
    for parameter, values in distribution.parameters.items():
        nodes = topological(values.ravel())
        if any(n.op == "const" and math.isnan(n.data) for n in nodes):
            raise ModelError(
                f"{kind} of {name!r}: {parameter.rstrip('_')} holds NaN, whatever the symbols are",
                fix="look for the constant that is NaN (0/0, np.log of a negative number, a "
                "missing entry of an array)",
                where=where,
            )


def check_read(
    name: str, distribution: Distribution, role: str, kinds: Collection[str],
    handed: Collection[Expr] = (),
) -> None:  # fmt: skip
    """Refuse symbols of other kinds than the arguments of the function: another distribution kept
    them.

    handed : further symbols, in the new values that it asked for.
    """
    for s in symbols_of(distribution.arguments()):
        if s.data[0] not in kinds and s not in handed:
            raise ModelError(
                f"the distribution of {name!r} reads {to_text(s)}, a symbol of another "
                f"distribution than this @{role}",
                fix="name what a distribution needs among its arguments; what one distribution "
                "keeps in a variable or a dictionary means nothing in another",
                where=distribution.location,
            )


def check_states(
    initial: Mapping[str, Any], transition: Mapping[str, Any], proposal: Mapping[str, Any],
    draws: Collection[str] = (),
) -> None:  # fmt: skip
    """Every state has its distributions, and they agree; arguments are sites by name.

    draws : names of those that are draws of a step: their initial distributions are no user's.
    """
    for name, site in initial.items():
        if name not in transition:
            raise ModelError(
                f"state {name!r} has an initial distribution but no transition",
                fix=f"return {name!r} from a @transition function too; the transitions give: "
                f"{listing(name, transition)}",
                where=site.distribution.location,
            )
    for role, sites in (("transition", transition), ("proposal", proposal)):
        for name, site in sites.items():
            if role == "transition" and (name in draws or name not in initial):
                continue
            _check_against_initial(role, name, site, initial)
    if proposal:
        _check_proposal({n: transition[n] for n in initial}, proposal, draws)


def _check_against_initial(role: str, name: str, site: Any, initial: Mapping[str, Any]) -> None:
    where = site.distribution.location
    if name not in initial:
        raise ModelError(
            f"@{role} gives {name!r}, which has no initial distribution",
            fix=f"return it from @initial too; @initial gives: {listing(name, initial)}",
            where=where,
        )
    first = initial[name]
    if site.shape != first.shape:
        raise ModelError(
            f"state {name!r} has shape {site.shape} in its {role} and shape "
            f"{first.shape} in its initial distribution",
            fix="give both the same shape; np.zeros(n) makes a mean of length n",
            where=where,
        )
    law, symmetric = site.distribution, first.distribution.symmetric
    if law.symmetric != symmetric and not isinstance(law, Dirac):
        kinds = [type(s.distribution).__name__ for s in (first, site)]
        raise ModelError(
            f"state {name!r} is {kinds[0]} at first and {kinds[1]} in its {role}: one is "
            "a symmetric matrix, the other is not",
            fix="use Wishart or InverseWishart in both (or Dirac in the transition)",
            where=where,
        )


def _check_proposal(
    transition: Mapping[str, Any], proposal: Mapping[str, Any], draws: Collection[str]
) -> None:
    some = next(iter(proposal.values()))
    for name, site in transition.items():
        fixed = isinstance(site.distribution, Dirac)
        if name not in proposal:
            if fixed or name in draws:
                continue
            raise ModelError(
                f"@proposal gives no distribution for the state {name!r}",
                fix=f"return {name!r} from it too; it gives: {listing(name, proposal)}",
                where=some.where,
            )
        law = proposal[name].distribution
        kinds = [type(d).__name__ for d in (site.distribution, law)]
        if isinstance(law, Dirac) != fixed or law.discrete != site.distribution.discrete:
            raise ModelError(
                f"the transition of {name!r} is {kinds[0]}, its proposal {kinds[1]}: they do not "
                "cover the same values",
                fix="leave a deterministic state out of @proposal"
                if fixed
                else "propose from a distribution with the support of the transition",
                where=law.location,
            )
