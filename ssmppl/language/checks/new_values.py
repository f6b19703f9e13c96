"""`NAME_next` among the arguments of a transition: another state's new value, in the same step.

The functions of a model are traced in the order in which they were declared, and each may name what
earlier ones have given: the symbols of a noisy quantity, the expression of a deterministic one. A
quantity without an initial distribution is a draw of the step, which nothing but such arguments
reads.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from ssmppl.errors import Location, ModelError, listing
from ssmppl.expressions.arrays import ExprArray, array
from ssmppl.expressions.expr import Expr, symbols_of
from ssmppl.language.checks.rules import a
from ssmppl.language.distributions import Dirac
from ssmppl.language.model.covariances import noiseless
from ssmppl.language.model.model import location_of
from ssmppl.language.model.trace import Site

SUFFIX = "_next"
Function = Callable[..., Any]


def stem(argument: str) -> str | None:
    """NAME of NAME_next; None of other arguments."""
    name = argument.removesuffix(SUFFIX)
    return name if name and name != argument else None


class NewValues:
    """What the transition functions that were traced so far have given.

    given : by name. read : names that were asked for, each by the first function that did.
    """

    def __init__(self) -> None:
        self.given: dict[str, ExprArray] = {}
        self.read: dict[str, Location] = {}

    def give(self, site: Site) -> None:
        """What later functions get for this quantity."""
        value = site.value
        if isinstance(site.distribution, Dirac):
            value = array(np.broadcast_to(array(site.distribution.mean()), site.shape))
        elif fixed := list(noiseless(site.distribution)):
            mixed = np.array(value.view(np.ndarray))
            mixed[fixed] = list(array(site.distribution.mean())[fixed])
            value = array(mixed)
        self.given[site.name] = value

    def value(self, argument: str, where: Location) -> Expr | ExprArray | None:
        """What a transition function gets for this argument; None where no function gave it."""
        name = stem(argument)
        if name is None or name not in self.given:
            return None
        self.read.setdefault(name, where)
        value = self.given[name]
        return value[()] if value.shape == () else value

    def symbols(self, arguments: Sequence[str]) -> set[Expr]:
        """The symbols in what these arguments stand for."""
        names = [stem(n) for n in arguments]
        return {s for n in names if n in self.given for s in symbols_of(self.given[n].ravel())}

    def draws_of_step(
        self, initial: Mapping[str, Site], transition: Mapping[str, Site]
    ) -> dict[str, Site]:
        """Initial distributions of what has none, by name: at the first row, where it does not
        exist, 0. A deterministic one is but a name for its value, and left out."""
        out = {}
        for name, site in transition.items():
            if name in initial or isinstance(site.distribution, Dirac):
                continue
            law = Dirac(np.zeros(site.shape))
            law.location = site.distribution.location
            out[name] = Site(name, site.role, law, site.value, site.where)
        return out

    def ordered(
        self, initial: Mapping[str, Site], transition: Mapping[str, Site]
    ) -> dict[str, Site]:
        """Transitions in the order of the initial distributions, or where new values are read, in
        that of the functions."""
        names = [n for n in transition if n in initial] if self.read else initial
        return {n: transition[n] for n in names}


def check_draws_of_step(
    initial: Mapping[str, Site], transition: Mapping[str, Site], new: NewValues
) -> None:
    """Refuse a transition of what has no initial distribution, unless its new value is read."""
    for name, site in transition.items():
        if name not in initial and name not in new.read:
            raise ModelError(
                f"@transition gives {name!r}, which has no initial distribution",
                fix=f"return it from @initial too; @initial gives: {listing(name, initial)}; what "
                f"is drawn within a step only needs none, and is read as {name + SUFFIX!r} by a "
                "later @transition function",
                where=site.distribution.location,
            )


class Refusal:
    """Why an argument of a function means nothing, where new values are concerned.

    functions : the transition functions, in order. names_given : those of what one of them returns,
    run on stand-ins for what it asks for. known : roles of quantities by name.
    """

    def __init__(
        self, functions: Sequence[Function], names_given: Callable[[Function], Mapping[str, Any]],
        known: Mapping[str, str], new: NewValues,
    ):  # fmt: skip
        self.functions, self.known, self.new = list(functions), known, new
        self.names_given = names_given

    def of(self, argument: str, role: str, function: Function) -> tuple[str, str] | None:
        """What was found and the fix; None where the argument has nothing to do with it."""
        name = stem(argument)
        if name is None:
            return self._draw_of_step(argument, role)
        giver = next((f for f in self.functions if name in self.names_given(f)), None)
        if giver is None and self.known.get(name) != "state":
            return self._no_new_value(argument, name, role, function)
        if role != "transition":
            return self._elsewhere(argument, name, role)
        if giver is None:
            return None
        asks = f"@transition {function.__name__} asks for {argument!r}, the new value of {name!r}"
        if giver is function:
            return (
                f"{asks} that it gives itself",
                f"give {name!r} in a @transition function of its own, above the one that asks for "
                f"{argument!r}",
            )
        where = location_of(giver)
        if self._waits(giver, function, set()):
            return (
                f"{asks}, which {giver.__name__} gives ({where}), and that waits for what "
                f"{function.__name__} gives: a cycle",
                f"let one of the two depend on the value before, {name!r}, or draw both from one "
                "distribution of a vector, such as ssm.MvNormal",
            )
        return (
            f"{asks}, which {giver.__name__} gives further below ({where})",
            f"write {giver.__name__} above {function.__name__}: a new value is known to the "
            "functions that follow",
        )

    def _waits(self, function: Function, other: Function, met: set[int]) -> bool:
        """Whether a function asks for new values of another, or of one that does."""
        if id(function) in met:
            return False
        met.add(id(function))
        asked = {stem(n) for n in function.__code__.co_varnames[: function.__code__.co_argcount]}
        for giver in self.functions:
            if asked & set(self.names_given(giver)):
                if giver is other or self._waits(giver, other, met):
                    return True
        return False

    def _no_new_value(
        self, argument: str, name: str, role: str, function: Function
    ) -> tuple[str, str] | None:
        if role != "transition":
            return None
        asks = f"@transition {function.__name__} asks for {argument!r}, a new value"
        if name in self.known:
            return (
                f"{asks}, and {name!r} is {a(self.known[name])}: states have new values",
                f"name {name!r} itself",
            )
        have = [n + SUFFIX for n in self.new.given]
        return (
            f"{asks}, and no @transition function gives {name!r}",
            f"new values that earlier functions give: {listing(argument, have)}"
            if have
            else f"return {name!r} from a @transition function above this one",
        )

    def _elsewhere(self, argument: str, name: str, role: str) -> tuple[str, str]:
        found = f"{argument!r} is the new value of {name!r} in a step, which only @transition "
        found += f"functions know, and this is @{role}"
        if role == "observation" and self.known.get(name) == "state":
            return found, f"name {name!r}: an observation reads the states of its own row"
        if role == "observation":
            return found, self._as_state(name)
        if role == "proposal":
            return found, "draw each state of a proposal from the state before"
        return found, "let it depend on parameters only"

    def _draw_of_step(self, name: str, role: str) -> tuple[str, str] | None:
        if role == "initial":  # it gives the states, which are not known before
            return None
        if self.known.get(name, "state") == "state" and name in self.known:
            return None
        if name in self.known and self.known[name] != DRAW:
            return None
        if all(name not in self.names_given(f) for f in self.functions):
            return None
        found = (
            f"{name!r} is drawn within a step and has no initial distribution, so that it has no "
            "value "
        )
        if role == "transition":
            return (
                found + "before",
                f"ask for {name + SUFFIX!r}, its new value, in a function below the one that gives "
                f"it; or {self._as_state(name)}",
            )
        return found + "at the first row", self._as_state(name)

    @staticmethod
    def _as_state(name: str) -> str:
        return (
            f"give {name!r} an initial distribution, its value at the first row, as ssm.Dirac(0), "
            "and it is a state; of a vector as ssm.Dirac(np.zeros(n))"
        )


DRAW = "draw of the step"  # the role of what has no initial law


def names_given(returned: Any) -> Mapping[str, Any]:
    """The distributions that a function returned; none where it did not return any."""
    if not isinstance(returned, Mapping):
        return {}
    return {n: d for n, d in returned.items() if isinstance(n, str)}
