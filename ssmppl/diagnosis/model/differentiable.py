"""Whether a model has the derivatives that a diagnosis needs, checked before anything is fitted.

What an effect would do is held against what other values of the parameters would do: for that the
log density needs a derivative in every parameter that is free. An `@ssm.primitive` of a state or an
input has none in what it is called with. What needs none is let through: primitives of states and
inputs alone, which lose the effects that would act inside of them, and such as make one number of
parameters, as of a scale, which are left out of the comparison.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

from ssmppl.analysis.density import Missing, terms
from ssmppl.analysis.score import ROLES, CompleteScore
from ssmppl.errors import ModelError
from ssmppl.expressions.arrays import array
from ssmppl.expressions.expr import Expr, dependent, symbols_of, topological
from ssmppl.language.model.trace import Site, Trace

_LAW_OF = {"initial": "the initial law of", "transition": "the transition of",
           "observation": "the observation of"}  # fmt: skip


def check_differentiable(trace: Trace, fixed: Collection[str] = ()) -> None:
    """Check that the model has a derivative in each of its free parameters.

    Parameters
    ----------
    fixed : names of parameters whose values are given.

    Raises
    ------
    ModelError : a primitive is in the way; names it, the law that calls it and its line.
    """
    laws = _laws(trace)
    calling = [law for law in laws if any(n.op == "call" for n in topological(law[2]))]
    if not calling:
        return
    free = [s for s in trace.parameter_symbols if s.data[1] not in fixed]
    score = CompleteScore(trace, free, Missing())
    found: dict[Expr, list[Expr]] = {}  # the call -> the parameters that it hides
    for p in free:
        if score.obstacle(p) is None:
            involved = score.involved(p)
            for _, _, roots in calling:
                changing = dependent(roots, involved)
                for node in topological(roots):
                    if node.op == "call" and node in changing and _of_rows(node):
                        found.setdefault(node, []).append(p)
    if found:
        raise _error(calling, found)


def _laws(trace: Trace) -> list[tuple[str, Site, list[Expr]]]:
    """(role, site, the expressions that its density or its value is made of)."""
    groups = {"initial": trace.initial, "transition": trace.transition,
              "observation": trace.observations}  # fmt: skip
    out = []
    for role in ROLES:
        density: dict[str, list[Expr]] = {}
        for t in terms(trace, role, Missing(), guard=False):
            density.setdefault(t.site.name, []).append(t.guarded())
        for site in groups[role].values():
            own = [e for a in site.distribution.parameters.values() for e in array(a).ravel()]
            out.append((role, site, [*own, *density.get(site.name, [])]))
    return out


def _of_rows(node: Expr) -> bool:
    """Whether what is called depends on more than parameters, so that it changes by row."""
    return any(s.data[0] != "parameter" for s in symbols_of(node))


def _error(
    calling: list[tuple[str, Site, list[Expr]]], found: Mapping[Expr, list[Expr]]
) -> ModelError:
    node = next(iter(found))
    inside = [(r, s) for r, s, roots in calling if node in set(topological(roots))]
    role, site = inside[0]
    names = list(dict.fromkeys(p.data[1] for ps in found.values() for p in ps))
    named = " and ".join(filter(None, [", ".join(names[:-1]), names[-1]]))
    function = node.data.__name__
    return ModelError(
        f"diagnose needs the derivatives of {_LAW_OF[role]} {site.name} in {named}, and "
        f"{function}() is an @ssm.primitive, which has none",
        fix=f"write the formula of {function} in the model, with NumPy functions, or give the "
        f"values of {named} in fixed=",
        where=site.distribution.location,
    )
