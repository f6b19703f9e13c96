"""What a component of a structural model is, and how its functions are written into a model."""

from __future__ import annotations

import keyword
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ssmppl.compiling import parse
from ssmppl.errors import ArgumentError, listing
from ssmppl.expressions.expr import user_location
from ssmppl.language.checks.rules import a
from ssmppl.language.distributions import Distribution, Flat, Normal
from ssmppl.language.model.model import Model
from ssmppl.language.written import functions_of

WIDTH = 88  # of a line that is written
DIFFUSE = "ssm.Flat()"


@dataclass(frozen=True)
class Component:
    """A part of a structural model: what the functions in this module return.

    Parameters
    ----------
    name : by which the model, `observe` and `plot_components` know it.
    kind : "level", "trend", "seasonal", "cycle", "regression", "intervention", "autoregression";
        of a sum that is observed, "observation".
    states, parameters, inputs : their names.
    value : what it adds to the mean of an observation, as Python in these names (and `t`).
    text : its functions, as they stand in the model.
    diffuse : whether a state of it has a flat start.
    reads_time : whether `value` reads `t`.
    link : of an observation, the scale of its mean on which `value` is: "identity", "log", "logit".
    """

    name: str
    kind: str
    states: tuple[str, ...]
    parameters: tuple[str, ...]
    inputs: tuple[str, ...]
    value: str
    text: str
    diffuse: bool = False
    reads_time: bool = False
    link: str = ""

    @property
    def arguments(self) -> tuple[str, ...]:
        """The names that `value` reads."""
        named = [*self.states, *self.parameters, *self.inputs, *(("t",) if self.reads_time else ())]
        return tuple(n for n in named if _reads(self.value, n))

    def __repr__(self) -> str:
        states = f", states {', '.join(self.states)}" if self.states else ""
        parameters = f", parameters {', '.join(self.parameters)}" if self.parameters else ""
        return f"<{self.kind} {self.name!r}: {self.value}{states}{parameters}>"


def _reads(text: str, name: str) -> bool:
    return name in compile(parse(text, "eval"), "", "eval").co_names


@dataclass(frozen=True)
class Quantity:
    """A number of a component as its functions say it: text, and the prior where it is a parameter
    of its own.

    text : a literal, or the name of the parameter. reads : the name, "" of a number.
    """

    text: str
    reads: str = ""
    prior: str = ""

    @property
    def zero(self) -> bool:
        """Whether it is the number 0."""
        return not self.reads and float(self.text) == 0.0


