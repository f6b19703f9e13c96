"""Model -> Trace: the user's functions run once on symbols, giving ordered sites."""

from __future__ import annotations

import inspect
import weakref
from collections.abc import Callable, Mapping
from typing import Any

from ssmppl.compiling import LOCK
from ssmppl.errors import Location, ModelError, SSMError, listing
from ssmppl.expressions.arrays import ExprArray, array, elementwise
from ssmppl.expressions.expr import Expr, recording, symbol
from ssmppl.expressions.node import choosing
from ssmppl.language.checks.indexes import check_indexes
from ssmppl.language.checks.new_values import (
    DRAW,
    NewValues,
    Refusal,
    check_draws_of_step,
    names_given,
    stem,
)
from ssmppl.language.checks.rules import (
    RESERVED,
    a,
    check_dims,
    check_law,
    check_name,
    check_read,
    check_returned,
    check_states,
)
from ssmppl.language.distributions.base import Distribution
from ssmppl.language.distributions.multivariate import MvNormal
from ssmppl.language.distributions.vectors.correlations import with_unit_diagonal
from ssmppl.language.model.calling import call, call_once, check_outer_names, return_location
from ssmppl.language.model.covariances import (
    by_noise,
    find_root,
    independent,
    noiseless,
    without_density,
)
from ssmppl.language.model.model import Model, location_of
from ssmppl.language.model.trace import EXPERIMENT_NUMBER, Site, Trace, symbols
from ssmppl.language.user_defined.sde import noises, started


def _time(role: str) -> str:
    """The kind of `t` in this kind of function."""
    return "time_prev" if role in ("transition", "proposal") else "time"


# of a model its signature, and the traces by the labels of the experiments
_Known = tuple[tuple, dict[tuple[Any, ...], Trace]]
_traces: weakref.WeakKeyDictionary[Model, _Known] = weakref.WeakKeyDictionary()


def trace(model: Model, experiments: tuple[Any, ...] = ()) -> Trace:
    """Run the model's functions on symbols.

    Parameters
    ----------
    experiments : labels of those that its parameters `per="experiment"` have values for; () where
        it is a single one.

    Raises
    ------
    ModelError : a rule of the language is broken; names function, file, line and the fix.
    """
    if not isinstance(model, Model):
        raise ModelError(
            f"expected a Model, found {type(model).__name__}",
            fix="pass the object made by ssm.Model(...), not its name or a function of it",
        )
    signature = model.signature
    found = _kept(model, signature, experiments)
    if found is None:
        with LOCK:
            found = _kept(model, signature, experiments)
            if found is None:
                signature, found = _traced(model, experiments)
                known = _traces.get(model)
                if known is None or known[0] != signature:
                    _traces[model] = known = (signature, {})
                known[1][experiments] = found
    return found


def _kept(model: Model, signature: tuple, experiments: tuple[Any, ...]) -> Trace | None:
    known = _traces.get(model)
    return known[1].get(experiments) if known is not None and known[0] == signature else None


def _by_noise(sites: Mapping[str, Site], proposal: Mapping[str, Site]) -> dict[str, Site]:
    """States with components that have noise and such that have none in two sites, unless there is
    a proposal of the whole."""
    parts = [[s] if s.name in proposal else by_noise(s) for s in sites.values()]
    return {site.name: site for own in parts for site in own}


def _no_density(name: str, law: MvNormal, role: str) -> ModelError:
    fix = "give it a variance, or leave the component out; only states may be without noise"
    if role == "proposal":
        fix = "leave @proposal out, and one is derived"
    still = noiseless(law)
    what = f"has a row of zeros, that of component {still[0]}" if still else "is singular"
    which = "such a component" if still else "it"
    return ModelError(
        f"the covariance of {name!r} in @{role} {what}: {which} has no density",
        fix=fix,
        where=law.location,
    )


class _Redefined(Exception):
    """A function turned out to be one of before, declared again: the model has changed."""


