"""Parameters whose prior goes beyond what the distributions that they are in allow."""

from __future__ import annotations

from collections.abc import Iterator

from ssmppl.expressions.arrays import array
from ssmppl.language.distributions import Distribution
from ssmppl.language.model.trace import Site, Trace


def beyond_range(trace: Trace) -> list[str]:
    """What to tell of each parameter that stands, as it is, for a spread, a rate or a probability,
    where its prior has draws that none can be. There the likelihood is zero: the posterior is that
    of the prior cut off, which was hardly meant."""
    found: dict[str, str] = {}
    for site in (*trace.initial.values(), *trace.transition.values(), *trace.observations.values()):
        for name, argument, low, high in _ranged(site.distribution):
            prior = trace.parameters.get(name)
            beyond = prior is not None and _draws_beyond(prior, low, high)
            if beyond and prior is not None and name not in found:
                found[name] = (
                    f"the prior of {name!r} ({type(prior.distribution).__name__}, "
                    f"{prior.distribution.location}) gives values {beyond}, and {name} is the "
                    f"{argument} of {site.name!r} ({site.distribution.location}): the prior is cut "
                    f"off there. {_instead(low, high)}"
                )
    return list(found.values())


def _ranged(law: Distribution) -> Iterator[tuple[str, str, float, float]]:
    """Parameters that stand for an argument of limited range, as they are: (parameter, argument,
    lowest, highest value)."""
    for argument, (low, high, _) in law.ranges.items():
        for e in law.parameters[argument].ravel():
            if e.op == "symbol" and e.data[0] == "parameter":
                yield e.data[1], argument.removeprefix("like_").rstrip("_"), low, high


def _draws_beyond(prior: Site, low: float, high: float) -> str:
    """Which values of the prior are out of range, in words; empty where none is."""
    support = prior.distribution.support()
    if support.kind not in ("interval", "real"):
        return ""
    ends = (list(array(end).ravel()) for end in (support.lower, support.upper))
    least, most = ([e.data for e in own if e.op == "const"] for own in ends)
    below = any(v < low for v in least)
    above = any(v > high for v in most)
    said = [f"below {low:g}"] * below + [f"above {high:g}"] * above
    return " and ".join(said)


def _instead(low: float, high: float) -> str:
    if low == 0.0 and high == float("inf"):
        return "Write a prior of positive numbers, such as ssm.HalfNormal(sd=) or ssm.LogNormal"
    if (low, high) == (0.0, 1.0):
        return "Write a prior from 0 to 1, such as ssm.Beta or ssm.Uniform(0, 1)"
    return "Write ssm.Truncated(..., lower=, upper=) if that is meant"