class Writer:
    """Collects what a component gives, and writes it into a model.

    name : the component's, of which those of its quantities are made where they are not given.
    """

    def __init__(self, model: Any, kind: str, name: Any):
        if not isinstance(model, Model):
            raise ArgumentError(
                f"the first argument is {type(model).__name__}, not a model",
                fix=f'make one, m = ssm.Model("airline"), and write ssm.structural.{kind}(m, ...)',
                where=user_location(),
            )
        if not isinstance(name, str) or not name.isidentifier() or keyword.iskeyword(name):
            raise ArgumentError(
                f"name={name!r}",
                fix="give a name that a Python variable can have, of letters, digits and "
                "underscores",
                where=user_location(),
            )
        self.model, self.kind, self.name = model, kind, name
        self.priors: dict[str, str] = {}
        self.states: dict[str, tuple[str, str]] = {}  # (initial law, transition law)
        self.setup: dict[str, tuple[str, ...]] = {}  # statements before the laws of a role
        self.diffuse = False
        model.begin()
        known = present(model)
        if name in known and kind == "observe":
            raise ArgumentError(
                f"the model has an observation of {name!r} already",
                fix="give it all that is summed at once, or another channel a name of its own; in "
                "a notebook, run the cell of ssm.Model(...) again before its components",
                where=user_location(),
            )
        if name in known:
            raise ArgumentError(
                f"the model has a component named {name!r} already, {a(known[name].kind)}",
                fix=f'give this one a name of its own, ssm.structural.{kind}(m, ..., name="'
                f'{name}_2"); in a notebook, run the cell of ssm.Model(...) again before its '
                "components",
                where=user_location(),
            )

    # -- what it is made of
    def quantity(self, name: str, argument: str, given: Any, default: str = "") -> Quantity:
        """A number, a parameter of the user's by its name, or one with a prior of its own."""
        if given is None and default:
            self.priors[name] = default
            return Quantity(name, name, default)
        if isinstance(given, str):
            if not given.isidentifier():
                raise self.wrong(argument, given, "give the name of a parameter of the model")
            return Quantity(given, given)
        if isinstance(given, Distribution):
            text = spelled(given, argument, self.kind)
            self.priors[name] = text
            return Quantity(name, name, text)
        value = np.asarray(given) if given is not None else np.asarray("")
        if value.dtype.kind not in "iuf" or value.shape != () or not np.isfinite(value):
            raise self.wrong(
                argument, given,
                "give a number, a distribution as its prior, or the name of a parameter that a "
                "@prior of yours declares",
            )  # fmt: skip
        return Quantity(number(float(value)))

    def sd(self, name: str, argument: str, given: Any) -> Quantity:
        """A standard deviation: by default a parameter with a flat prior."""
        if isinstance(given, Distribution):
            lower = given.support().lower.ravel()
            if given.shape or any(e.op != "const" or e.data < 0.0 for e in lower):
                raise self.wrong(
                    argument, given, "give the distribution of a positive number, such as "
                    "ssm.HalfNormal(sd=...)",
                )  # fmt: skip
        found = self.quantity(name, argument, given, "ssm.HalfFlat()")
        if not found.reads and float(found.text) < 0.0:
            raise self.wrong(argument, given, "a standard deviation is not negative")
        return found

    def state(self, name: str, initial: str, transition: str) -> None:
        """A state by what its laws are."""
        self.states[name] = (initial, transition)
        self.diffuse |= initial.startswith("ssm.Flat(")

    def start(self, argument: str, given: Any, size: int | None = None) -> str:
        """The initial law of a state, of a vector where it has a size: flat where none is given."""
        shape = "" if size is None else f"np.full({size}, {{}})"
        if given is None or type(given) is Flat:
            return DIFFUSE if size is None else f"ssm.Flat(shape={size})"
        if isinstance(given, Distribution):
            if size is None:
                return spelled(given, argument, self.kind)
            if isinstance(given, Normal) and given.shape == ():
                numbers = {n: constant_of(p) for n, p in given.parameters.items()}
                texts = {n: number(float(v)) for n, v in numbers.items() if v is not None}
                if len(texts) == len(numbers):
                    mean = shape.format(texts.pop("mean_"))
                    return f"ssm.Normal({mean}, {', '.join(f'{n}={v}' for n, v in texts.items())})"
            raise self.wrong(
                argument, given, "give one Normal distribution, ssm.Normal(0, sd=1), which each "
                "of its states has",
            )  # fmt: skip
        value = np.asarray(given)
        if value.dtype.kind in "iuf" and value.shape == () and np.isfinite(value):
            text = number(float(value))
            return f"ssm.Dirac({text if size is None else shape.format(text)})"
        raise self.wrong(
            argument, given, "give a distribution, ssm.Normal(mean, sd=...), a number where it is "
            "known, or leave it out: it is diffuse then",
        )  # fmt: skip

    def wrong(self, argument: str, given: Any, fix: str) -> ArgumentError:
        """The error of an argument."""
        text = repr(given)
        text = text if len(text) <= 60 else text[:56] + " ..."
        return ArgumentError(
            f"ssm.structural.{self.kind}: {argument}={text}", fix=fix, where=user_location()
        )

    # -- into the model
    def add(
        self, value: str, inputs: Sequence[str] = (), parameters: Iterable[str] = (),
        reads_time: bool = False,
    ) -> Component:  # fmt: skip
        """Write the functions into the model. parameters : further ones, which the model has."""
        names = [*self.states, *self.priors]
        for name in names:
            for other in present(self.model).values():
                if name in (*other.states, *other.parameters):
                    raise ArgumentError(
                        f"the component {self.name!r} gives {name!r}, as {other.name!r} does",
                        fix="give one of them another name, name=...",
                        where=user_location(),
                    )
        known = dict.fromkeys((*self.priors, *parameters))
        rests = {
            "prior": self.priors,
            "initial": {n: first for n, (first, _) in self.states.items()},
            "transition": {n: step for n, (_, step) in self.states.items()},
        }
        offered = {
            "prior": [], "initial": [*known, *inputs, "t"],
            "transition": [*self.states, *known, *inputs, "t"],
        }  # fmt: skip
        texts = [
            function_text(
                role, f"{self.name}_{role}", laws, offered[role], self.setup.get(role, ())
            )
            for role, laws in rests.items()
            if laws
        ]
        text = "\n\n\n".join(texts) + "\n"
        made = Component(
            self.name, self.kind, tuple(self.states), tuple(known), tuple(inputs), value, text,
            self.diffuse, reads_time,
        )  # fmt: skip
        write(self.model, text, f"{self.kind} {self.name!r} of {self.model.name}")
        self.model.components[self.name] = made
        return made


