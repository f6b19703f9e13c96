"""A model as a directed graph: which quantity's distribution reads which others."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from ssmppl.expressions.expr import symbols_of
from ssmppl.language.distributions import Dirac
from ssmppl.language.model.covariances import together
from ssmppl.language.model.trace import Site, Trace

# Roles of nodes, and of symbols that stand for them in a distribution.
PARAMETER, INPUT, BEFORE, STATE, OBSERVED = "parameter", "input", "before", "state", "observed"
_ROLE = {
    "parameter": PARAMETER, "input": INPUT, "input_prev": INPUT, "state": STATE,
    "state_prev": BEFORE, "observation": OBSERVED, "observation_prev": BEFORE,
}  # fmt: skip


@dataclass(frozen=True)
class Node:
    """A quantity. role : PARAMETER, INPUT, BEFORE (a state at the row before), STATE or OBSERVED.

    name : of the quantity. distribution : the name of its family, "" of an input and at the row
    before. deterministic : whether it has no noise.
    """

    role: str
    name: str
    distribution: str = ""
    deterministic: bool = False

    @property
    def key(self) -> str:
        return f"{self.role}:{self.name}"


@dataclass(frozen=True)
class Edge:
    """From what is read to whose distribution reads it, by the keys of the nodes. first : whether
    that is the distribution at the first row."""

    start: str
    end: str
    first: bool = False


@dataclass(frozen=True)
class ModelGraph:
    """Nodes, in the model's order, and edges, each once."""

    nodes: tuple[Node, ...]
    edges: tuple[Edge, ...]

    def of_role(self, role: str) -> list[Node]:
        return [n for n in self.nodes if n.role == role]


def model_graph(trace: Trace) -> ModelGraph:
    """The graph of one row of a traced model, and of what it reads of the row before."""
    trace = together(trace)
    nodes = [_node(PARAMETER, s) for s in trace.parameters.values()]
    nodes += [Node(INPUT, name) for name in trace.inputs]
    edges: list[Edge] = []
    for site in trace.parameters.values():
        edges += [Edge(k, f"{PARAMETER}:{site.name}") for k in _read(site)]
    for role, sites in ((STATE, trace.transition), (OBSERVED, trace.observations)):
        for site in sites.values():
            edges += [Edge(k, f"{role}:{site.name}") for k in _read(site)]
    # x_1 stands where the row before does: nothing came before it.
    for site in trace.initial.values():
        if site.name not in trace.auxiliary:
            edges += [Edge(k, f"{BEFORE}:{site.name}", first=True) for k in _read(site)]
    met = {k for e in edges for k in (e.start, e.end)}
    before = [Node(BEFORE, n) for n in (*trace.initial, *trace.observations)]
    nodes += [n for n in before if n.key in met]
    nodes += [_node(STATE, s) for s in trace.transition.values()]
    nodes += [_node(OBSERVED, s) for s in trace.observations.values()]
    return ModelGraph(tuple(nodes), tuple(dict.fromkeys(edges)))


def _node(role: str, site: Site) -> Node:
    family = type(site.distribution).__name__
    return Node(role, site.name, family, isinstance(site.distribution, Dirac))


def _read(site: Site) -> Iterable[str]:
    """The keys of the quantities that a distribution reads, in the order of their names."""
    own = symbols_of(site.distribution.arguments())
    found = {f"{_ROLE[s.data[0]]}:{s.data[1]}" for s in own if s.data[0] in _ROLE}
    return sorted(found)
