"""`plot_model`: what is drawn, and what stands on it."""

from __future__ import annotations

import builtins
import re
import warnings

import matplotlib.pyplot as plt
import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.analysis.model_graph import Edge, model_graph
from ssmppl.language.model import model as model_module
from ssmppl.language.tracing import trace
from ssmppl.plots.model import dot_text


def epidemic() -> ssm.Model:
    """Parameters of both kinds, a draw of the step, a computed state, an input, and feedback."""
    model = ssm.Model("epidemic", inputs=("u",), experiment="town")

    @model.prior
    def mean():
        return {"m": ssm.Normal(0, sd=1)}

    @model.prior
    def prior(m):
        return {"beta": ssm.LogNormal(m, sd=1), "q": ssm.InverseGamma(3, scale=1)}

    @model.initial
    def initial(m):
        return {"x": ssm.Normal(m, sd=1), "total": ssm.Dirac(0.0)}

    @model.transition
    def draw(x, u, beta):
        return {"new": ssm.Poisson(np.exp(beta * x + u))}

    @model.transition
    def step(x, y, total, new_next, q):
        return {
            "x": ssm.Normal(0.9 * x + 0.1 * y, variance=q),
            "total": ssm.Dirac(total + new_next),
        }

    @model.observation
    def observation(x, total):
        return {"y": ssm.Normal(x + 0 * total, sd=1), "count": ssm.Poisson(total + 1)}

    return model


def test_edges_are_what_each_distribution_reads():
    graph = model_graph(trace(epidemic()))
    assert set(graph.edges) == {
        Edge("parameter:m", "parameter:beta"), Edge("before:x", "state:new"),
        Edge("input:u", "state:new"), Edge("parameter:beta", "state:new"),
        Edge("before:x", "state:x"), Edge("before:y", "state:x"), Edge("parameter:q", "state:x"),
        Edge("before:total", "state:total"), Edge("state:new", "state:total"),
        Edge("state:x", "observed:y"), Edge("state:total", "observed:count"),
        Edge("parameter:m", "before:x", first=True),
    }  # fmt: skip
    about = {n.key: (n.distribution, n.deterministic) for n in graph.nodes}
    assert about["parameter:beta"] == ("LogNormal", False)
    assert about["state:total"] == ("Dirac", True)
    assert about["observed:count"] == ("Poisson", False)
    assert "before:new" not in about


def test_what_stands_on_it():
    ax = ssm.plot_model(epidemic())
    texts = [t.get_text() for t in ax.texts]
    assert "beta\nLogNormal\nGibbs: slice" in texts
    assert "q\nInverseGamma\nGibbs: inverse Gamma" in texts
    assert "total\ncomputed" in texts
    assert "u\ninput" in texts
    assert "y\nt - 1" in texts
    assert "particles: bootstrap, guided" in texts
    assert "rows t = 1, ..., T of each town" in texts
    arrows = [t for t in ax.texts if getattr(t, "arrow_patch", None) is not None]
    assert len(arrows) == len(model_graph(trace(epidemic())).edges)
    assert sum(a.arrow_patch.get_linestyle() == "--" for a in arrows) == 1
    plt.close("all")


@pytest.mark.parametrize(
    ("law", "text"),
    [
        (lambda x: {"x": ssm.Normal(0.5 * x, sd=1)}, "exact: Kalman filter"),
        (lambda x: {"x": ssm.Bernoulli(np.where(x > 0, 0.9, 0.1))}, "exact: forward algorithm"),
        (lambda x: {"x": ssm.Dirac(np.sin(x))}, "exact: noise-free in its states"),
        (lambda x: {"x": ssm.Normal(np.sin(x), sd=1)}, "particles: "),
    ],
)
def test_how_the_likelihood_is_had(law, text):
    model = ssm.Model("m")
    model.initial(lambda: {"x": ssm.Bernoulli(0.5) if "forward" in text else ssm.Dirac(1.0)
                           if "noise" in text else ssm.Normal(0, sd=1)})  # fmt: skip
    model.transition(law)
    model.observation(lambda x: {"y": ssm.Normal(x, sd=1)})
    found = [t.get_text() for t in ssm.plot_model(model).texts]
    assert any(t.startswith(text) for t in found)
    plt.close("all")


def test_axes_that_are_given_are_drawn_on():
    figure, ax = plt.subplots()
    assert ssm.plot_model(epidemic(), ax=ax) is ax
    with pytest.raises(ssm.ArgumentError, match="Matplotlib axes"):
        ssm.plot_model(epidemic(), ax=figure)
    plt.close("all")


