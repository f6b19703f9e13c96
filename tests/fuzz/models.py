"""Random models as source text, sound ones and broken ones.

The text is what a user would have in a file: a case that fails can be kept, read and run by hand.
Sound models may still be hard: densities that vanish, weights of zero, roots of negative numbers.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field

import numpy as np

REAL, POSITIVE, UNIT, COUNT, BINARY, LABEL = "real", "positive", "unit", "count", "binary", "label"
SUPPORTS = (REAL, POSITIVE, UNIT, COUNT, BINARY, LABEL)


@dataclass
class Recipe:
    """A model's text with what a caller has to know of it.

    inputs : length of each, 1 for scalars. channels, parameters : support and shape by name.
    linear : linear and Gaussian, as written. fault : what was broken, "" for a sound model.
    """

    text: str
    inputs: dict[str, int] = field(default_factory=dict)
    channels: dict[str, tuple[str, tuple[int, ...]]] = field(default_factory=dict)
    parameters: dict[str, tuple[str, tuple[int, ...]]] = field(default_factory=dict)
    linear: bool = False
    fault: str = ""


class Writer:
    """Writes one model. `rng` decides everything."""

    def __init__(self, rng: np.random.Generator):
        self.rng = rng
        self.linear = rng.random() < 0.25
        self.inputs = {f"u{k}": int(rng.choice([1, 1, 1, 2])) for k in range(rng.poisson(0.5))}
        self.parameters: dict[str, tuple[str, tuple[int, ...]]] = {}
        self.states: dict[str, tuple[str, tuple[int, ...]]] = {}
        self.channels: dict[str, tuple[str, tuple[int, ...]]] = {}

    def pick(self, *options):
        return options[self.rng.integers(len(options))]

    def number(self, low=-2.0, high=2.0):
        odd = self.rng.random()
        if odd < 0.04:
            return self.pick("0.0", "1.0", "-1.0", "1e-3", "50.0")
        return f"{self.rng.uniform(low, high):.3g}"

    def recipe(self) -> Recipe:
        prior = self._prior()
        initial, transition = self._states()
        observation = self._observation()
        given = "(" + "".join(f"{n!r}, " for n in self.inputs) + ")"
        if any(length > 1 for length in self.inputs.values()):
            given = repr(self.inputs)
        text = "import numpy as np\nimport ssmppl as ssm\n\n"
        text += f"model = ssm.Model('random', inputs={given})\n"
        for role, laws in (
            ("prior", prior), ("initial", initial),
            ("transition", transition), ("observation", observation),
        ):  # fmt: skip
            if laws:
                text += self._function(role, laws)
        inputs = dict(self.inputs)
        return Recipe(text, inputs, self.channels, self.parameters, self.linear)

    def _function(self, role, laws):
        body = ", ".join(f"{name!r}: {law}" for name, law in laws.items())
        known = list(self.parameters) if role != "prior" else []
        if role in ("transition", "observation"):
            known += [*self.states, *self.inputs, "t"]
        arguments = [n for n in known if self._uses(body, n)]
        return f"\n\n@model.{role}\ndef {role}({', '.join(arguments)}):\n    return {{{body}}}\n"

    @staticmethod
    def _uses(body, name):
        return re.search(rf"(?<!['\w]){name}\b(?!')", body) is not None

    def _prior(self):
        laws = {}
        for k in range(self.rng.integers(0, 4)):
            name, support = f"p{k}", self.pick(REAL, POSITIVE, POSITIVE, UNIT)
            shape: tuple[int, ...] = ()
            if support == REAL:
                laws[name] = self.pick(
                    "ssm.Normal(0.0, sd=1.0)", "ssm.Uniform(-1, 1)", "ssm.StudentT(4, 0, scale=1)",
                    "ssm.Laplace(0.0, scale=0.5)", "ssm.Truncated(ssm.Normal(0, sd=1), lower=-1)",
                    "ssm.Mixture([0.3, 0.7], [ssm.Normal(-1, sd=0.5), ssm.Normal(1, sd=0.5)])",
                )  # fmt: skip
                if laws[name].startswith("ssm.Normal") and self.rng.random() < 0.2:
                    shape = (2,)
                    laws[name] = "ssm.Normal(np.zeros(2), sd=0.5)"
            elif support == POSITIVE:
                laws[name] = self.pick(
                    "ssm.Gamma(2, rate=2)", "ssm.InverseGamma(3, scale=1)", "ssm.HalfNormal(sd=1)",
                    "ssm.HalfCauchy(scale=1)", "ssm.Exponential(rate=1)",
                    "ssm.LogNormal(0, sd=0.5)", "ssm.Weibull(2, scale=1)",
                )  # fmt: skip
            else:
                laws[name] = self.pick("ssm.Beta(2, 2)", "ssm.Uniform(0, 1)")
            self.parameters[name] = (support, shape)
        return laws

    def _states(self):
        initial, transition = {}, {}
        count = self.rng.integers(1, 4)
        kinds = []
        for k in range(count):
            kind = (
                REAL if self.linear else self.pick(REAL, REAL, REAL, POSITIVE, UNIT, LABEL, COUNT)
            )
            shape = (
                (int(self.rng.integers(2, 4)),) if kind == REAL and self.rng.random() < 0.25 else ()
            )
            kinds.append((f"x{k}", kind, shape))
            self.states[f"x{k}"] = (kind, shape)
        for name, kind, shape in kinds:
            own = dict(self.states)
            self.states = {}
            initial[name] = self._law(kind, shape)
            self.states = own
            transition[name] = self._law(kind, shape, before=name)
            if kind == REAL and not self.linear and self.rng.random() < 0.08:
                transition[name] = f"ssm.Dirac({self._like(shape, self._real())})"
        return initial, transition

    def _observation(self):
        laws = {}
        for k in range(self.rng.integers(1, 3)):
            kind = (
                REAL if self.linear else self.pick(REAL, REAL, POSITIVE, UNIT, COUNT, BINARY, LABEL)
            )
            shape = (2,) if kind == REAL and self.rng.random() < 0.15 else ()
            laws[f"y{k}"] = self._law(kind, shape)
            self.channels[f"y{k}"] = (kind, shape)
        return laws

    def _like(self, shape, e):
        """An expression of a shape: scalars are stacked."""
        if not shape:
            return e
        others = [self._linear() if self.linear else self._real() for _ in range(shape[0] - 1)]
        return f"np.stack([{', '.join([e, *others])}])"

    def _law(self, kind, shape=(), before=""):
        """A distribution with this support; the state `before` pulls at its own next value."""
        if kind == REAL:
            mean = self._linear() if self.linear else self._real()
            if before and not shape and self.rng.random() < 0.8:
                mean = f"{self.rng.uniform(-0.9, 0.95):.2f} * {before} + 0.2 * ({mean})"
            mean = self._like(shape, mean)
            spread = self._spread()
            if self.linear:
                if shape and self.rng.random() < 0.15:
                    return f"ssm.MvNormal({mean}, covariance={self._covariance(shape[0])})"
                return f"ssm.Normal({mean}, {self.pick('sd', 'variance', 'precision')}={spread})"
            if not shape and self.rng.random() < 0.35:
                return self.pick(
                    f"ssm.StudentT({self.pick('3', '4.5', '30')}, {mean}, scale={spread})",
                    f"ssm.Laplace({mean}, scale={spread})",
                    f"ssm.Cauchy({mean}, scale={spread})",
                    f"ssm.Truncated(ssm.Normal({mean}, sd={spread}), lower=-3, upper=4)",
                    f"ssm.Uniform({mean} - {spread}, {mean} + {spread})",
                    self._mixture(f"ssm.Normal({mean}, sd={spread})", "ssm.Normal(0, sd=5)"),
                )
            if shape and self.rng.random() < 0.03:
                return f"ssm.MvNormal({mean}, covariance={self._covariance(shape[0])})"
            return f"ssm.Normal({mean}, {self.pick('sd', 'variance', 'precision')}={spread})"
        if kind == POSITIVE:
            p, q = self._positive(), self._positive()
            return self.pick(
                f"ssm.Gamma({p}, rate={q})", f"ssm.InverseGamma({p}, scale={q})",
                f"ssm.LogNormal({self._real()}, sd={self._spread()})", f"ssm.Exponential(rate={q})",
                f"ssm.HalfNormal(sd={q})", f"ssm.HalfCauchy(scale={q})",
                f"ssm.Weibull({p}, scale={q})",
                self._mixture(f"ssm.Gamma({p}, rate={q})", "ssm.Exponential(rate=1)"),
            )  # fmt: skip
        if kind == UNIT:
            return f"ssm.Beta({self._positive()}, {self._positive()})"
        if kind == COUNT:
            return self.pick(
                f"ssm.Poisson({self._positive()})", f"ssm.Binomial(6, {self._unit()})",
                f"ssm.NegativeBinomial({self._positive()}, dispersion={self._positive()})",
                f"ssm.BetaBinomial(6, {self._positive()}, {self._positive()})",
                f"ssm.ZeroInflated(ssm.Poisson({self._positive()}), {self._unit()})",
                self._mixture("ssm.Poisson(1)", f"ssm.Binomial(6, {self._unit()})"),
            )  # fmt: skip
        if kind == BINARY:
            return f"ssm.Bernoulli({self._unit()})"
        p = self._unit()
        return f"ssm.Categorical(np.stack([0.5 * {p}, 0.5 * {p}, 1 - {p}]))"

    def _mixture(self, one, other):
        p = self._unit()
        return f"ssm.Mixture([1 - {p}, {p}], [{one}, {other}])"

    def _covariance(self, n):
        a = self.rng.normal(size=(n, n)).round(1)
        s = (a @ a.T + 0.5 * np.eye(n)).round(2)
        return f"np.array({s.tolist()})"

    def _spread(self):
        names = [n for n, (kind, _) in self.parameters.items() if kind == POSITIVE]
        if names and self.rng.random() < 0.6:
            return self.pick(*names)
        if not self.linear and self.rng.random() < 0.2:
            return self._positive()
        return self.number(0.05, 2.0)

    def _leaf(self):
        """A scalar that the law at hand can depend on."""
        names = ["t"] if self.rng.random() < 0.1 and self.states else []
        for name, (kind, shape) in {**self.parameters, **self.states}.items():
            if kind != LABEL or self.rng.random() < 0.5:
                names.append(f"{name}[{self.rng.integers(shape[0])}]" if shape else name)
        for name, length in self.inputs.items():
            if self.states:
                names.append(f"{name}[{self.rng.integers(length)}]" if length > 1 else name)
        if not names or self.rng.random() < 0.25:
            return self.number()
        return self.pick(*names)

    def _linear(self):
        """Linear in the states; coefficients are numbers or parameters."""
        terms = [self.number()]
        for name, (_, shape) in self.states.items():
            if self.rng.random() < 0.6:
                x = f"{name}[{self.rng.integers(shape[0])}]" if shape else name
                p = [n for n, (_, s) in self.parameters.items() if not s]
                by = self.pick(*p) if p and self.rng.random() < 0.4 else self.number(-0.6, 0.6)
                terms.append(f"{by} * {x}")
        if self.states:
            terms += [n for n, length in self.inputs.items() if length == 1]
        return " + ".join(terms)

    def _real(self, depth=2):
        if depth == 0:
            return self._leaf()
        a, b = self._real(depth - 1), self._real(depth - 1)
        return self.pick(
            self._leaf(), a, f"({a} + {b})", f"({a} - {b})", f"{self.number()} * ({a})",
            f"({a}) * ({b})", f"np.sin({a})", f"np.tanh({a})", f"np.cos(0.3 * ({a}))",
            f"({a}) / (1 + ({b}) ** 2)", f"np.where({a} > {b}, {a}, {b})", f"np.maximum({a}, {b})",
            f"np.log1p(({a}) ** 2)", f"abs({a})", f"np.exp(-({a}) ** 2)", f"np.arctan({a})",
            f"np.sqrt({a})", f"np.log({a})", f"({a}) / ({b})", f"np.exp({a})", f"({a}) ** 3",
        )  # fmt: skip

    def _positive(self):
        e = self._real(1)
        return self.pick(
            self.number(0.1, 5.0), f"np.exp({e})", f"(0.1 + abs({e}))", f"(({e}) ** 2 + 0.05)",
            f"np.log1p(np.exp({e}))", f"np.exp(np.tanh({e}))", f"(1 + np.sin({e}))",
        )  # fmt: skip

    def _unit(self):
        e = self._real(1)
        names = [n for n, (kind, s) in self.parameters.items() if kind == UNIT and not s]
        return self.pick(
            f"(1 / (1 + np.exp(-({e}))))", self.number(0.05, 0.95), *names,
            f"(0.5 + 0.5 * np.tanh({e}))",
        )  # fmt: skip


# What people get wrong; each takes the text and gives it back with one fault.
FAULTS = {
    "a name that is nowhere": lambda s, r: _change(s, "x0", "x9", r),
    "a branch on a state": lambda s, r: _before_return(s, "if x0 > 0:\n        x0 = -x0", r),
    "math instead of numpy": lambda s, r: _change(s, "np.exp(", "__import__('math').exp(", r),
    "no return": lambda s, r: _change(s, "return ", "out = ", r),
    "a list instead of a mapping": lambda s, r: _change(s, "return {", "return [{", r, "}", "}]"),
    "a number instead of a law": lambda s, r: _change(s, "ssm.Normal(", "float(1.0) + (", r),
    "an argument that a law has not": lambda s, r: _change(s, "sd=", "sigma=", r),
    "a negative spread": lambda s, r: _change(s, "sd=", "sd=-", r),
    "a law that is not there": lambda s, r: _change(s, "ssm.Normal", "ssm.Gaussian", r),
    "a law in place of a number": lambda s, r: _change(s, "np.sin(", "ssm.Poisson(", r),
    "a component that is not there": lambda s, r: _change(s, "x0", "x0[7]", r),
    "int()": lambda s, r: _change(s, "* x0", "* int(x0)", r),
    "float()": lambda s, r: _change(s, "* x0", "* float(x0)", r),
    "a loop over random numbers": lambda s, r: _before_return(s, "np.random.normal(x0)", r),
    "a loop over a state": lambda s, r: _before_return(s, "for _ in range(x0): pass", r),
    "zero division": lambda s, r: _before_return(s, "1 / 0", r),
    "an assertion": lambda s, r: _before_return(s, "assert x0 > 0", r),
    "a syntax that ends early": lambda s, r: s[: len(s) - int(r.integers(1, 30))],
    "a state without a transition": lambda s, r: _change(s, "'x0': ", "'z0': ", r),
    "a string": lambda s, r: _change(s, "x0", "'x0'", r),
    "None": lambda s, r: _change(s, "* x0", "* None", r),
    "an eigenvalue": lambda s, r: _change(s, "* x0", "* np.linalg.eigvals(np.eye(2) * x0)", r),
    "an array with a hole": lambda s, r: _change(s, "* x0", "* np.array([x0, None])", r),
    "a nan": lambda s, r: _change(s, "* x0", "* np.nan", r),
    "an infinity": lambda s, r: _change(s, "sd=", "sd=np.inf * ", r),
    "two roles at once": lambda s, r: s.replace("@model.initial", "@model.transition", 1),
    "no initial law": lambda s, r: s.replace("@model.initial", "", 1),
    "no observation": lambda s, r: s.replace("@model.observation", "", 1),
    "default values": lambda s, r: _change(s, "(x0", "(x0=1", r),
    "star arguments": lambda s, r: _change(s, "):\n", ", *rest):\n", r),
    "a generator": lambda s, r: _change(s, "return ", "yield ", r),
    "recursion": lambda s, r: _before_return(s, "transition(x0)", r),
    "raise": lambda s, r: _before_return(s, "raise KeyError('x')", r),
    "assignment to a state": lambda s, r: _before_return(s, "x0[0] = 1.0", r),
    "comparison chain": lambda s, r: _before_return(s, "b = 0 < x0 < 1", r),
    "a function given away": lambda s, r: _change(s, "np.exp(", "np.exp * (", r),
    "a huge power": lambda s, r: _change(s, "* x0", "* x0 ** 400", r),
    "a set": lambda s, r: _change(s, "return {", "return {1, ", r),
    "a wrong name of a role": lambda s, r: _change(s, "@model.", "@model.the_", r),
    "matrix product of scalars": lambda s, r: _change(s, "* x0", "@ x0", r),
    "nested laws": lambda s, r: _change(s, "ssm.Normal(", "ssm.Normal(ssm.Normal(0, sd=1), ", r),
}  # fmt: skip


def _change(text, old, new, rng, end="", new_end=""):
    """One of the places where `old` stands, changed; the whole text where there is none."""
    places = [i for i in range(len(text)) if text.startswith(old, i)]
    if not places:
        return text
    i = places[rng.integers(len(places))]
    rest = text[i + len(old) :]
    if end:
        rest = rest.replace(end + "\n", new_end + "\n", 1)
    return text[:i] + new + rest


def _before_return(text, line, rng):
    return _change(text, "    return {", f"    {line}\n    return {{", rng)


def random_model(rng: np.random.Generator, broken: float = 0.3) -> Recipe:
    """A model; broken by one of `FAULTS` with this probability."""
    recipe = Writer(rng).recipe()
    if rng.random() < broken:
        recipe.fault = str(rng.choice(list(FAULTS)))
        recipe.text = FAULTS[recipe.fault](recipe.text, rng)
        recipe.linear = False
    return recipe
