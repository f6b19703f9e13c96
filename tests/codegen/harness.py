"""Generated functions run in plain Python over the compiled scalar kernels, and what they mean."""

import ast
import types
from copy import copy
from pathlib import Path

import numpy as np

from ssmppl.codegen.text.module import Layout
from ssmppl.expressions.arrays import array
from ssmppl.expressions.evaluate import evaluate, numpy_draws
from ssmppl.expressions.expr import symbol, topological
from ssmppl.language.model.trace import previous, seen, symbols

STEPS, PARTICLES, ROOM = 4, 5, 400


def plain(function, **replaced):
    """The Python function under a compiled one; what it calls stays compiled.

    Results of these are np.float64, so that 1 / 0 is inf as in compiled code.
    """
    body = getattr(function, "py_func", function)
    own = {n: _numpy_result(v) if callable(v) else v for n, v in body.__globals__.items()}
    own |= replaced
    run = types.FunctionType(body.__code__, own, body.__name__, body.__defaults__)

    def call(*args):
        with np.errstate(all="ignore"):
            return run(*args)

    return call


def _numpy_result(function):
    if isinstance(function, type):
        return function

    def call(*args):
        out = function(*args)
        return np.float64(out) if isinstance(out, float) else out

    return call


class _NumpyNumbers(ast.NodeTransformer):
    def visit_Constant(self, node):
        if not isinstance(node.value, float):
            return node
        return ast.Call(ast.parse("np.float64", mode="eval").body, [node], [])


def run_plainly(text, namespace):
    """Execute generated text with its decorators doing nothing and its numbers NumPy's."""
    space = namespace | {"exact": lambda f: f, "kernel": lambda f: f}
    tree = ast.fix_missing_locations(_NumpyNumbers().visit(ast.parse(text)))
    exec(compile(tree, "<generated>", "exec"), space)
    return space


def plain_module(module):
    """The functions of a generated module in plain Python, as attributes; what they import stays
    compiled."""
    module = getattr(module, "module", module)  # the text behind algorithms of native code
    tree = ast.parse(Path(module.__file__).read_text())
    own = [n for n in tree.body if not _compiles(n)]
    space = run_plainly(ast.unparse(ast.Module(own, [])), {"entry": lambda f: f})
    return types.SimpleNamespace(**space)


def _compiles(node):
    """Whether a statement binds a decorator of Numba's."""
    if isinstance(node, ast.ImportFrom):
        return node.module.endswith(".flags")
    return isinstance(node, ast.Assign) and node.targets[0].id == "entry"


