"""`ssm.simulators.mujoco`: a MuJoCo model as a simulator.

A batch of states goes to `mujoco.batch.Batch`, which steps each of them on the model of its
parameters, from a row of the engine's whole state: positions, velocities and activations as given,
controls and generalised forces as given, and all else (the warm start of the constraint solver, the
clock, mocap bodies) as at the beginning of a simulation, so that the result is a function of the
arguments alone.
"""

from __future__ import annotations

import copy
import os
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from numba import cfunc

from ssmppl.errors import ModelError
from ssmppl.expressions.expr import user_location
from ssmppl.language.user_defined.simulator import Simulator, simulator
from ssmppl.simulators.chosen_names import Chosen, chosen, identifier, required
from ssmppl.simulators.engine import Engine
from ssmppl.simulators.mujoco_attributes import Target, of_joint, target

MODELS_BYTES = 64 * 2**20  # of models kept, one for each vector of parameters
BATCHES = 4  # kept, one for each size of a batch
HINGE_OR_SLIDE = (2, 3)  # mjJNT_SLIDE, mjJNT_HINGE

# What the counters of mjtWarning mean, in its order.
REASONS = (
    "the inertia matrix is singular",
    "there are more contacts than MuJoCo has room for",
    "there are more constraints than MuJoCo has room for",
    "it diverged: a position is not finite or huge",
    "it diverged: a velocity is not finite or huge",
    "it diverged: an acceleration is not finite or huge",
    "a control is not finite",
)


class _Quiet:
    """While any call is inside the engine's warnings, which become NaN with a reason, are not
    printed or written to a file as well; and it does not look at the clock for its own profile,
    which of a small model takes a quarter of a step."""

    def __init__(self) -> None:
        self._lock, self._inside = threading.Lock(), 0
        self._before, self._clock_before, self._clock = None, None, None

    @contextmanager
    def within(self, engine: Any) -> Iterator[None]:
        with self._lock:
            if not self._inside:
                self._before = engine.get_mju_user_warning()
                engine.set_mju_user_warning(_ignore)
                self._clock_before = engine.get_mjcb_time()
                self._clock = self._clock or _stopped_clock()
                engine.set_mjcb_time(self._clock)
            self._inside += 1
        try:
            yield
        finally:
            with self._lock:
                self._inside -= 1
                if not self._inside:
                    engine.set_mju_user_warning(self._before)
                    engine.set_mjcb_time(self._clock_before)


def _ignore(text: Any) -> None:
    pass


def _stopped_clock() -> Any:
    """A C function that always says zero."""
    return cfunc("float64()")(lambda: 0.0).ctypes


_quiet = _Quiet()


class _Batch:
    """A batch of the engine with its arrays at hand, which stay the same ones; parameters : bytes
    of those that its models have."""

    def __init__(self, batch: Any, start: np.ndarray, control: np.ndarray, force: np.ndarray):
        self.batch, self.start, self.control, self.force = batch, start, control, force
        self.qpos, self.qvel, self.act, self.ctrl, self.pushed = (
            batch.bind(n) for n in ("qpos", "qvel", "act", "ctrl", "qfrc_applied")
        )
        self.state, self.warning = batch.state, batch.warning
        self.warned = self.warning[:, :, 1]
        self.sensors: np.ndarray | None = None
        self.parameters: bytes | None = None

    def load(self, state: np.ndarray, inputs: np.ndarray, why: Mapping[int, str]) -> None:
        """States and inputs, and all else as it is at the beginning; this alone where `why`."""
        self.state[:] = self.start
        n, m = self.qpos.shape[1], len(self.control)
        self.qpos[:] = state[:, :n]
        self.qvel[:] = state[:, n : 2 * n]
        self.act[:] = state[:, 2 * n :]
        self.ctrl[:, self.control] = inputs[:, :m]
        self.pushed[:, self.force] = inputs[:, m:]
        self.warning[:] = 0
        if why:
            self.state[list(why)] = self.start

    def moved(self) -> np.ndarray:
        """The states after a step."""
        return np.concatenate([self.qpos, self.qvel, self.act], axis=1)

    def sensed(self, sensor: np.ndarray) -> np.ndarray:
        """These numbers of the sensors."""
        assert self.sensors is not None
        return np.array(self.sensors[:, sensor])


