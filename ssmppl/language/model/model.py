"""Model: what a user declares, held and not yet looked at.

The decorators only remember the functions; `tracing.py` runs them on symbols when a verb first
needs the model, and raises there what is wrong with them.
"""

from __future__ import annotations

import difflib
import inspect
import linecache
import textwrap
import warnings
from collections.abc import Callable, Iterable, Mapping
from typing import Any, TypeVar, overload

import numpy as np

from ssmppl import markup
from ssmppl.arguments import checked_model
from ssmppl.errors import Location, ModelError, UnknownName
from ssmppl.expressions.expr import user_location
from ssmppl.language.model.closure_digest import digest_of_code, fingerprint, plain_function
from ssmppl.language.model.component_names import ComponentNames
from ssmppl.language.model.executions import Execution, this_execution
from ssmppl.language.model.pickling import reduced
from ssmppl.language.written import Written, written

Law = TypeVar("Law", bound=Callable[..., Mapping[str, Any]])
Length = int | tuple[int, ...] | None  # of an input
TIME_UNITS = {"s": 1.0, "min": 60.0, "h": 3600.0, "D": 86400.0}  # in seconds
_MISSING: Any = None  # so that `@model.prior()` reaches our message, not Python's
ROLES = ("prior", "initial", "transition", "observation", "proposal")
NEEDED = ("initial", "transition", "observation")
VERBS = ("compile", "diagnose", "evidence", "explain", "forecast", "forward_filter",
         "kalman_filter", "leave_future_out", "log_likelihood", "maximize", "particle_filter",
         "plot_likelihood", "predict", "sample", "score", "simulate", "smooth")  # fmt: skip
_OTHER_NAMES = {  # decorators of other libraries
    **dict.fromkeys(("emission", "emissions", "measurement", "likelihood", "obs"), "observation"),
    **dict.fromkeys(("dynamics", "process", "motion", "state"), "transition"),
    **dict.fromkeys(("init", "start", "initial_state"), "initial"),
    **dict.fromkeys(("parameters", "params", "priors"), "prior"),
    "importance": "proposal",
}
# Draws a model as SVG; the package sets it, as pictures stand above the language.
draw: Callable[[Any], str] | None = None


