"""`plot_model`: a model as a picture, with what was derived from it."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping
from typing import Any

from ssmppl.analysis.finite import FiniteStates
from ssmppl.analysis.model_graph import (
    BEFORE,
    INPUT,
    OBSERVED,
    PARAMETER,
    STATE,
    Edge,
    ModelGraph,
    Node,
    model_graph,
)
from ssmppl.arguments import checked
from ssmppl.drawing.style import FAINT, INK, MAIN, OTHER
from ssmppl.errors import ArgumentError, NotApplicable
from ssmppl.inference.preparation.exact_models import exact_kind, exact_model
from ssmppl.inference.verbs.explain import Plan, explain
from ssmppl.language.model.model import Model
from ssmppl.language.tracing import trace
from ssmppl.plots.drawing import styled

__all__ = ["plot_model"]

ROOM, GAP = 0.72, 0.5  # inches of a node's height, and between parameters and the rows
WIDTH = 8.0
IN_A_ROW = 5  # parameters
MOST_IN_A_NOTEBOOK = 40  # quantities
SHOWN = 560  # pixels of the picture's width there, at most
COLUMNS = {BEFORE: 0.12, STATE: 0.5, OBSERVED: 0.88}
EXACT = {
    "linear Gaussian": "exact: Kalman filter",
    "finite-state (hidden Markov)": "exact: forward algorithm",
}
FACES = {
    PARAMETER: "white",
    INPUT: "#f3e9d8",
    BEFORE: "white",
    STATE: "#dcebf5",
    OBSERVED: "#d9d9d9",
}


@checked
def plot_model(model: Model, *, graphviz: bool = False, ax: Any = None) -> Any:
    """The quantities of a model and what reads what, with what was derived from it.

    Parameters stand above, with the families of their priors and how Gibbs samplers draw them;
    below are the rows of the data, row t - 1 to the left of row t: states, and to their right what
    is observed (grey). Over the arrows from row to row stands how the likelihood is had: exactly,
    or by which particle filters. Dashed arrows to row t - 1 are those of the initial distribution.

    Parameters
    ----------
    model : the model, as declared.
    graphviz : draw by Graphviz, whose Python package has to be installed.
    ax : Matplotlib axes; None: a new figure.

    Returns
    -------
    Axes
        Or a `graphviz.Source`.

    Raises
    ------
    ModelError : the model is not complete.
    ArgumentError : Graphviz is asked for and not there, or `ax` is none.
    """
    plan = explain(model)
    graph = model_graph(plan.trace)
    if graphviz:
        return _source(dot_text(graph, plan))
    return _drawn(graph, plan, ax)


def svg_of(model: Model) -> str:
    """The picture as SVG, to stand in the HTML of a notebook; empty of a model of so many
    quantities that it could not be read there.

    Raises
    ------
    ModelError : the model is not complete.
    ImportError : there is no Matplotlib.
    """
    graph = model_graph(trace(model))
    if len(graph.nodes) > MOST_IN_A_NOTEBOOK:
        return ""
    import matplotlib
    from matplotlib.figure import Figure

    # Text stays text, and names within the picture are the same each time.
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": model.name}):
        figure = Figure(figsize=(WIDTH, _height(graph)), layout="constrained")
        _drawn(graph, explain(model), figure.subplots())
        out = io.StringIO()
        figure.savefig(out, format="svg", transparent=True, metadata={"Date": None})
    text = out.getvalue()
    text = text[text.index("<svg") :]  # without what only a file of its own begins with
    text = re.sub(r"<metadata>.*?</metadata>\s*", "", text, flags=re.DOTALL)
    head, _, rest = text.partition(">")
    head = re.sub(r' (?:width|height)="[^"]*"', "", head)
    colour = "background:white;color:black"  # the picture's, on dark pages too
    return f'{head} style="max-width:{SHOWN}px;width:100%;{colour}">{rest}'


# -- words
def derived_of(plan: Plan) -> dict[str, str]:
    """How each parameter is drawn by Gibbs samplers."""
    return {
        name: "slice" if u.family_name == "slice" else u.family_name
        for u in plan.updates
        for name in u.block
    }


def likelihood_of(plan: Plan) -> str:
    """How the likelihood is had."""
    if isinstance(plan.finite, FiniteStates):
        return EXACT["finite-state (hidden Markov)"]
    kind = exact_kind(exact_model(plan.trace))
    if not isinstance(kind, NotApplicable):
        return EXACT.get(kind, f"exact: {kind}")
    found = [n for n, p in plan.proposals.items() if not isinstance(p, NotApplicable)]
    return f"particles: {', '.join(found)}"


def _text(node: Node, derived: Mapping[str, str]) -> str:
    if node.role == BEFORE:
        return f"{node.name}\nt - 1"
    family = "computed" if node.deterministic else node.distribution
    if node.role == PARAMETER and node.name in derived:
        return f"{node.name}\n{family}\nGibbs: {derived[node.name]}"
    return f"{node.name}\n{family}" if family else f"{node.name}\ninput"


# -- by Matplotlib
def _height(graph: ModelGraph) -> float:
    """In inches."""
    lines = -(-len(graph.of_role(PARAMETER)) // IN_A_ROW)
    before = len(graph.of_role(BEFORE)) + len(graph.of_role(INPUT))
    high = max(before, len(graph.of_role(STATE)), len(graph.of_role(OBSERVED)))
    return ROOM * (lines + high) + GAP * bool(lines) + 0.6


@styled
def _drawn(graph: ModelGraph, plan: Plan, ax: Any) -> Any:
    parameters, inputs = graph.of_role(PARAMETER), graph.of_role(INPUT)
    columns = {role: graph.of_role(role) for role in COLUMNS}
    columns[BEFORE] = columns[BEFORE] + inputs
    lines = -(-len(parameters) // IN_A_ROW)
    high = max(map(len, columns.values()))
    height = _height(graph)
    if ax is None:
        from matplotlib import pyplot

        ax = pyplot.figure(figsize=(WIDTH, height), layout="constrained").subplots()
    elif not hasattr(ax, "annotate"):
        raise ArgumentError(
            f"ax= of plot_model is {type(ax).__name__}", fix="give Matplotlib axes, or None"
        )
    ax.set(xlim=(0.0, 1.0), ylim=(height, 0.0))
    ax.set_axis_off()
    top = ROOM * lines + GAP * bool(lines)
    places: dict[str, tuple[float, float]] = {}
    each = -(-len(parameters) // max(lines, 1))
    for k, node in enumerate(parameters):
        row, column = divmod(k, each)  # rows are staggered, so that arrows pass between
        across = (column + 0.5 + 0.5 * (row % 2)) / (each + 0.5 * (lines > 1))
        places[node.key] = (across, ROOM * (row + 0.5))
    for role, nodes in columns.items():
        step = ROOM * high / max(len(nodes), 1)
        for k, node in enumerate(nodes):
            places[node.key] = (COLUMNS[role], top + 0.5 + step * (k + 0.5))
    _plate(ax, top + 0.05, height - 0.05, _title(plan))
    middle = 0.5 * (COLUMNS[BEFORE] + COLUMNS[STATE])
    behind = {"facecolor": "white", "edgecolor": "none", "pad": 1.0}
    ax.text(middle, top + 0.3, likelihood_of(plan), ha="center", va="center", color=MAIN,
            fontsize=8.0, zorder=5, bbox=behind)  # fmt: skip
    derived = derived_of(plan)
    boxes = {
        node.key: ax.text(
            *places[node.key], _text(node, derived), ha="center", va="center", fontsize=8.0,
            zorder=3, linespacing=1.15, bbox=_box(node),
        )
        for node in graph.nodes
    }  # fmt: skip
    for edge in graph.edges:
        _arrow(ax, edge, places, boxes)
    return ax


def _title(plan: Plan) -> str:
    of = plan.trace.experiment
    return f"rows t = 1, ..., T of each {of}" if of else "rows t = 1, ..., T of each experiment"


def _plate(ax: Any, low: float, high: float, title: str) -> None:
    from matplotlib.patches import FancyBboxPatch

    ax.add_patch(
        FancyBboxPatch(
            (0.012, low), 0.976, high - low, boxstyle="round,pad=0,rounding_size=0.02",
            mutation_aspect=8.0, facecolor="none", edgecolor=FAINT, linewidth=0.8,
        )
    )  # fmt: skip
    ax.text(0.98, high - 0.08, title, ha="right", va="bottom", fontsize=7.5, color=FAINT)


def _box(node: Node) -> dict[str, Any]:
    style = "square,pad=0.35" if node.role == INPUT else "round,pad=0.35,rounding_size=0.9"
    dashed = node.role == BEFORE
    return {
        "boxstyle": style, "facecolor": FACES[node.role], "edgecolor": FAINT if dashed else INK,
        "linewidth": 0.8, "linestyle": "--" if node.deterministic else "-",
    }  # fmt: skip


def _arrow(
    ax: Any, edge: Edge, places: Mapping[str, tuple[float, float]], boxes: Mapping[str, Any]
) -> None:
    (x0, y0), (x1, y1) = places[edge.start], places[edge.end]
    role = edge.start.partition(":")[0]
    colour = {PARAMETER: FAINT, INPUT: OTHER}.get(role, MAIN)
    same = abs(x0 - x1) < 1e-9
    ax.annotate(
        "", xy=(x1, y1), xytext=(x0, y0),
        arrowprops={
            "arrowstyle": "-|>", "color": colour, "linewidth": 0.7 if role == PARAMETER else 1.1,
            "linestyle": "--" if edge.first else "-", "shrinkA": 1.0, "shrinkB": 1.0,
            "patchA": boxes[edge.start].get_bbox_patch(),
            "patchB": boxes[edge.end].get_bbox_patch(),
            "connectionstyle": "arc3,rad=0.35" if same and abs(y0 - y1) > ROOM else "arc3,rad=0",
            "mutation_scale": 9.0, "alpha": 0.8 if role == PARAMETER else 1.0,
        },
        zorder=4,  # after the boxes, which know their size once they are drawn
    )  # fmt: skip


# -- by Graphviz
def dot_text(graph: ModelGraph, plan: Plan) -> str:
    """The picture in the language of Graphviz."""
    derived = derived_of(plan)
    shapes = {INPUT: "box", PARAMETER: "ellipse"}
    lines = ["digraph model {", "  rankdir=TB; node [fontsize=10]; edge [fontsize=9];"]
    lines += [_dot_node(n, derived, "ellipse", "  ") for n in graph.of_role(PARAMETER)]
    lines += ["  subgraph cluster_rows {", f"    label={_quoted(_title(plan))}; style=rounded;"]
    for role in (INPUT, BEFORE, STATE, OBSERVED):
        shape = shapes.get(role, "circle" if role == BEFORE else "ellipse")
        lines += [_dot_node(n, derived, shape, "    ") for n in graph.of_role(role)]
    lines.append("  }")
    labelled = False
    for e in graph.edges:
        about = ["style=dashed"] if e.first else []
        if not labelled and e.start.startswith(BEFORE) and e.end.startswith(STATE):
            about.append(f"label={_quoted(likelihood_of(plan))}")
            labelled = True
        own = f" [{', '.join(about)}]" if about else ""
        lines.append(f"  {_quoted(e.start)} -> {_quoted(e.end)}{own};")
    return "\n".join([*lines, "}"])


def _dot_node(node: Node, derived: Mapping[str, str], shape: str, indent: str) -> str:
    label = _text(node, derived).replace("\n", "\\n")
    return (
        f'{indent}{_quoted(node.key)} [label="{label}", shape={shape}, style=filled, '
        f'fillcolor="{FACES[node.role]}"];'
    )


def _quoted(text: str) -> str:
    return '"' + text.replace('"', '\\"') + '"'


def _source(text: str) -> Any:
    try:
        import graphviz  # type: ignore[import-not-found]
    except ImportError:
        raise ArgumentError(
            "graphviz=True, and the package graphviz is not installed",
            fix="pip install graphviz (and the program of that name), or leave it out: "
            "Matplotlib draws the model too",
        ) from None
    return graphviz.Source(text)
