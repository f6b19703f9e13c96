"""`ssm.simulators.fmu`: functional mock-up units for co-simulation (FMI 2.0, 3.0) as simulators.

The unit is begun anew for each point of a batch: reset, its states, inputs and parameters set, and
one communication step done. The result is then a function of the arguments alone; what the unit
keeps beside the states that are named would be lost, which is looked for when it is loaded.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
import threading
import weakref
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from ssmppl.errors import ModelError
from ssmppl.expressions.expr import user_location
from ssmppl.language.user_defined.simulator import Simulator, simulator
from ssmppl.simulators.chosen_names import Chosen, chosen, identifier, required, unknown
from ssmppl.simulators.engine import Engine

VERSIONS = ("2", "3")
REAL = ("Real", "Float64")
MOVED = 1e-2  # of a state, relative to its start and at least to 1, where the unit is tried
KEPT = 1e-3  # relative difference of two steps with and without a new beginning that is rounding
ERROR = 3  # fmi2Error, fmi3Error: of messages that are kept


class FMUModel(Engine):
    """A unit that moves a batch; `output` gives its outputs.

    Pickled as what it was made of: the file is read again.

    Attributes
    ----------
    description : FMPy's `ModelDescription`. state, inputs, parameters, outputs : names of columns.
    interval : seconds that one call moves. values : name -> the unit's start value of each
        parameter and state; nan where it has none.
    """

    def __init__(
        self, path: str, *, dt: float, state: Any, inputs: Chosen, parameters: Chosen,
        outputs: Chosen, start: Mapping[str, Any], time: str | None, substeps: int,
        tolerance: float | None,
    ):  # fmt: skip
        self._made_of = path, {
            "dt": dt, "state": state, "inputs": inputs, "parameters": parameters,
            "outputs": outputs, "start": dict(start), "time": time, "substeps": substeps,
            "tolerance": tolerance,
        }  # fmt: skip
        self.fmpy, self._where = required("fmpy", "fmu"), user_location()
        self.file = os.path.basename(path)
        self.interval, self.substeps, self._tolerance = dt, substeps, tolerance
        self.description = self._described(path)
        self._check_step()
        self._name_columns(state, inputs, parameters, outputs, time)
        self._fixed = self._settings(start)
        self._messages: list[str] = []
        self._lock = threading.Lock()
        self._instance: Any = None
        self._folder = tempfile.mkdtemp(prefix="ssmppl_fmu_")
        self._close = weakref.finalize(self, shutil.rmtree, self._folder, ignore_errors=True)
        with self._as_model_error("cannot be unpacked"):
            self.fmpy.extract(path, unzipdir=self._folder)
        self._try()

    # -- what is in the file
    @contextlib.contextmanager
    def _as_model_error(self, what: str) -> Iterator[None]:
        try:
            yield
        except ModelError:
            raise
        except Exception as error:  # FMPy raises plain Exception
            told = "; ".join([" ".join(str(error).split()), *getattr(self, "_messages", [])])
            raise ModelError(
                f"{self.file} {what}: {told}",
                fix="see what `fmpy validate FILE` and `fmpy simulate FILE` say of it",
                where=self._where,
            ) from None

    def _wrong(self, found: str, fix: str) -> ModelError:
        return ModelError(f"{self.file}: {found}", fix=fix, where=self._where)

    def _described(self, path: str) -> Any:
        with self._as_model_error("is no functional mock-up unit that can be read"):
            description = self.fmpy.read_model_description(path, validate=False)
        if description.fmiVersion.split(".")[0] not in VERSIONS:
            raise self._wrong(
                f"it is of FMI {description.fmiVersion}", "export it for FMI 2.0 or 3.0"
            )
        if description.coSimulation is None:
            raise self._wrong(
                "it is for model exchange, which comes without a solver",
                "export it for co-simulation; or write its equations with ssm.integrate",
            )
        return description

    def _check_step(self) -> None:
        own = self.description.coSimulation.fixedInternalStepSize
        each = self.interval / self.substeps
        if own and abs(round(each / own) * own - each) > 1e-9 * each:
            raise self._wrong(
                f"its internal steps of {own:g} s do not divide dt / substeps = {each:g} s",
                "give dt as a multiple of them",
            )

    def _name_columns(
        self, state: Any, inputs: Chosen, parameters: Chosen, outputs: Chosen, time: str | None
    ) -> None:
        variables = self.description.modelVariables
        self._variables = {v.name: v for v in variables}
        numbers = {
            v.name: (v.name,) for v in variables if v.type in REAL and not v.dimensions
        }  # fmt: skip
        of = {
            kind: {n: c for n, c in numbers.items() if self._variables[n].causality == kind}
            for kind in ("input", "output")
        }
        continuous = [
            u.variable.derivative.name
            for u in self.description.derivatives
            if u.variable is not None and u.variable.derivative is not None
        ]
        pairs = self._pairs(continuous if state is None else state, numbers)
        self.state = tuple(pairs)
        self._set_state = [self._settable(first) for first, _ in pairs.values()]
        self._get_state = [self._reference(second) for _, second in pairs.values()]
        read = {second for _, second in pairs.values()}
        if lost := [n for n in continuous if n not in read]:
            raise self._wrong(
                f"its continuous states {', '.join(lost)} are not among state=",
                "name all of them; each call begins anew from the states that it is given",
            )
        given = chosen(inputs, of["input"], "inputs", self.file)
        self._input_variables = list(given.values())
        self._set_inputs = [self._reference(n) for n in self._input_variables]
        self._time = time is not None
        self.inputs = (*given, *((time,) if time is not None else ()))
        settable = {n: c for n, c in numbers.items() if self._variables[n].causality != "output"}
        given = chosen(() if parameters is None else parameters, settable, "parameters", self.file)
        self.parameters = tuple(given)
        self._set_parameters = [self._settable(n) for n in given.values()]
        self.values = {n: self._start_of(name) for n, name in given.items()} | {
            n: self._start_of(first) for n, (first, _) in pairs.items()
        }
        sensed = chosen(outputs, of["output"] if outputs is None else numbers, "outputs", self.file)
        self.outputs = tuple(sensed)
        self._get_outputs = [self._reference(n) for n in sensed.values()]

    def _pairs(self, state: Any, numbers: Mapping[str, Any]) -> dict[str, tuple[str, str]]:
        """Name of a state -> the variables that set it and that hold it."""
        if isinstance(state, str):
            state = [state]
        given = state if isinstance(state, Mapping) else {identifier(n): n for n in state}
        if not given:
            raise self._wrong(
                "it lists no continuous states",
                'name variables that can be set and read: state=["q", "v"]; or with a variable '
                'that sets each, state={"q": ("q_start", "q")}',
            )
        out = {}
        for own, names in given.items():
            pair = (names, names) if isinstance(names, str) else tuple(names)
            for name in pair:
                if name not in numbers:
                    raise unknown("state", name, numbers, self.file)
            if len(pair) != 2:
                raise self._wrong(
                    f"state {own!r} is {names!r}",
                    "give a variable, or two: the one that sets it and the one that holds it",
                )
            out[own] = (pair[0], pair[1])
        return out

    def _reference(self, name: str) -> int:
        return int(self._variables[name].valueReference)

    def _settable(self, name: str) -> int:
        variable = self._variables[name]
        initial = variable.initial
        if initial is None and variable.causality in ("parameter", "input"):
            initial = "exact"
        if variable.variability == "constant" or initial not in ("exact", "approx"):
            raise self._wrong(
                f"{name!r} cannot be set (causality {variable.causality}, variability "
                f"{variable.variability}, initial {variable.initial})",
                "name a variable with a start value; for a state also two of them, the parameter "
                'that sets it and the variable that holds it: state={"q": ("q_start", "q")}',
            )
        return self._reference(name)

    def _start_of(self, name: str) -> float:
        start = self._variables[name].start
        try:
            return float(start)
        except (TypeError, ValueError):
            return float("nan")

    def _settings(self, start: Mapping[str, Any]) -> list[tuple[str, int, Any]]:
        """Setter, reference and value of each variable with a fixed value."""
        out = []
        for name, value in start.items():
            if name not in self._variables:
                raise unknown("start", name, self._variables, self.file)
            kind = self._variables[name].type
            kind = {"Enumeration": "Integer"}.get(kind, kind)
            out.append((f"set{kind}", self._reference(name), value))
        return out

    # -- what is called
    def _run(
        self, state: np.ndarray, inputs: np.ndarray, parameters: np.ndarray, sense: bool
    ) -> tuple[np.ndarray, dict[int, str]]:
        out = np.full((len(state), len(self.outputs) if sense else len(self.state)), np.nan)
        why: dict[int, str] = {}
        with self._lock:
            for k in range(len(state)):
                point = state[k].tolist(), inputs[k].tolist(), parameters[k].tolist()
                if not all(np.isfinite(part).all() for part in point):
                    why[k] = "an argument is not finite"
                    continue
                self._messages.clear()
                try:
                    time = self._begin(*point)
                    if not sense:
                        self._move(time)
                    out[k] = self._get(self._get_outputs if sense else self._get_state)
                except Exception as error:  # FMPy raises plain Exception
                    why[k] = "; ".join([" ".join(str(error).split()), *self._messages])
                    self._discard()
        return out, why

    def _begin(
        self, state: Sequence[float], inputs: Sequence[float], parameters: Sequence[float]
    ) -> float:
        """The unit at a point, initialised; its time."""
        fmu = self._ready()
        time = inputs[-1] if self._time else 0.0
        for setter, reference, value in self._fixed:
            getattr(fmu, setter)([reference], [value])
        references = (*self._set_parameters, *self._set_state, *self._set_inputs)
        values = [*parameters, *state, *inputs[: len(self._set_inputs)]]
        if self._second:
            fmu.setupExperiment(tolerance=self._tolerance, startTime=time)
            fmu.setReal(references, values)
            fmu.enterInitializationMode()
        else:
            fmu.setFloat64(references, values)
            fmu.enterInitializationMode(tolerance=self._tolerance, startTime=time)
        fmu.exitInitializationMode()
        return time

    def _move(self, time: float) -> None:
        each = self.interval / self.substeps
        for k in range(self.substeps):
            ended = self._instance.doStep(time + k * each, each)
            if ended is not None and (ended[1] or ended[2]):  # FMI 3.0: terminated, or early
                raise RuntimeError("it ended before the step was done")

    def _get(self, references: Sequence[int]) -> list[float]:
        if not references:
            return []
        fmu = self._instance
        get = fmu.getReal if self._second else fmu.getFloat64
        return list(get(references))

    # -- the instance
    @property
    def _second(self) -> bool:
        return bool(self.description.fmiVersion.startswith("2"))

    def _ready(self) -> Any:
        """The instance, as if new."""
        if self._instance is None:
            simulation = required("fmpy.simulation", "fmu")
            log = self._log_of_2 if self._second else self._log_of_3
            self._instance = simulation.instantiate_fmu(
                self._folder, self.description, fmi_type="CoSimulation", logger=log,
                require_functions=False,
            )  # fmt: skip
        else:
            self._instance.reset()
        return self._instance

    def _discard(self) -> None:
        """After an error an instance may be in any state: the next call makes another."""
        with contextlib.suppress(Exception):
            if self._instance is not None:
                self._instance.freeInstance()
        self._instance = None

    def _log_of_2(self, env: Any, name: Any, status: int, category: Any, message: bytes) -> None:
        self._log(status, message)

    def _log_of_3(self, env: Any, status: int, category: Any, message: bytes) -> None:
        self._log(status, message)

    def _log(self, status: int, message: bytes) -> None:
        if status >= ERROR:
            text = message.decode(errors="replace") if isinstance(message, bytes) else message
            self._messages.append(" ".join(str(text).split()))

    # -- whether its states are all that it keeps
    def _try(self) -> None:
        start = [float(np.nan_to_num(self.values[n])) for n in self.state]
        state = [s + MOVED * max(1.0, abs(s)) for s in start]
        inputs = [0.0] * len(self.inputs)
        for k, variable in enumerate(self._input_variables):
            inputs[k] = float(np.nan_to_num(self._start_of(variable)))
        parameters = [float(np.nan_to_num(self.values[n])) for n in self.parameters]
        with self._as_model_error("fails where it is tried, at its start values"):
            time = self._begin(state, inputs, parameters)
            begun = self._get(self._get_state)
            self._move(time)
            once = self._get(self._get_state)
            self._move(time + self.interval)
            on = self._get(self._get_state)
            if self._time:
                inputs[-1] = time + self.interval
            self._begin(once, inputs, parameters)
            self._move(time + self.interval if self._time else time)
            anew = self._get(self._get_state)
        for name, given, found in zip(self.state, state, begun, strict=True):
            if abs(given - found) > 1e-9 * max(1.0, abs(given)):
                raise self._wrong(
                    f"state {name!r} was set to {given:g} and is {found:g} when it begins",
                    "name the parameter that sets it beside the variable that holds it: "
                    f'state={{"{name}": ("{name}_start", "{name}")}}',
                )
        size = np.max(np.abs([state, once, on]), axis=0)
        change = np.abs(np.subtract(on, once)) + 1e-3 * size
        wrong = np.abs(np.subtract(on, anew)) > KEPT * change
        if wrong.any():
            k = int(np.argmax(wrong))
            raise self._wrong(
                f"it keeps more than its state: after two steps {self.state[k]} is {on[k]:.9g}, "
                f"and {anew[k]:.9g} where the second step begins anew from the states",
                "name all its states in state=; where it depends on the time, name an input for "
                'it: time="t"',
            )

    # -- to other processes
    def __reduce__(self) -> tuple[Any, ...]:
        return _restored, self._made_of

    def __repr__(self) -> str:
        return f"<FMU {self.file}, {self.interval:g} s a call>"


def _restored(path: str, options: dict[str, Any]) -> FMUModel:
    return FMUModel(path, **options)


def fmu(
    path: str | os.PathLike[str], *, dt: float, state: Any = None, inputs: Chosen = None,
    parameters: Chosen = None, outputs: Chosen = None,
    forces: str | Sequence[str] | Mapping[str, str] = (),
    start: Mapping[str, Any] | None = None, time: str | None = None, substeps: int = 1,
    tolerance: float | None = None, name: str | None = None,
    scales: Mapping[str, float] | None = None,
) -> Simulator:  # fmt: skip
    """Make a functional mock-up unit (FMU) for co-simulation, FMI 2.0 or 3.0, a simulator.

    For each point of a batch the unit is reset, its parameters, states and inputs are set, and it
    does one communication step of `dt`. Where it fails, the result is NaN;
    `simulator.step.reason(state, inputs, parameters)` says why at one point. It holds code of
    others that runs in this process: load only units that you trust.

    Parameters
    ----------
    path : of the file.
    dt : seconds between rows, which a call moves.
    state : variables that are the state; a mapping from the name in the model to a variable, or to
        two of them, the one that sets it and the one that holds it, as ("q_start", "q"). By default
        the continuous states that the file lists. All continuous states have to be among them.
    inputs : likewise, or a mapping; by default all of the file that are real numbers.
    parameters : variables that are parameters, or a mapping; by default none: the others keep the
        file's values.
    outputs : as the inputs.
    forces : names among the inputs that are generalised forces, 0 where a call leaves them out, or
        a mapping of these to the velocity that each accelerates, `{"push": "v"}`.
    start : variable -> a fixed value of any type instead of the file's.
    time : name of a further input, the unit's time at the beginning of a call; needed where it
        depends on the time. By default each call begins at 0.
    substeps : communication steps in a call.
    tolerance : of the unit's solver, relative. Derivatives are differences: a solver with adaptive
        steps should have 1e-9 or so.
    name, scales : as of `ssm.simulator`.

    Returns
    -------
    Simulator : its `step` has the attributes `description` (FMPy's), `interval` (seconds of a call)
        and `values` (the file's start values of parameters and states).

    Raises
    ------
    ModelError : the package is missing; the file cannot be read, or is for model exchange only; an
        unknown name, with those that there are; a state that cannot be set; the unit keeps more
        than its state from step to step (tried at its start values).

    Notes
    -----
    FMI: Modelica Association, Functional Mock-up Interface for Model Exchange and Co-Simulation.
    """
    text = os.path.abspath(os.fspath(path))
    if not os.path.isfile(text):
        raise ModelError(
            f"there is no file {text}", fix="give the path of an FMU", where=user_location()
        )
    if not isinstance(dt, int | float | np.floating) or not 0.0 < dt < np.inf:
        raise ModelError(
            f"dt={dt!r} is no positive number",
            fix="give the seconds between rows",
            where=user_location(),
        )
    if isinstance(substeps, bool) or not isinstance(substeps, int) or substeps < 1:
        raise ModelError(
            f"substeps={substeps!r} is no positive whole number",
            fix="give the number of communication steps in a row's interval",
            where=user_location(),
        )
    moved = FMUModel(
        text, dt=float(dt), state=state, inputs=inputs, parameters=parameters, outputs=outputs,
        start=start or {}, time=time, substeps=substeps, tolerance=tolerance,
    )  # fmt: skip
    sense: dict[str, Any] = {}
    if moved.outputs:
        sense = {"output": moved.output, "outputs": moved.outputs}
    return simulator(
        state=moved.state, inputs=moved.inputs, parameters=moved.parameters, forces=forces,
        name=name or identifier(os.path.splitext(moved.file)[0]), scales=scales, **sense,
    )(moved)  # fmt: skip
