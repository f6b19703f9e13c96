"""Whether a particle filter's likelihood can be made continuous in the parameters.

Malik and Pitt (2011): one scalar state, which moves continuously with the parameters when its
random numbers are held fixed.
"""

from __future__ import annotations

from ssmppl.analysis.structure import deterministic, exact_observation
from ssmppl.errors import NotApplicable
from ssmppl.expressions.arrays import array
from ssmppl.expressions.calculus import jumps
from ssmppl.expressions.expr import dependent, topological
from ssmppl.language.distributions import Draws, Mixture, ZeroInflated
from ssmppl.language.distributions.from_density import UserDefined
from ssmppl.language.model.trace import Trace


def smooth_filter_applies(trace: Trace) -> NotApplicable | None:
    """None where the continuous filter applies, else the reason why not."""
    exact = exact_observation(trace)
    if exact is not None:
        return exact
    if len(trace.state_symbols) != 1:
        return NotApplicable(
            f"the state has {len(trace.state_symbols)} components, and only one can be sorted"
        )
    for sites in (trace.initial, trace.transition):
        site = next(iter(sites.values()))
        d = site.distribution
        if d.discrete:
            return NotApplicable(f"{site.name} is discrete", d.location)
        if deterministic([site]):
            continue
        if isinstance(d, Mixture | ZeroInflated):
            kind = type(d).__name__
            return NotApplicable(f"draws of {kind} jump from one part to the other", d.location)
        draw = list(array(d.sample(Draws(site.name))).ravel())
        random = [n for n in topological(draw) if n.op == "random"]
        moving = dependent(draw, random) if isinstance(d, UserDefined) else set()
        if any(map(jumps, moving)):
            return NotApplicable(f"the sampler of {type(d).__name__} may jump", d.location)
        for node in random:
            if node.data[0] not in ("normal", "uniform"):
                return NotApplicable(
                    f"draws of {type(d).__name__} come by rejection, and jump where the "
                    "parameters change",
                    d.location,
                )
    return None
