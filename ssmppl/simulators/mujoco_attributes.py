"""What of a MuJoCo model can be a parameter: "object.attribute" -> how it is set.

Most are numbers of the compiled model (`MjModel`), of which a copy is changed and the constants
that follow from it computed anew (`mj_setConst`). A geom's size, mass and density, from which a
body's inertia follows, are set in the specification (`MjSpec`), which is compiled again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from ssmppl.errors import ModelError, nearest_first
from ssmppl.expressions.expr import user_location

AXES = ("x", "y", "z")
HINGE = 3  # mjJNT_HINGE


def _always(model: Any, k: int) -> str:
    return ""


@dataclass(frozen=True)
class Attribute:
    """A number of an object of some kind.

    write : (model, the file's model, index of the object, value); with `compiled` False (object of
    the specification, value). read : (model, index) -> the file's value. positive : whether it has
    to be. misfit : (model, index) -> why this object has no such number, or nothing.
    """

    write: Callable[..., None]
    read: Callable[[Any, int], float]
    positive: bool = False
    misfit: Callable[[Any, int], str] = _always
    compiled: bool = True


@dataclass(frozen=True)
class Target:
    """An attribute of one object of a file."""

    text: str
    kind: str
    name: str
    index: int
    attribute: Attribute


def _cell(
    array: str, *column: int, at: str = "", positive: bool = False, option: bool = False,
    misfit: Callable[[Any, int], str] = _always,
) -> Attribute:  # fmt: skip
    """A number of an array of the model: in the row of the object, or in that which the array `at`
    has for it."""

    def place(model: Any, k: int) -> tuple[Any, tuple[int, ...]]:
        if option:
            return getattr(model.opt, array), column
        row = int(getattr(model, at)[k]) if at else k
        return getattr(model, array), (row, *column)

    def write(model: Any, base: Any, k: int, value: float) -> None:
        if option and not column:
            setattr(model.opt, array, value)
            return
        values, index = place(model, k)
        values[index] = value

    def read(model: Any, k: int) -> float:
        values, index = place(model, k)
        return float(values[index] if index else values)

    return Attribute(write, read, positive, misfit)


def _dof(array: str) -> Attribute:
    return _cell(array, at="jnt_dofadr")


def _limited(model: Any, k: int) -> str:
    return "" if model.jnt_limited[k] else "the joint has no range in the file"


def _set_mass(model: Any, base: Any, k: int, value: float) -> None:
    model.body_inertia[k] *= value / base.body_mass[k]  # the shape of its distribution stays
    model.body_mass[k] = value


def _massless(model: Any, k: int) -> str:
    return "" if model.body_mass[k] > 0.0 else "the body has no mass in the file"


def _set_inertia(model: Any, base: Any, k: int, value: float) -> None:
    model.body_inertia[k] *= value


def _centre(axis: int) -> Attribute:
    def write(model: Any, base: Any, k: int, value: float) -> None:
        model.body_ipos[k, axis] = value
        model.body_sameframe[k] = 0  # else the engine takes the body's frame for it

    def misfit(model: Any, k: int) -> str:
        if model.body_simple[k]:
            return "the body's centre of mass is on its joint, for which the engine is simplified"
        return ""

    return Attribute(write, lambda model, k: float(model.body_ipos[k, axis]), misfit=misfit)


def _gravity() -> Attribute:
    """Its magnitude, in the direction of the file."""

    def read(model: Any, k: int) -> float:
        return float(sum(g * g for g in model.opt.gravity) ** 0.5)

    def write(model: Any, base: Any, k: int, value: float) -> None:
        size = read(base, k)
        for j in range(3):
            down = base.opt.gravity[j] / size if size else -float(j == 2)
            model.opt.gravity[j] = value * down

    return Attribute(write, read)


def _is_position(model: Any, k: int) -> bool:
    """A servo for a position: force = kp (u - q) - kv v, as <position> compiles to."""
    kp, bias = model.actuator_gainprm[k, 0], model.actuator_biasprm[k]
    fixed = model.actuator_gaintype[k] == 0 and model.actuator_biastype[k] == 1
    return bool(fixed and kp != 0.0 and bias[1] == -kp)


def _is_velocity(model: Any, k: int) -> bool:
    """A servo for a speed: force = kv (u - v), as <velocity> compiles to."""
    kv, bias = model.actuator_gainprm[k, 0], model.actuator_biasprm[k]
    fixed = model.actuator_gaintype[k] == 0 and model.actuator_biastype[k] == 1
    return bool(fixed and bias[1] == 0.0 and bias[2] == -kv)


def _set_kp(model: Any, base: Any, k: int, value: float) -> None:
    model.actuator_gainprm[k, 0], model.actuator_biasprm[k, 1] = value, -value


def _set_kv(model: Any, base: Any, k: int, value: float) -> None:
    model.actuator_biasprm[k, 2] = -value
    if not _is_position(base, k):
        model.actuator_gainprm[k, 0] = value


def _no_position(model: Any, k: int) -> str:
    return "" if _is_position(model, k) else "the actuator is no <position> servo"


def _no_servo(model: Any, k: int) -> str:
    if _is_position(model, k) or _is_velocity(model, k):
        return ""
    return "the actuator is no <position> or <velocity> servo"


def _no_gain(model: Any, k: int) -> str:
    if _is_position(model, k) or _is_velocity(model, k):
        return "the actuator is a servo, whose gains are kp and kv"
    return ""


def _no_filter(model: Any, k: int) -> str:
    # mjDYN_INTEGRATOR, FILTER, FILTEREXACT = 1, 2, 3; of these the filters have a time constant
    return "" if model.actuator_dyntype[k] in (2, 3) else "the actuator has no filter"


def _in_spec(write: Callable[[Any, float], None], read: Callable[[Any, int], float]) -> Attribute:
    return Attribute(write, read, positive=True, compiled=False)


def _size(column: int) -> Attribute:
    def write(geom: Any, value: float) -> None:
        geom.size[column] = value

    return _in_spec(write, lambda model, k: float(model.geom_size[k, column]))


def _unknown(model: Any, k: int) -> float:
    return float("nan")  # the compiled model has only the body's


ATTRIBUTES: dict[str, dict[str, Attribute]] = {
    "joint": {
        "damping": _dof("dof_damping"),
        "frictionloss": _dof("dof_frictionloss"),
        "armature": _dof("dof_armature"),
        "stiffness": _cell("jnt_stiffness"),
        "springref": _cell("qpos_spring", at="jnt_qposadr"),
        "range_lower": _cell("jnt_range", 0, misfit=_limited),
        "range_upper": _cell("jnt_range", 1, misfit=_limited),
    },
    "body": {
        "mass": Attribute(
            _set_mass, lambda model, k: float(model.body_mass[k]), positive=True, misfit=_massless
        ),
        "inertia": Attribute(_set_inertia, lambda model, k: 1.0, positive=True, misfit=_massless),
        **{f"com_{axis}": _centre(j) for j, axis in enumerate(AXES)},
        "gravcomp": _cell("body_gravcomp"),
    },
    "geom": {
        "friction": _cell("geom_friction", 0),
        "friction_torsional": _cell("geom_friction", 1),
        "friction_rolling": _cell("geom_friction", 2),
        "size": _size(0),
        **{f"size_{j}": _size(j) for j in range(3)},
        "mass": _in_spec(lambda geom, value: setattr(geom, "mass", value), _unknown),
        "density": _in_spec(lambda geom, value: setattr(geom, "density", value), _unknown),
    },
    "actuator": {
        "gear": _cell("actuator_gear", 0),
        "gain": _cell("actuator_gainprm", 0, misfit=_no_gain),
        "kp": Attribute(
            _set_kp, lambda model, k: float(model.actuator_gainprm[k, 0]), misfit=_no_position
        ),
        "kv": Attribute(
            _set_kv, lambda model, k: float(-model.actuator_biasprm[k, 2]), misfit=_no_servo
        ),
        "timeconst": _cell("actuator_dynprm", 0, positive=True, misfit=_no_filter),
    },
    "tendon": {
        "stiffness": _cell("tendon_stiffness"),
        "damping": _cell("tendon_damping"),
        "frictionloss": _cell("tendon_frictionloss"),
    },
    "option": {
        "gravity": _gravity(),
        **{f"gravity_{axis}": _cell("gravity", j, option=True) for j, axis in enumerate(AXES)},
        "timestep": _cell("timestep", positive=True, option=True),
        "density": _cell("density", option=True),
        "viscosity": _cell("viscosity", option=True),
        **{f"wind_{axis}": _cell("wind", j, option=True) for j, axis in enumerate(AXES)},
    },
}  # fmt: skip


def target(text: str, model: Any, objects: dict[str, dict[str, int]], file: str) -> Target:
    """What "object.attribute" is in a model; "kind:object.attribute" where the object's name alone
    is not enough.

    objects : kind -> name -> index.

    Raises
    ------
    ModelError : there is no such object, or it has no such attribute; with what there is.
    """
    owner, dot, attribute = text.rpartition(".")
    kind, colon, name = owner.partition(":")
    if not colon or kind not in ATTRIBUTES:
        kind, name = "", owner
    if not dot or not owner:
        raise _wrong(text, "is no object.attribute", 'write for example "elbow.damping"')
    kinds = [k for k in ATTRIBUTES if name in objects[k] and kind in ("", k)]
    if not kinds:
        names = [n for k in ATTRIBUTES if kind in ("", k) for n in objects[k]]
        raise _wrong(text, f"names {name!r}, which {file} does not have", _listed(name, names))
    fitting = [k for k in kinds if attribute in ATTRIBUTES[k]]
    if not fitting:
        known = [a for k in kinds for a in ATTRIBUTES[k]]
        raise _wrong(text, f"asks for {attribute!r} of the {kinds[0]} {name!r}, which is no "
                     "attribute that can be set", _listed(attribute, known))  # fmt: skip
    if len(fitting) > 1:
        ways = " or ".join(f'"{k}:{name}.{attribute}"' for k in fitting)
        raise _wrong(text, f"may be of the {' or the '.join(fitting)} {name!r}", f"write {ways}")
    own = ATTRIBUTES[fitting[0]][attribute]
    index = objects[fitting[0]][name]
    if why := own.misfit(model, index):
        raise _wrong(text, f"does not apply: {why}", "choose another, or change the file")
    return Target(text, fitting[0], name, index, own)


def _listed(name: str, known: Iterable[str]) -> str:
    names = nearest_first(name, dict.fromkeys(known))
    return "it has: " + ", ".join(names[:40]) + (", ..." if len(names) > 40 else "")


def _wrong(text: str, what: str, fix: str) -> ModelError:
    return ModelError(f"parameters: {text!r} {what}", fix=fix, where=user_location())


def of_joint(
    effect: str, model: Any, k: int, strength: float, shape: Mapping[str, float]
) -> tuple[str, str] | None:
    """The attribute of joint k that carries an effect of `ssm.diagnose`, and its value in words.

    Dry friction and polynomials of the speed and of the angle are what the engine has of its own:
    damping is -(a v + b v |v| + c v^3), stiffness -(a x + b x^2 + c x^3), from the file's `ref`.
    """
    dof = int(model.jnt_dofadr[k])
    if effect == "coulomb friction":
        return "frictionloss", f"{model.dof_frictionloss[dof] + strength:.3g}"
    if effect == "quadratic drag":
        return "damping", f"second coefficient {model.dof_dampingpoly[dof, 0] + strength:.3g}"
    if effect in ("quadratic stiffness", "cubic stiffness"):
        at = int(effect == "cubic stiffness")
        value = model.jnt_stiffnesspoly[k, at] + strength
        return "stiffness", f"{('second', 'third')[at]} coefficient {value:.3g}"
    if effect == "hard stop" and "h" in shape:
        h, middle = shape["h"], shape.get("middle")
        ends = f"{h:.3g}" if middle is None else f"{middle - h:.3g} to {middle + h:.3g}"
        unit = "rad" if model.jnt_type[k] == HINGE else "m"
        return "range", f"an end at {ends} {unit}, with a stiffness of {strength:.3g}"
    return None