def test_no_two_nodes_lie_over_each_other():
    """Of nine parameters and six states."""
    model = ssm.Model("many")
    names = [f"p{k}" for k in range(9)]
    states = [f"x{k}" for k in range(6)]
    model.prior(lambda: {n: ssm.InverseGamma(3, scale=1) for n in names})
    model.initial(lambda: {n: ssm.Normal(0, sd=1) for n in states})
    text = f"lambda {', '.join(states)}, {', '.join(names)}: {{" + ", ".join(
        f"'{n}': ssm.Normal({n}, variance={p})" for n, p in zip(states, names, strict=False)
    ) + "}"  # fmt: skip
    model.transition(eval(text, {"ssm": ssm}))
    model.observation(lambda x0, p6, p7, p8: {"y": ssm.Normal(x0, variance=p6 + p7 + p8)})
    ax = ssm.plot_model(model)
    ax.figure.canvas.draw()
    boxes = [t.get_bbox_patch().get_window_extent() for t in ax.texts if t.get_bbox_patch()]
    for i, a in enumerate(boxes):
        assert not any(a.overlaps(b) for b in boxes[i + 1 :])
    plt.close("all")


def test_graphviz_gets_the_same_picture(monkeypatch):
    text = dot_text(model_graph(trace(epidemic())), ssm.explain(epidemic()))
    assert text.count(" -> ") == 12
    assert '"parameter:m" -> "before:x" [style=dashed];' in text
    assert 'label="particles: bootstrap, guided"' in text
    assert text.count("{") == text.count("}")
    real = builtins.__import__

    def without(name, *args, **kwargs):
        if name == "graphviz":
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(ssm.ArgumentError, match="pip install graphviz"):
        ssm.plot_model(epidemic(), graphviz=True)


def shown(model) -> str:
    return model._repr_html_()


def test_a_notebook_shows_the_picture():
    html = shown(epidemic())
    picture = html[html.index("<svg") : html.index("</svg>")]
    for word in ("beta", "LogNormal", "count", "computed", "of each town"):
        assert f">{word}" in picture or f"{word}<" in picture
    assert not re.findall(r"(?:href|src)=.(?!#)|<script|url\((?!#)", picture)  # asks for nothing
    assert "<table" in html
    assert html == shown(epidemic())  # also the names within it
    assert plt.get_fignums() == []


@pytest.mark.parametrize("fault", ["raises", "is not linear", "exits", "warns"])
def test_showing_a_faulty_model_never_fails(fault):
    def transition(x):
        if fault == "raises":
            return {"x": ssm.Normal(x, sd=1.0 / 0.0)}
        if fault == "is not linear":
            return {"x": ssm.Normal(x, sd=1.0) if x > 0 else ssm.Normal(0, sd=1)}
        if fault == "exits":
            raise RecursionError("too deep")
        warnings.warn("odd", stacklevel=1)
        return {"x": ssm.Normal(x, sd=1.0)}

    model = ssm.Model("faulty")
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(transition)
    model.observation(lambda x: {"y": ssm.Normal(x, sd=1)})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        html = shown(model)
    assert "<table" in html
    assert ("<svg" in html) is (fault == "warns")


def test_a_model_that_is_not_complete_is_not_run():
    calls = []
    model = ssm.Model("begun")
    model.prior(lambda: calls.append(1) or {"a": ssm.Normal(0, sd=1)})
    model.initial(lambda a: {"x": ssm.Normal(a, sd=1)})
    assert "<svg" not in shown(model)
    assert calls == []


def test_a_picture_is_drawn_once_and_again_after_a_change(monkeypatch):
    drawings = []
    draw = model_module.draw
    monkeypatch.setattr(model_module, "draw", lambda m: drawings.append(1) or draw(m))
    model = epidemic()
    assert shown(model) == shown(model)
    assert len(drawings) == 1
    model.observation(lambda x: {"late": ssm.Normal(x, sd=2)})
    assert ">late" in shown(model)
    assert len(drawings) == 2


def test_without_matplotlib_and_of_many_quantities_there_is_none(monkeypatch):
    many = ssm.Model("many")
    names = [f"x{i}" for i in range(20)]
    many.initial(lambda: {n: ssm.Normal(0, sd=1) for n in names})
    for n in names:
        space = {"ssm": ssm}
        exec(f"def move({n}): return {{'{n}': ssm.Normal({n}, sd=1)}}", space)
        many.transition(space["move"])
    many.observation(lambda x0: {"y": ssm.Normal(x0, sd=1)})
    assert "<svg" not in shown(many)
    load = builtins.__import__

    def without(name, *args, **kwargs):
        if name.partition(".")[0] == "matplotlib":
            raise ImportError(name)
        return load(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    html = shown(epidemic())
    assert "<table" in html
    assert "<svg" not in html