def write(model: Model, text: str, title: str) -> None:
    """Declare the functions of a text."""
    for role, function in functions_of(text, title):
        getattr(model, role)(function)


def present(model: Model) -> dict[str, Component]:
    """The components of a model by name, without those of an earlier run of a cell."""
    names = {f.__name__ for fs in model.functions.values() for f in fs}
    for name, made in list(model.components.items()):
        if made.text.strip() and not names & set(_function_names(made.text)):
            del model.components[name]
    return dict(model.components)


def components_of(model: Model) -> dict[str, Component]:
    """Those of them that can be summed up."""
    return {n: c for n, c in present(model).items() if c.kind != "observation"}


def observations_of(model: Model) -> dict[str, Component]:
    """The sums of components that are observed, by channel."""
    return {n: c for n, c in present(model).items() if c.kind == "observation"}


def _function_names(text: str) -> list[str]:
    return [line[4:].split("(")[0] for line in text.splitlines() if line.startswith("def ")]


# -- text
def number(value: float) -> str:
    """A number as Python has it; whole ones without a point."""
    return str(int(value)) if value.is_integer() and abs(value) < 1e15 else repr(value)


def noise(mean: str, sd: Quantity) -> str:
    """The law of a state with this mean: Normal, or Dirac where its standard deviation is 0."""
    return f"ssm.Dirac({mean})" if sd.zero else f"ssm.Normal({mean}, sd={sd.text})"


def function_text(
    role: str, name: str, laws: Mapping[str, str], offered: Sequence[str],
    setup: Sequence[str] = (),
) -> str:  # fmt: skip
    """A decorated function that returns these laws. offered : names it may take as arguments, of
    which it takes those that it reads. setup : statements before."""
    body = "\n".join([*setup, f"({', '.join(laws.values())},)"])
    read = set(compile(parse(body), "", "exec").co_names)
    arguments = list(dict.fromkeys(n for n in offered if n in read))
    lines = [f"@model.{role}", *_head(name, arguments)]
    lines += textwrap.indent("\n".join(setup), "    ").splitlines()
    entries = [f'"{n}": {law}' for n, law in laws.items()]
    one = f"    return {{{', '.join(entries)}}}"
    if len(one) <= WIDTH:
        return "\n".join([*lines, one])
    return "\n".join([*lines, "    return {", *(_entry(e) for e in entries), "    }"])