def _traced(model: Model, experiments: tuple[Any, ...]) -> tuple[tuple, Trace]:
    """The trace, and the signature that the model had before: tracing may change what it reads."""
    while True:
        signature = model.signature
        try:
            return signature, _Tracer(model, experiments).run()
        except _Redefined:
            continue


class _Tracer:
    def __init__(self, model: Model, experiments: tuple[Any, ...] = ()):
        self.model = model
        self.experiments = experiments
        self.each: dict[str, Location] = {}  # parameters of which each experiment has its own
        self.known: dict[str, tuple[str, tuple[int, ...]]] = {}  # name -> (role, shape)
        self.owner: dict[str, Location] = {}
        self.symmetric: set[str] = set()  # parameters that are symmetric matrices
        self.correlations: set[str] = set()  # and those of unit diagonal
        self.defaults: list[tuple[str, str, Callable[..., Any]]] = []  # taken: argument, role
        self.new = NewValues()

    def run(self) -> Trace:
        model = self.model
        for role, needed in (("initial", "x_1"), ("transition", "x_{t+1}")):
            if not model.functions[role]:
                raise ModelError(
                    f"model {model.name!r} has no @{role} function",
                    fix=f"declare the distribution of {needed} with @model.{role}",
                    where=model.location,
                )
        for name in model.inputs:
            check_name(name, "input", model.location)
            self._claim(name, "input", model.inputs[name], model.location)
        if self.experiments and model.per_experiment:
            self._claim(EXPERIMENT_NUMBER, "input", (), model.location)
        with recording() as locations, choosing() as choices:
            parameters = self._sites("prior", "parameter")
            initial = self._sites("initial", "state")
            observations = self._sites("observation", "observation")
            transition = self._sites("transition", "state")
            proposal = self._sites("proposal", "state")
        check_draws_of_step(initial, transition, self.new)
        draws = self.new.draws_of_step(initial, transition)
        check_states(initial | draws, transition, proposal, draws)
        initial |= draws
        check_dims(self.known, self.owner)
        shapes = {name: shape for name, (_, shape) in self.known.items()}
        names, several = model.component_names, bool(self.experiments and self.each)
        names.check(shapes | {n: shapes[n][several:] for n in self.each}, model.location)
        if several:
            names = names.with_axis(self.each, "experiment", self.experiments, shapes)
        self._check_outer_names()
        self._check_defaults()
        traced = Trace(
            name=model.name,
            parameters=parameters,
            initial=_by_noise(initial, proposal),
            transition=_by_noise(self.new.ordered(initial, transition), proposal),
            observations=observations,
            proposal=proposal,
            inputs=dict(model.inputs) | ({EXPERIMENT_NUMBER: ()} if several else {}),
            time_step=model.time_step,
            experiment=model.experiment,
            component_names=names,
            per_experiment=tuple(self.each),
            experiments=self.experiments if several else (),
            locations=locations,
            functions={r: [location_of(f) for f in fs] for r, fs in model.functions.items()},
            choices=choices,
            auxiliary=frozenset(draws),
        )
        check_indexes(traced)
        return traced

    def _sites(self, function_role: str, role: str) -> dict[str, Site]:
        sites: dict[str, Site] = {}
        givers: dict[str, Callable[..., Any]] = {}
        for function in list(self.model.functions[function_role]):
            where = location_of(function)
            returned = self._call(function, function_role, where)
            line = return_location(function)
            asked = returned
            returned = started(returned, function_role, function.__name__, line, self._before)
            laws = check_returned(returned, function_role, function.__name__, line)
            handed = self.new.symbols(list(inspect.signature(function).parameters))
            for name in noises(returned, asked):
                self.new.read.setdefault(name, line)
                handed |= set(symbols("state", name, laws[name].shape).ravel())
            for name, distribution in laws.items():
                check_name(name, role, line)
                check_law(name, distribution, function_role)
                check_read(name, distribution, function_role, self._kinds(function_role), handed)
                if function_role != "prior":
                    distribution = independent(distribution)
                elif function in self.model.per_experiment:
                    distribution = self._of_each(name, distribution, line)
                bare = without_density(distribution)
                states = function_role in ("initial", "transition")
                if bare is not None and (not states or bare is not distribution):
                    raise _no_density(name, bare, function_role)
                if states:
                    find_root(distribution)
                if name in sites:
                    if self.model._forgets(function_role, givers[name], function):
                        raise _Redefined
                    raise ModelError(
                        f"{name!r} is given by two @{function_role} functions; the other is at "
                        f"{sites[name].where}",
                        fix="give each quantity one distribution; in a notebook, run the cell of "
                        "ssm.Model(...) again before its functions",
                        where=where,
                    )
                fresh = function_role == "transition" and name not in self.known
                if fresh or function_role in ("prior", "initial", "observation"):
                    self._claim(name, DRAW if fresh else role, distribution.shape, line)
                    if distribution.symmetric:
                        self.symmetric.add(name)
                    if distribution.unit_diagonal:
                        self.correlations.add(name)
                value = symbols(role, name, distribution.shape, name in self.symmetric)
                sites[name] = Site(name, role, distribution, value, where)
                givers[name] = function
            if function_role == "transition":
                for name in laws:
                    self.new.give(sites[name])
        return sites

    def _of_each(self, name: str, distribution: Distribution, line: Location) -> Distribution:
        """The prior of a parameter of which each experiment has its own."""
        if distribution.joint:
            raise ModelError(
                f"{name!r} is of each experiment, and its prior {type(distribution).__name__} is a "
                "joint one",
                fix="give its components a distribution each, and make of them what you need where "
                "they are used, mean + cholesky @ z of standard normal ones",
                where=line,
            )
        self.each[name] = line
        return distribution.repeated(len(self.experiments)) if self.experiments else distribution

    def _before(self, name: str) -> Any:
        """The value of a state at the row before; None where there is none of this name."""
        if self.known.get(name, ("", ()))[0] != "state":
            return None
        return self._argument(name, "transition")

    def _claim(self, name: str, role: str, shape: tuple[int, ...], where: Location) -> None:
        if name in self.known:
            raise ModelError(
                f"{name!r} is declared as {a(role)} and already {a(self.known[name][0])}"
                + (f" at {self.owner[name]}" if name in self.owner else ""),
                fix="rename one of them",
                where=where,
            )
        self.known[name] = (role, shape)
        self.owner[name] = where

    # -- calling a law with symbols for its arguments
    def _call(self, function: Callable[..., Any], role: str, where: Location) -> Any:
        arguments = {}
        for name, parameter in inspect.signature(function).parameters.items():
            if parameter.kind in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD):
                raise ModelError(
                    f"@{role} {function.__name__} takes *{name}: arguments are bound by name",
                    fix="name each parameter, state and input that the distribution depends on",
                    where=where,
                )
            if role == "prior" and name in self.each:
                raise ModelError(
                    f"@prior {function.__name__} names {name!r}, of which each experiment has its "
                    f"own ({self.each[name]})",
                    fix="let priors depend on parameters that all experiments share",
                    where=where,
                )
            value = self._argument(name, role)
            if value is None and role == "transition":
                value = self.new.value(name, where)
            if value is None:
                if parameter.default is not parameter.empty:
                    self.defaults.append((name, role, function))
                    continue  # a plain Python constant of the user's
                raise self._unknown(name, role, function)
            arguments[name] = value
        return call(function, role, arguments, self._roles())

    def _roles(self) -> dict[str, str]:
        """The quantities known so far, each with its role in words."""
        return {name: a(role) for name, (role, _) in self.known.items()}

    def _check_outer_names(self) -> None:
        for role, functions in self.model.functions.items():
            for function in functions:
                known = self._roles() | ({} if role == "prior" else {"t": "the row number"})
                if role == "transition":
                    new = {f"{n}_next": f"the new value of {n!r}" for n in self.new.read}
                    known = new | known
                check_outer_names(function, role, known)

    def _check_defaults(self) -> None:
        """Refuse a default that was taken where the name is a quantity, which it would hide."""
        for name, role, function in self.defaults:
            new = role == "transition" and stem(name) in self.new.given
            if name in self.known or name == "t" or new:
                unknown, where = self._unknown(name, role, function), location_of(function)
                raise ModelError(
                    f"@{role} {where.function} takes the default of {name!r}, which hides the "
                    f"model's {name!r}: {unknown.found}",
                    fix=f"rename the argument if its default is meant; else {unknown.fix}",
                    where=where,
                )

    def _allowed(self, role: str) -> dict[str, str]:
        """Role of a known name -> kind of symbol, for arguments of this kind of function."""
        return {
            "prior": {"parameter": "parameter"},
            "initial": {"parameter": "parameter", "input": "input"},
            "transition": {
                "parameter": "parameter",
                "state": "state_prev",
                "input": "input_prev",
                "observation": "observation_prev",
            },
            "observation": {"parameter": "parameter", "state": "state", "input": "input"},
            "proposal": {
                "parameter": "parameter",
                "state": "state_prev",
                "input": "input_prev",
                "observation": "observation",
            },
        }[role]

    def _kinds(self, role: str) -> set[str]:
        return {*self._allowed(role).values(), _time(role)}

    def _argument(self, name: str, role: str) -> Expr | ExprArray | None:
        if name == "t" and role != "prior":
            return symbol(_time(role), "t")
        if name not in self.known or self.known[name][0] not in self._allowed(role):
            return None
        known_as, shape = self.known[name]
        kind = self._allowed(role)[known_as]
        value = symbols(kind, name, shape, name in self.symmetric)
        value = with_unit_diagonal(value) if name in self.correlations else value
        if name in self.each and self.experiments:
            value = self._of_this(value, role)
        return value[()] if value.shape == () else value

    def _of_this(self, values: ExprArray, role: str) -> ExprArray:
        """Of a parameter of each experiment the value of the one at hand.

        A sum has derivatives of one term each, where nested choices have them of all.
        """
        number = symbol(self._allowed(role)["input"], EXPERIMENT_NUMBER)
        own = [
            array(elementwise("where", elementwise("eq", number, float(k)), v, 0.0))
            for k, v in enumerate(values)
        ]
        return array(sum(own[1:], own[0]))

    def _given_by(self, function: Callable[..., Any]) -> Mapping[str, Any]:
        """The distributions that a transition function would return, run on stand-ins for new
        values."""
        arguments = {}
        for name in inspect.signature(function).parameters:
            value = self._argument(name, "transition")
            if value is None:
                base = stem(name) or name
                own = symbols("state", base, self.known.get(base, ("", ()))[1])
                value = own[()] if own.shape == () else own
            arguments[name] = value
        try:
            return names_given(call_once(function, "transition", arguments, self._roles()))
        except SSMError:
            return {}

    def _unknown(self, name: str, role: str, function: Callable[..., Any]) -> ModelError:
        where = location_of(function)
        roles = {n: kind for n, (kind, _) in self.known.items()}
        steps = self.model.functions["transition"]
        about = Refusal(steps, self._given_by, roles, self.new).of(name, role, function)
        if about is not None:
            return ModelError(about[0], fix=about[1], where=where)
        allowed = self._allowed(role)
        names = [n for n, (kind, _) in self.known.items() if kind in allowed]
        names += ["t"] if role != "prior" else []
        if name in self.known:
            kind = self.known[name][0]
            reason = {
                "prior": f"a prior depends on parameters declared earlier only, and {name!r} is "
                f"{a(kind)}",
                "initial": f"the initial distribution cannot depend on {a(kind)}",
                "observation": f"an observation cannot depend on {a(kind)} of the same time",
            }.get(role, f"{name!r} is {a(kind)}")
        elif name == "t":
            reason = "a prior does not depend on time"
        else:
            reason = f"@{role} {where.function} asks for {name!r}, which the model does not know"
        later = " (declare it in an earlier @prior)" if role == "prior" else ""
        if name not in self.known and role != "prior" and name not in RESERVED:
            later = "; a parameter is declared by a @prior, a state by @initial, an input by "
            later += f"ssm.Model(..., inputs=({name!r},))"
        return ModelError(reason, fix=f"use one of: {listing(name, names)}{later}", where=where)