class Numbers:
    """Random values of everything that a trace's laws depend on."""

    def __init__(self, traced, rng, missing=False):
        self.traced = traced
        self.guide = [{}] * STEPS
        self.layout = Layout(traced)
        draw = numpy_draws(rng)
        values = {}
        for name, length in traced.inputs.items():
            for s in symbols("input", name, length).ravel():
                values[s] = rng.uniform(0.2, 1.5, STEPS)
        self.u = np.array([values[s] for s in traced.input_symbols]).reshape(-1, STEPS).T.copy()
        known = {}
        for site in traced.parameters.values():
            self._draw(site, known, draw)
        self.theta = np.array([known[s] for s in traced.parameter_symbols])
        self.y = np.zeros((STEPS, len(traced.observation_symbols)))
        self.states = np.zeros((STEPS, len(traced.state_symbols), PARTICLES))
        for t in range(STEPS):
            before = max(t - 1, 0)
            rows = dict(known)
            rows[symbol("time", "t")], rows[symbol("time_prev", "t")] = t + 1.0, float(t)
            for s, v in values.items():
                rows[s], rows[previous(s)] = v[t], v[before]
            for k, s in enumerate(traced.observation_symbols):
                rows[previous(s)] = self.y[before, k]
            sites = traced.transition if t else traced.initial
            for i in range(PARTICLES):
                one = dict(rows)
                for k, s in enumerate(traced.state_symbols):
                    one[previous(s)] = self.states[before, k, i]
                for site in sites.values():
                    self._draw(site, one, draw)
                self.states[t, :, i] = [one[s] for s in traced.state_symbols]
            for site in traced.observations.values():
                self._draw(site, one, draw)
            self.y[t] = [one[s] for s in traced.observation_symbols]
        self.seen = np.ones(self.y.shape)
        if missing:
            self._hide(rng)

    def _draw(self, site, known, draw):
        from ssmppl.language.distributions import Draws

        sample = array(site.distribution.sample(Draws(site.name))).ravel()
        drawn = evaluate(list(sample), known, draw)
        known.update(zip(site.value.ravel(), drawn, strict=True))

    def _hide(self, rng):
        """Missing components; whole channels of joint laws other than MvNormal."""
        from ssmppl.language.distributions import MvNormal

        at = 0
        for site in self.traced.observations.values():
            n, d = len(site.components), site.distribution
            whole = d.joint and not isinstance(d, MvNormal)
            mask = (rng.random((STEPS, 1 if whole else n)) < 0.6).astype(float)
            self.seen[:, at : at + n] = mask
            at += n
        self.y *= self.seen

    def guided(self, order, rng):
        """A copy with random values of a guide's symbols, in this order behind the inputs."""
        out = copy(self)
        out.guide = [random_guide(order, rng) for _ in range(STEPS)]
        columns = np.array([[row[s] for s in order] for row in out.guide])
        out.u = np.hstack([self.u, columns])
        return out

    def values(self, t):
        """Symbol -> value at step t, one per particle where states are involved."""
        traced, before = self.traced, max(t - 1, 0)
        out = dict(zip(traced.parameter_symbols, self.theta, strict=True))
        out |= self.guide[t]
        out[symbol("time", "t")], out[symbol("time_prev", "t")] = t + 1.0, float(t)
        for k, s in enumerate(traced.input_symbols):
            out[s], out[previous(s)] = self.u[t, k], self.u[before, k]
        for k, s in enumerate(traced.observation_symbols):
            out[s], out[previous(s)], out[seen(s)] = (
                self.y[t, k], self.y[before, k], self.seen[t, k]
            )  # fmt: skip
        for k, s in enumerate(traced.state_symbols):
            out[s], out[previous(s)] = self.states[t, k], self.states[before, k]
        return out


def random_guide(order, rng):
    """Symbol -> value of a twisted proposal's guide: a precision of one rank less than full, where
    that is any, and a lower factor with a positive diagonal."""
    places = [(s, s.data[1], s.data[2]) for s in order]
    d = sum(name == "pull" for _, name, _ in places)
    half = rng.normal(size=(d, max(d - 1, 1)))
    precision = half @ half.T
    return {
        s: precision[index] if name == "precision"
        else rng.uniform(0.8, 2.0) if name == "start_factor" and index[0] == index[1]
        else rng.normal()
        for s, name, index in places
    }  # fmt: skip


def noise_of(roots, rng):
    """Buffers of normals and uniforms, and the value of each such node; in the kernels' order."""
    buffers, nodes = {"normal": [], "uniform": []}, {}
    for node in topological(roots):
        if node.op == "random" and node.data[0] in buffers:
            kind = node.data[0]
            value = rng.standard_normal(PARTICLES) if kind == "normal" else rng.random(PARTICLES)
            if kind == "uniform":
                value[0] *= 0.01  # a mixture's smaller share, too
            buffers[kind].append(value)
            nodes[node] = value
    flat = {k: np.concatenate([*v, np.zeros(ROOM)]) for k, v in buffers.items()}
    return flat["normal"], flat["uniform"], nodes


def stand_in(kind, args):
    """A number in place of a gamma, Poisson, von Mises or binomial draw, from its parameters."""
    if kind == "gamma":
        return 0.7 * args[0] + 0.1
    if kind == "poisson":
        return np.floor(args[0] + 0.5)
    if kind == "vonmises":
        return 1.0 / (1.0 + args[0])
    return np.floor(args[0] * args[1] + 0.5)


STAND_INS = {
    "gamma": lambda rng, a: stand_in("gamma", (a,)),
    "poisson": lambda rng, a: stand_in("poisson", (a,)),
    "vonmises": lambda rng, k: stand_in("vonmises", (k,)),
    "binomial": lambda rng, n, p: stand_in("binomial", (n, p)),
}