def _head(name: str, arguments: list[str]) -> list[str]:
    one = f"def {name}({', '.join(arguments)}):"
    if len(one) <= WIDTH:
        return [one]
    return [f"def {name}(", *textwrap.wrap(", ".join(arguments) + ",", WIDTH, initial_indent="    ",
                                           subsequent_indent="    "), "):"]  # fmt: skip


def _entry(text: str) -> str:
    """An entry of a dictionary; a long one has the arguments of its call on lines of their own."""
    if len(text) + 9 <= WIDTH:
        return f"        {text},"
    start = text.index("(") + 1
    arguments, depth, last = [], 0, start
    for k in range(start, len(text) - 1):
        depth += (text[k] in "([{") - (text[k] in ")]}")
        if text[k] == "," and depth == 0:
            arguments.append(text[last:k].strip())
            last = k + 1
    arguments.append(text[last:-1].strip())
    inside = "".join(f"            {a},\n" for a in arguments)
    return f"        {text[:start]}\n{inside}        ),"


def summed(terms: Sequence[str], name: str) -> tuple[str, tuple[str, ...]]:
    """(the sum, the statements before it): long ones get a name first."""
    one = " + ".join(terms)
    if len(one) <= WIDTH - 40:
        return one, ()
    if len(one) + len(name) + 7 <= WIDTH:
        return name, (f"{name} = {one}",)
    rows = "\n    + ".join(terms)
    return name, (f"{name} = (\n    {rows}\n)",)


def constant_of(values: Any) -> np.ndarray | None:
    """The numbers of an array of expressions; None where it holds symbols."""
    flat = values.ravel()
    if any(e.op != "const" for e in flat):
        return None
    return np.array([float(e.data) for e in flat]).reshape(values.shape)


def spelled(law: Distribution, argument: str, kind: str) -> str:
    """A distribution of numbers as it is written.

    Raises
    ------
    ArgumentError : it is made of other distributions, or holds symbols.
    """
    if isinstance(law, Flat):
        return f"ssm.{law!r}"
    values = {n: constant_of(p) for n, p in law.parameters.items()}
    if law.inside() or not values or any(v is None for v in values.values()):
        raise ArgumentError(
            f"ssm.structural.{kind}: {argument}={law!r} is no plain distribution of numbers",
            fix=f'declare it in a @prior of yours and give its name, {argument}="my_parameter"',
            where=user_location(),
        )
    texts = [f"{n.rstrip('_')}={array_text(v)}" for n, v in values.items() if v is not None]
    return f"ssm.{type(law).__name__}({', '.join(texts)})"


def array_text(values: np.ndarray) -> str:
    """Numbers as Python has them: equal ones by np.full."""
    if values.shape == ():
        return number(float(values))
    first = float(values.flat[0])
    if np.all(values == first):
        shape = values.shape[0] if values.ndim == 1 else values.shape
        return f"np.full({shape}, {number(first)})"
    return f"np.array({values.tolist()})"


def check_components(model: Model, components: Sequence[Any], kind: str) -> list[Component]:
    """The components of a model that were given, by themselves or by name.

    Raises
    ------
    ArgumentError : there is none, or one is not of this model.
    """
    known, found = components_of(model), []
    for c in components:
        name = c.name if isinstance(c, Component) else c
        own = known.get(name) if isinstance(name, str) else None
        if own is None or (isinstance(c, Component) and c != own):
            shown = repr(name) if isinstance(name, str) else type(c).__name__
            raise ArgumentError(
                f"ssm.structural.{kind}: {shown} is no component of the model {model.name!r}",
                fix=f"its components are: {listing(str(name), known)}",
                where=user_location(),
            )
        if own in found:
            raise ArgumentError(
                f"ssm.structural.{kind}: the component {name!r} is given twice",
                fix="give each once",
                where=user_location(),
            )
        found.append(own)
    if not found:
        raise ArgumentError(
            f"ssm.structural.{kind} was given no component",
            fix=f"its components are: {listing('', known)}",
            where=user_location(),
        )
    return found