@checked_model
class Model:
    """A state space model, declared by decorated functions.

    The decorators `prior`, `initial`, `transition` and `observation` each take a function that
    returns ``{name: distribution}`` and whose arguments name what it depends on: parameters,
    states (their value at t), inputs, and ``t``. All but `initial` may be used several times.

    Parameters
    ----------
    name : shown in results and messages.
    inputs : names of the measured inputs u_t; a mapping name -> length where some are vectors, with
        None for a number; a tuple of lengths for a matrix, as a covariance that is known by row.
    time_step : name of an input besides that is the time from a row to the next, taken from the
        times of the data's rows (their index, or a column `time`), which may be uneven; a column of
        that name in the data goes before.
    time_unit : of the time step where the times are dates: "s", "min", "h" or "D". Numbers are
        taken as they are.
    experiment : name of the column that tells several experiments of a long table apart, each with
        an initial state of its own; results call them by its values.
    coords : the labels of the components of vectors and matrices along a dim of `dims`
        (``{"season": ["winter", ...]}``).
    dims : names of their axes, by quantity (``{"effect": ["season"]}``), which results have in
        place of `effect_dim_0`.

    Examples
    --------
    >>> import ssmppl as ssm
    >>> walk = ssm.Model("random walk")
    >>> @walk.prior
    ... def prior():
    ...     return {"q": ssm.InverseGamma(2, scale=1)}
    >>> @walk.initial
    ... def initial():
    ...     return {"x": ssm.Normal(0, sd=10)}
    >>> @walk.transition
    ... def transition(x, q):
    ...     return {"x": ssm.Normal(x, variance=q)}
    >>> @walk.observation
    ... def observation(x):
    ...     return {"y": ssm.Normal(x, sd=1)}
    """

    def __init__(
        self, name: str = "model", *, inputs: Iterable[str] | Mapping[str, Length] = (),
        time_step: str | None = None, time_unit: str = "s",
        experiment: str | None = None,
        coords: Mapping[str, Iterable[Any]] | None = None,
        dims: Mapping[str, str | Iterable[str]] | None = None,
    ):  # fmt: skip
        self.location = user_location()
        if not isinstance(name, str):
            raise ModelError(
                f"the name of a model is {name!r}",
                fix='give a string, ssm.Model("ice varves")',
                where=self.location,
            )
        if isinstance(inputs, str):
            raise ModelError(
                f"inputs is the string {inputs!r}",
                fix=f"give a tuple of names, inputs=({inputs!r},)",
                where=self.location,
            )
        if not isinstance(inputs, Iterable):
            raise ModelError(
                f"inputs is {inputs!r}",
                fix='give a tuple of names, inputs=("torque",), or their lengths by name',
                where=self.location,
            )
        pairs = list(inputs.items() if isinstance(inputs, Mapping) else ((n, None) for n in inputs))
        for key, length in pairs:
            sizes = () if length is None else length if isinstance(length, tuple) else (length,)
            whole = all(isinstance(n, (int, np.integer)) and n > 0 for n in sizes)
            if not (isinstance(key, str) and key.isidentifier()) or not whole:
                raise ModelError(
                    f"input {key!r} of length {length!r}",
                    fix="input names are Python identifiers; the length of a vector input is a "
                    "positive whole number, that of a matrix a tuple of two, None stands for a "
                    "number",
                    where=self.location,
                )
        self.time_step = self._checked_time_step(time_step, time_unit)
        if time_step is not None and time_step not in dict(pairs):
            pairs.append((time_step, None))
        if len(dict(pairs)) < len(pairs):
            names = [key for key, _ in pairs]
            raise ModelError(
                f"inputs holds a name twice: {', '.join(map(repr, names))}",
                fix="name each input once",
                where=self.location,
            )
        if not (experiment is None or (isinstance(experiment, str) and experiment)):
            raise ModelError(
                f"experiment={experiment!r}",
                fix='give the name of the column that tells experiments apart, experiment="id"',
                where=self.location,
            )
        self.experiment = experiment
        self.component_names = ComponentNames.of(dims, coords, self.location)
        self.name = name
        self.inputs: dict[str, tuple[int, ...]] = {
            key: () if length is None else tuple(map(int, np.atleast_1d(length)))
            for key, length in pairs
        }
        self.functions: dict[str, list[Callable[..., Any]]] = {role: [] for role in ROLES}
        self.per_experiment: set[Callable[..., Any]] = set()  # priors of each experiment's own
        self._executions: dict[Callable[..., Any], Execution] = {}  # in which each was declared
        self._outdated: dict[tuple[str, str], Callable[..., Any]] = {}  # by role and name
        self._shown: tuple[Any, str] | None = None  # the picture, and of what
        self.components: dict[str, Any] = {}  # of ssm.structural, by name

    def _checked_time_step(self, name: str | None, unit: str) -> tuple[str, str] | None:
        if name is not None and not (isinstance(name, str) and name.isidentifier()):
            raise ModelError(
                f"time_step={name!r}",
                fix='give the name that distributions call it by, time_step="dt"',
                where=self.location,
            )
        if unit not in TIME_UNITS:
            raise ModelError(
                f"time_unit={unit!r}",
                fix=f"use one of: {', '.join(map(repr, TIME_UNITS))}",
                where=self.location,
            )
        return None if name is None else (name, unit)

    @overload
    def prior(self, function: Law = ...) -> Law: ...
    @overload
    def prior(self, *, per: str) -> Callable[[Law], Law]: ...
    def prior(self, function: Any = _MISSING, *, per: str | None = None) -> Any:
        """Declare priors of parameters.

        Parameters
        ----------
        function : returns their distributions by name; its arguments are parameters declared
            earlier.
        per : "experiment", ``@model.prior(per="experiment")``: each experiment has values of its
            own, independent given the parameters that the prior names (random effects, a partially
            pooled panel; Gelman and Hill 2007, chapter 12). In all other functions the name is
            the value of the experiment at hand; in results it has the dim `experiment`.

        Returns
        -------
        function : itself, so that the name stays what it was.
        """
        if per is None:
            return self._declare("prior", function)
        if per != "experiment":
            raise ModelError(
                f"per={per!r}",
                fix='write @model.prior(per="experiment") for parameters that each experiment has '
                "for itself",
                where=user_location(),
            )

        def declare(function: Law = _MISSING) -> Law:
            if inspect.isfunction(function) or inspect.ismethod(function):
                self.per_experiment.add(function)
            return self._declare("prior", function)

        return declare if function is _MISSING else declare(function)

    def initial(self, function: Law = _MISSING) -> Law:
        """Declare the distribution of x_1, the state at the first row of the data.

        Parameters
        ----------
        function : returns the distributions of states by name, all of them or some; its arguments
            are parameters, inputs and ``t``.

        Returns
        -------
        function : itself, so that the name stays what it was.
        """
        return self._declare("initial", function)

    def transition(self, function: Law = _MISSING) -> Law:
        """Declare the distribution of x_{t+1} given x_t (and u_t, t, y_t where the arguments name
        them).

        Parameters
        ----------
        function : returns the distributions of states by name; its arguments are parameters,
            states, inputs, observation channels and ``t``, and ``NAME_next``, the new value that a
            transition function declared earlier has given to the state NAME. What has no initial
            distribution is a draw of the step, which later transition functions read so, and
            nothing else.

        Returns
        -------
        function : itself, so that the name stays what it was.
        """
        return self._declare("transition", function)

    def observation(self, function: Law = _MISSING) -> Law:
        """Declare the distribution of y_t given x_t (and u_t, t).

        Parameters
        ----------
        function : returns the distributions of channels by name; its arguments are parameters,
            states, inputs and ``t``.

        Returns
        -------
        function : itself, so that the name stays what it was.
        """
        return self._declare("observation", function)

    def proposal(self, function: Law = _MISSING) -> Law:
        """Override the derived proposal of x_{t+1}, from which particles are drawn.

        Parameters
        ----------
        function : returns the distributions of all states by name; its arguments are those of a
            transition, but observation channels mean y_{t+1} here.

        Returns
        -------
        function : itself, so that the name stays what it was.
        """
        return self._declare("proposal", function)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):  # what Python and notebooks ask every object for
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        near = difflib.get_close_matches(name.lower(), [*ROLES, *VERBS, *_OTHER_NAMES], 1)
        meant = _OTHER_NAMES.get(near[0], near[0]) if near else ""
        if meant in VERBS:
            fix = f"the verbs are functions: write ssm.{meant}(model, ...)"
        elif meant:
            fix = f"write @model.{meant}"
        else:
            fix = (
                f"its decorators are {', '.join(ROLES)}; the verbs are functions, ssm.sample(model)"
            )
        raise UnknownName(f"a model has no {name!r}", fix=fix, where=user_location())

    def __getstate__(self) -> dict[str, Any]:  # no other process runs this one's cells again
        functions = {r: [written(f) or f for f in fs] for r, fs in self.functions.items()}
        fresh: dict[str, Any] = {"_executions": {}, "_outdated": {}, "_shown": None}
        return self.__dict__ | {"functions": functions} | fresh

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self.functions = {
            r: [f.function() if isinstance(f, Written) else f for f in fs]
            for r, fs in self.functions.items()
        }

    def __reduce_ex__(self, protocol: Any) -> Any:
        own = (f for fs in self.functions.values() for f in fs if not written(f))
        return reduced(self, self.__getstate__(), own)

    def __copy__(self) -> Model:
        """A model of its own, with the same functions: what is declared of it is its own."""
        made = type(self).__new__(type(self))
        made.__dict__.update(self.__getstate__())
        made.functions = {role: list(of_role) for role, of_role in self.functions.items()}
        made.per_experiment, made.components = set(self.per_experiment), dict(self.components)
        return made

    def __deepcopy__(self, memo: dict[int, Any]) -> Model:
        return self.__copy__()

    def _declare(self, role: str, function: Law) -> Law:
        if not (inspect.isfunction(function) or inspect.ismethod(function)):
            found = (
                f"@{role} of model {self.name!r} decorates {function!r}, which is not a function"
            )
            if function is _MISSING:
                found = f"@{role} of model {self.name!r} is called without a function"
            raise ModelError(
                found,
                fix=f"write @model.{role} (without parentheses) on the line above a def",
                where=user_location(),
            )
        now = self.begin()
        if role == "proposal" and self.functions[role]:
            first = self.functions[role][0]
            if not self._forgets(role, first, function, now):
                raise ModelError(
                    f"a second @{role} function; the first is at {location_of(first)}",
                    fix=f"return all states from one @{role} function; in a notebook, run the cell "
                    "of ssm.Model(...) again before its functions",
                    where=location_of(function),
                )
        self.functions[role].append(function)
        self._executions[function] = now
        self._note_change(role, function)
        return function

    def begin(self) -> Execution:
        """Forget what an earlier run of the cell or module that declares something has declared.

        Called by what writes into a model, as `ssm.structural`; the decorators do it themselves.

        Returns
        -------
        Execution : the run that goes on now.
        """
        now = this_execution()
        self._forget(lambda role, old, then: now.outdates(then))
        return now

    def _forgets(
        self, role: str, old: Callable[..., Any], new: Callable[..., Any],
        now: Execution | None = None,
    ) -> bool:  # fmt: skip
        """Drop a function that gives what another one gives, where that is the same function,
        declared again: whether it was."""
        now = now or self._executions.get(new)
        then = self._executions.get(old)
        if now is None or then is None or not now.redefines(new, old, then):
            return False
        self._forget(lambda r, f, _: r == role and f is old)
        self._note_change(role, new)
        return True

    def _forget(self, outdated: Callable[[str, Callable[..., Any], Execution], bool]) -> None:
        """Drop the functions for which this holds, of their role, themselves and their run."""
        for role, functions in self.functions.items():
            for old in list(functions):
                if old in self._executions and outdated(role, old, self._executions[old]):
                    functions.remove(old)
                    self.per_experiment.discard(old)
                    del self._executions[old]
                    self._outdated[role, old.__qualname__] = old

    def _note_change(self, role: str, function: Callable[..., Any]) -> None:
        """Say that a function which is declared again is another one now."""
        old = self._outdated.pop((role, function.__qualname__), None)
        if old is not None and fingerprint(old) != fingerprint(function):
            where = location_of(function)
            warnings.warn_explicit(
                f"@{role} {function.__name__} of model {self.name!r} has changed, and takes the "
                "place of the one that was declared here before",
                UserWarning,
                where.file,
                where.line,
            )

    @property
    def signature(self) -> tuple:
        """What traces of this model are cached by: changes when a function is declared, and when a
        variable that one reads from outside gets another value."""
        functions = [f for role in ROLES for f in self.functions[role]]
        outer = digest_of_code(functions)
        each = tuple(f in self.per_experiment for f in self.functions["prior"])
        own = (self.name, tuple(self.inputs.items()), self.experiment, self.component_names, each)
        return (*own, *map(tuple, self.functions.values()), outer)

    def __repr__(self) -> str:
        declared = ", ".join(
            f.__name__ for role in ROLES for f in self.functions[role]
        )  # no tracing in a repr
        inputs = f", inputs={tuple(self.inputs)}" if self.inputs else ""
        return f"<Model {self.name!r}{inputs}: {declared or 'nothing declared'}>"

    def _repr_html_(self) -> str:
        """A picture of the model, what was declared, where, on what each distribution depends, and
        the functions as they stand."""
        rows, texts = [], []
        for role in ROLES:
            for function in self.functions[role]:
                where = location_of(function)
                names = ", ".join(inspect.signature(function).parameters)
                needs = markup.code(names) if names else markup.text("nothing")
                rows.append((markup.text(role), needs, markup.text(where.place)))
                texts.append(_source(function))
        lengths = [n + (f" ({' x '.join(map(str, s))} numbers)" if s else "")
                   for n, s in self.inputs.items()]  # fmt: skip
        if lengths:
            rows.insert(0, (markup.text("inputs"), markup.code(", ".join(lengths)), ""))
        if not rows:
            return markup.heading(self.name) + markup.paragraph("Nothing is declared yet.")
        head = ("function", "depends on", "declared at")
        found = markup.heading(self.name) + self._picture()
        found += markup.table(rows, head, left=(0, 1, 2))
        source = "\n\n".join(t for t in texts if t)
        style = "text-align:left"
        if source:
            inside = f"<pre style='{style}'>{markup.text(source)}</pre>"
            found += markup.folded("the functions", inside)
        return found

    def _picture(self) -> str:
        """As SVG; empty where there is none, as of a model that is not complete or has a fault:
        showing a model never fails."""
        if draw is None or not all(self.functions[r] for r in NEEDED):
            return ""
        key = self.signature
        if self._shown is None or self._shown[0] != key:
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    self._shown = key, draw(self)
            except Exception:  # of the user's functions as well
                self._shown = key, ""
        return self._shown[1]


def _source(function: Callable[..., Any]) -> str:
    """The text of a function; empty where that is not at hand."""
    try:
        return textwrap.dedent(inspect.getsource(plain_function(function))).strip()
    except (OSError, TypeError):
        return ""


def location_of(function: Callable[..., Any]) -> Location:
    """Where a function is defined: the line of its `def`, below its decorators."""
    code = plain_function(function).__code__
    line = code.co_firstlineno
    linecache.checkcache(code.co_filename)  # it may have been edited and run again
    for candidate in range(line, line + 20):
        text = linecache.getline(code.co_filename, candidate).lstrip()
        if text.startswith(("def ", "async def ")) or "lambda" in text:
            line = candidate
            break
    return Location(code.co_filename, line, function.__name__)