class MujocoModel(Engine):
    """A MuJoCo model that moves a batch; `output` gives its sensors.

    Pickled as what it was made of: a file is read again.

    Attributes
    ----------
    model : the file's `MjModel`. state, inputs, outputs, forces : names of columns.
    parameters : name -> what it sets. interval : seconds that one call moves.
    values : name -> the file's value of each parameter; nan where the file has no such number.
    """

    def __init__(
        self, source: str, *, parameters: Mapping[str, Any], controls: Chosen, forces: Chosen,
        sensors: Chosen, substeps: int, threads: int,
    ):  # fmt: skip
        self._made_of = source, {
            "parameters": dict(parameters), "controls": controls, "forces": forces,
            "sensors": sensors, "substeps": substeps, "threads": threads,
        }  # fmt: skip
        self.engine = required("mujoco", "mujoco")
        self._batched = required("mujoco.batch", "mujoco")
        self.substeps, self.threads = substeps, threads
        self.file = os.path.basename(source) if _is_path(source) else "the model"
        self._spec = _read(self.engine, source, self.file)
        self.model = _compiled(self._spec, self.file)
        self.objects = _objects(self.engine, self.model)
        _refuse_what_is_no_state(self.model, self.file)
        self._name_columns(controls, forces, sensors)
        self.parameters: dict[str, tuple[Target, ...] | Callable[..., None]] = {
            name: self._targets(name, given) for name, given in parameters.items()
        }
        self.values = {n: self._file_value(t) for n, t in self.parameters.items()}
        self.interval = substeps * float(self.model.opt.timestep)
        self._recompile = any(
            callable(t) or any(not one.attribute.compiled for one in t)
            for t in self.parameters.values()
        )
        self._scratch = self.engine.MjData(self.model)
        self._start = self._initial_row()
        self._kept = max(64, MODELS_BYTES // max(int(self.model.nbuffer), 1))
        self._models: OrderedDict[bytes, Any] = OrderedDict()
        self._batches: OrderedDict[int, Any] = OrderedDict()
        self._lock = threading.Lock()

    # -- what the columns are
    def _name_columns(self, controls: Chosen, forces: Chosen, sensors: Chosen) -> None:
        joints = self.objects["joint"]
        self.joints = list(joints)
        acts = [
            (name, int(self.model.actuator_actnum[k]))
            for name, k in self.objects["actuator"].items()
        ]
        names = [identifier(n) for n in joints]
        self.state = (
            *names,
            *(f"{n}_velocity" for n in names),
            *(c for name, size in acts for c in _columns(f"{identifier(name)}_activation", size)),
        )
        first = {
            column: int(self.model.actuator_ctrladr[k]) + j
            for name, k in self.objects["actuator"].items()
            for j, column in enumerate(_columns(name, int(self.model.actuator_ctrlnum[k])))
        }
        known = _groups(self.objects["actuator"], first, self.model.actuator_ctrlnum)

        def control(column: str) -> str:
            word = identifier(column)
            return f"{word}_control" if word in self.state else word

        given = chosen(controls, known, "controls", self.file, control)
        self._control = np.array([first[c] for c in given.values()], dtype=int)
        own = {n: (n,) for n in joints}
        pushed = chosen(forces, own, "forces", self.file, lambda n: f"{identifier(n)}_force")
        self.forces = {name: f"{identifier(n)}_velocity" for name, n in pushed.items()}
        self._pushed = dict(pushed)  # the joint that each acts on
        self._actuated = dict(given)  # the actuator of each control
        self._force = np.array(
            [self.model.jnt_dofadr[joints[n]] for n in pushed.values()], dtype=int
        )
        self.inputs = (*given, *pushed)
        at = {
            column: int(self.model.sensor_adr[k]) + j
            for name, k in self.objects["sensor"].items()
            for j, column in enumerate(_columns(name, int(self.model.sensor_dim[k])))
        }
        known = _groups(self.objects["sensor"], at, self.model.sensor_dim)
        sensed = chosen(sensors, known, "sensors", self.file)
        self.outputs = tuple(sensed)
        self._sensor = np.array([at[c] for c in sensed.values()], dtype=int)

    def _targets(self, name: str, given: Any) -> tuple[Target, ...] | Callable[..., None]:
        if callable(given):
            return given
        texts = [given] if isinstance(given, str) or not np.iterable(given) else list(given)
        if not texts or not all(isinstance(t, str) for t in texts):
            raise ModelError(
                f"parameters: {name!r} is {given!r}",
                fix='give "object.attribute", several of these in a list, or a function '
                "(spec, value) that changes an MjSpec",
                where=user_location(),
            )
        return tuple(target(t, self.model, self.objects, self.file) for t in texts)

    def _file_value(self, targets: tuple[Target, ...] | Callable[..., None]) -> float:
        if callable(targets):
            return float("nan")
        return targets[0].attribute.read(self.model, targets[0].index)

    def _initial_row(self) -> np.ndarray:
        spec = self.engine.mjtState.mjSTATE_INTEGRATION
        self.engine.mj_resetData(self.model, self._scratch)
        row = np.empty(self.engine.mj_stateSize(self.model, spec))
        self.engine.mj_getState(self.model, self._scratch, row, spec)
        return row

    # -- what is called
    def attribute_of(
        self, effect: str, argument: str, strength: float, shape: Mapping[str, float]
    ) -> str:
        """Which attribute of the file would carry an effect that `ssm.diagnose` names, and at what
        value; "" where none does.

        argument : the force or control through which it acts. strength : in that one's unit. shape
        : of the effect.
        """
        joint, control = self._pushed.get(argument), self._actuated.get(argument)
        if joint is not None:
            k = self.objects["joint"][joint]
            found = of_joint(effect, self.model, k, strength, shape)
            return f"{found[0]} of the joint {joint!r}: {found[1]}" if found else ""
        if control is not None and effect == "input delay" and "delay" in shape:
            seconds = shape["delay"] * self.interval
            return f"delay of the actuator {control!r}: {seconds:.3g} s, in whole rows"
        return ""

    def _run(
        self, state: np.ndarray, inputs: np.ndarray, parameters: np.ndarray, sense: bool
    ) -> tuple[np.ndarray, dict[int, str]]:
        """The result, and the reason of each row without one."""
        size = len(state)
        width = len(self.outputs) if sense else len(self.state)
        if not size:
            return np.empty((0, width)), {}
        with self._lock:
            why: dict[int, str] = {}
            for part in (state, inputs, parameters):
                if not np.isfinite(part).all():
                    bad = np.flatnonzero(~np.isfinite(part).all(axis=1))
                    why |= {int(k): "an argument is not finite" for k in bad}
            batch = self._batch(size)
            self._set_models(batch, parameters, why)
            batch.load(state, inputs, why)
            ids = np.array([k for k in range(size) if k not in why], dtype=int) if why else None
            if ids is None or len(ids):
                with _quiet.within(self.engine):
                    self._advance(batch, ids, sense, why)
            found = batch.sensed(self._sensor) if sense else batch.moved()
        if why:
            found[list(why)] = np.nan
        return found, why

    def _batch(self, size: int) -> _Batch:
        if size not in self._batches:
            made = self._batched.Batch(self.model, size, self.threads)
            self._batches[size] = _Batch(made, self._start, self._control, self._force)
            if len(self._batches) > BATCHES:
                self._batches.popitem(last=False)
        self._batches.move_to_end(size)
        return self._batches[size]

    def _advance(self, batch: _Batch, ids: Any, sense: bool, why: dict[int, str]) -> None:
        own = batch.batch
        try:
            if sense:
                if batch.sensors is None:
                    batch.sensors = own.bind("sensordata")
                own.forward(ids)
            else:
                own.step(ids, nstep=self.substeps)
        except self._batched.SimulationError as error:
            why |= {int(k): f"MuJoCo: {own.error(int(k))}" for k in error.ids}
        if batch.warned.any():
            for k, kind in zip(*np.nonzero(batch.warned), strict=True):
                why.setdefault(int(k), REASONS[kind] if kind < len(REASONS) else "MuJoCo warns")

    # -- models of parameters
    def _set_models(self, batch: _Batch, parameters: np.ndarray, why: dict[int, str]) -> None:
        if not self.parameters:
            return
        rows = np.ascontiguousarray(parameters, dtype=float)
        whole = rows.tobytes()
        if whole == batch.parameters and not why:
            return
        width = rows.shape[1] * rows.itemsize
        keys = [whole[k * width : (k + 1) * width] for k in range(len(rows))]
        own: dict[bytes, Any] = {}
        models = []
        for k, key in enumerate(keys):
            if k not in why and key not in own:
                own[key] = self._model_of(key, rows[k])
            if k not in why and isinstance(own[key], str):
                why[k] = own[key]
            models.append(self.model if k in why else own[key])
        batch.batch.set_models(models)
        batch.parameters = None if why else whole

    def _model_of(self, key: bytes, row: np.ndarray) -> Any:
        """The model of a vector of parameters, or why there is none."""
        if key in self._models:
            self._models.move_to_end(key)
            return self._models[key]
        try:
            found = self._made(dict(zip(self.parameters, row.tolist(), strict=True)))
        except (ValueError, self.engine.FatalError) as error:
            found = " ".join(str(error).split())
        self._models[key] = found
        while len(self._models) > self._kept:
            self._models.popitem(last=False)
        return found

    def _made(self, values: Mapping[str, float]) -> Any:
        parts = [
            (one, values[name])
            for name, targets in self.parameters.items()
            if not callable(targets)
            for one in targets
        ]
        for one, value in parts:
            if one.attribute.positive and not value > 0.0:
                raise ValueError(f"{one.text} = {value:g} is not positive")
        model = self._edited(values, parts) if self._recompile else copy.copy(self.model)
        for one, value in parts:
            if one.attribute.compiled:
                one.attribute.write(model, self.model, one.index, value)
        scratch = self.engine.MjData(model) if self._recompile else self._scratch
        self.engine.mj_setConst(model, scratch)
        return model

    def _edited(self, values: Mapping[str, float], parts: list[tuple[Target, float]]) -> Any:
        """The specification with what stands in it changed, compiled."""
        spec = self._spec.copy()
        for name, targets in self.parameters.items():
            if callable(targets):
                targets(spec, values[name])
        for one, value in parts:
            if not one.attribute.compiled:
                one.attribute.write(getattr(spec, one.kind)(one.name), value)
        return spec.compile()

    # -- to other processes
    def __reduce__(self) -> tuple[Any, ...]:
        return _restored, self._made_of

    def __repr__(self) -> str:
        return f"<MuJoCo model {self.file}, {self.interval:g} s a call>"


def _restored(source: str, options: dict[str, Any]) -> MujocoModel:
    return MujocoModel(source, **options)


def mujoco(
    model: str | os.PathLike[str], *, parameters: Mapping[str, Any] | None = None,
    controls: Chosen = None, forces: Chosen = None, sensors: Chosen = None,
    substeps: int | None = None, dt: float | None = None, threads: int = 1,
    name: str | None = None, scales: Mapping[str, float] | None = None,
) -> Simulator:  # fmt: skip
    """Make a MuJoCo model a simulator: its joints are the state, its actuators the inputs.

    A joint `elbow` is the two states `elbow` (rad or m) and `elbow_velocity`; an actuator with an
    activation adds `<actuator>_activation`. Positions come first, then velocities, then
    activations. An input `<joint>_force` (N m or N) acts on each joint beside the actuators and is
    0 where a call leaves it out. Every call begins with a fresh solver, so that the result depends
    on its arguments alone. Where MuJoCo warns (it diverged, a singular inertia), the result is NaN;
    `simulator.step.reason(state, inputs, parameters)` says why at one point.

    Parameters
    ----------
    model : path of an MJCF or URDF file, or the XML itself.
    parameters : name -> "object.attribute", or a list of these that share one value. Of joints:
        damping, frictionloss, armature, stiffness, springref, range_lower, range_upper (rad or m);
        of bodies: mass (the inertia in proportion), inertia (a factor on the file's), com_x, com_y,
        com_z (m, in the body's frame), gravcomp; of geoms: friction, friction_torsional,
        friction_rolling (of two geoms in contact the larger counts), and size, size_0, size_1,
        size_2, mass, density, from which the inertia follows; of actuators: gain, gear, kp, kv,
        timeconst; of tendons: stiffness, damping, frictionloss; "option.gravity" (magnitude),
        "option.gravity_z", "option.timestep",
        "option.density", "option.viscosity", "option.wind_x". "kind:object.attribute" where several
        kinds of objects have the name. Or a function (spec, value) that changes an `MjSpec`, for
        lengths of links and the like; it is compiled again for each value.
    controls : actuators that are inputs, or a mapping from input to actuator; default all. What is
        left out has the control 0. The input has the actuator's name, with `_control` behind it
        where a joint has that name too.
    forces : joints that have a force as input, or a mapping; default all.
    sensors : the outputs, or a mapping from output to sensor; default all. A sensor of several
        numbers is `<sensor>_0`, `<sensor>_1`, ... Those of accelerations and forces depend on the
        inputs.
    substeps : steps of the engine, each the file's timestep, in a call.
    dt : seconds between rows; gives `substeps`, or is checked against them.
    threads : of the engine, over the batch.
    name : for messages; by default that of the file.
    scales : as of `ssm.simulator`.

    Returns
    -------
    Simulator : its `step` has the attributes `model` (the `MjModel`), `interval` (seconds of a
        call) and `values` (the file's value of each parameter).

    Raises
    ------
    ModelError : the package is missing; the file cannot be read; it has balls, free joints, or
        objects without a name; an unknown name, with those that there are; `dt` is no multiple of
        the timestep.

    Notes
    -----
    Derivatives are central differences of the engine's own steps. They jump where contacts begin
    and end. MuJoCo: Todorov, Erez and Tassa (2012), IROS, 5026-5033.

    Examples
    --------
    >>> import ssmppl as ssm
    >>> xml = '''<mujoco><worldbody><body name="bob">
    ...   <joint name="pivot" axis="0 1 0" damping="0.1"/>
    ...   <geom size="0.05" pos="0 0 -1" mass="1"/></body></worldbody></mujoco>'''
    >>> pendulum = ssm.simulators.mujoco(
    ...     xml, parameters={"damping": "pivot.damping"}, dt=0.02)  # doctest: +SKIP
    >>> pendulum.state, pendulum.inputs  # doctest: +SKIP
    (('pivot', 'pivot_velocity'), ('pivot_force',))
    """
    source = _source(model)
    steps = 1 if substeps is None else substeps
    if isinstance(steps, bool) or not isinstance(steps, int | np.integer) or steps < 1:
        raise ModelError(
            f"substeps={substeps!r} is no positive whole number",
            fix="give the number of the engine's steps in a row's interval",
            where=user_location(),
        )
    options: dict[str, Any] = {
        "parameters": parameters or {}, "controls": controls, "forces": forces,
        "sensors": sensors, "threads": threads,
    }  # fmt: skip
    moved = MujocoModel(source, substeps=int(steps), **options)
    if dt is not None:
        moved.substeps = _steps_of(dt, moved, substeps)
        moved.interval = moved.substeps * float(moved.model.opt.timestep)
        moved._made_of[1]["substeps"] = moved.substeps
    title = name or (os.path.splitext(moved.file)[0] if _is_path(source) else "mujoco")
    sense: dict[str, Any] = {}
    if moved.outputs:
        sense = {"output": moved.output, "outputs": moved.outputs}
    return simulator(
        state=moved.state, inputs=moved.inputs, parameters=tuple(moved.parameters),
        forces=moved.forces, name=title, scales=scales, **sense,
    )(moved)  # fmt: skip


def _steps_of(dt: float, moved: MujocoModel, substeps: int | None) -> int:
    step = float(moved.model.opt.timestep)
    steps = round(dt / step) if np.isfinite(dt) and dt > 0 else 0
    if steps < 1 or abs(steps * step - dt) > 1e-9 * dt:
        raise ModelError(
            f"dt={dt:g} s is no multiple of the timestep {step:g} s of {moved.file}",
            fix="change <option timestep> in the file so that dt is a multiple of it",
            where=user_location(),
        )
    if substeps is not None and substeps != steps:
        raise ModelError(
            f"{substeps} substeps of {step:g} s are {substeps * step:g} s, and not dt={dt:g} s",
            fix=f"give dt alone, which takes {steps} substeps",
            where=user_location(),
        )
    if any(
        not callable(t) and any(one.text == "option.timestep" for one in t)
        for t in moved.parameters.values()
    ):
        raise ModelError(
            "dt is given, and the timestep is a parameter",
            fix="give substeps instead: a call then moves substeps times the timestep",
            where=user_location(),
        )
    return steps


# -- files
def _is_path(source: str) -> bool:
    return "<" not in source


def _source(model: str | os.PathLike[str]) -> str:
    text = os.fspath(model)
    if not isinstance(text, str):
        raise ModelError(
            f"the model is {model!r}", fix="give a path, or the XML", where=user_location()
        )
    if not _is_path(text):
        return text
    path = os.path.abspath(text)
    if not os.path.isfile(path):
        raise ModelError(
            f"there is no file {path}",
            fix="give the path of an MJCF file, or the XML itself",
            where=user_location(),
        )
    return path


def _read(engine: Any, source: str, file: str) -> Any:
    spec = engine.MjSpec
    try:
        return spec.from_file(source) if _is_path(source) else spec.from_string(source)
    except (ValueError, engine.FatalError) as error:
        raise _unreadable(file, error) from None


def _compiled(spec: Any, file: str) -> Any:
    try:
        return spec.compile()
    except ValueError as error:
        raise _unreadable(file, error) from None


def _unreadable(file: str, error: Exception) -> ModelError:
    return ModelError(
        f"MuJoCo cannot read {file}: {' '.join(str(error).split())}",
        fix="mend the file; `python -m mujoco.viewer --mjcf=FILE` shows it",
        where=user_location(),
    )


def _objects(engine: Any, model: Any) -> dict[str, dict[str, int]]:
    """Kind -> name -> index; actuators without a name have that of what they drive."""
    kinds = engine.mjtObj
    out: dict[str, dict[str, int]] = {"option": {"option": 0}}
    for kind, code, number in (
        ("joint", kinds.mjOBJ_JOINT, model.njnt),
        ("body", kinds.mjOBJ_BODY, model.nbody),
        ("geom", kinds.mjOBJ_GEOM, model.ngeom),
        ("actuator", kinds.mjOBJ_ACTUATOR, model.nactuator),
        ("tendon", kinds.mjOBJ_TENDON, model.ntendon),
        ("sensor", kinds.mjOBJ_SENSOR, model.nsensor),
    ):
        names = [engine.mj_id2name(model, code, k) or "" for k in range(number)]
        for k, name in enumerate(names):
            if not name and kind == "actuator":
                driven = engine.mj_id2name(model, kinds.mjOBJ_JOINT, model.actuator_trnid[k, 0])
                name = driven or f"actuator_{k}"
                while name in names or name in out.get(kind, {}):
                    name = f"{name}_{k}"
            elif not name and kind == "sensor":
                name = f"sensor_{k}"
            if name:
                out.setdefault(kind, {})[name] = k
        out.setdefault(kind, {})
    return out


def _columns(name: str, size: int) -> list[str]:
    return [name] if size == 1 else [f"{name}_{j}" for j in range(size)]


def _groups(
    objects: Mapping[str, int], columns: Mapping[str, int], sizes: Sequence[int]
) -> dict[str, list[str]]:
    """What can be asked for: each object, and each of its columns."""
    out = {name: _columns(name, int(sizes[k])) for name, k in objects.items() if sizes[k]}
    return out | {c: [c] for c in columns}


def _refuse_what_is_no_state(model: Any, file: str) -> None:
    """What a vector of joints' positions, velocities and activations does not hold."""

    def wrong(found: str, fix: str) -> ModelError:
        return ModelError(f"{file}: {found}", fix=fix, where=user_location())

    if not model.njnt:
        raise wrong("it has no joint, and so no state", "give the moving bodies joints")
    for k in range(model.njnt):
        body = model.body(model.jnt_bodyid[k]).name or model.jnt_bodyid[k]
        if model.jnt_type[k] not in HINGE_OR_SLIDE:
            raise wrong(
                f"body {body!r} has a ball or free joint, whose orientation is a quaternion: four "
                "numbers of norm 1, which additive noise and differences leave",
                "write its motion by slide and hinge joints, as <joint type='slide'/> for x, y, z "
                "and three hinges for the angles",
            )
        if not model.joint(k).name:
            raise wrong(
                f"joint {k}, of body {body!r}, has no name", 'give it one: <joint name="..."/>'
            )
    for count, what in (
        (model.nhistory, "delays of actuators or sensors"),
        (model.nplastic, "plastic springs"),
        (model.npluginstate, "plugins with a state"),
    ):
        if count:
            raise wrong(
                f"it has {what}, which are further state",
                "take them out; a delay can be written in the model's own states",
            )
