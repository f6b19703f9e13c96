"""Calling a user's law on symbols: what it reads, where it returns, and errors at its own lines.

Symbols that a law looks up in a set or a dictionary, which does not have them and says nothing.

`u in {1, 2}` and `TABLE.get(u, 0.0)` ask for the symbol itself, by its hash: there is no operation
of it that could tell. They are found in the law's own instructions, where an argument goes there
by its name: not in functions that the law calls, nor under another name.

What is called otherwise elsewhere: names that this language does not have, and what to write.

Of Stan, PyMC, NumPyro, brms, SciPy, TensorFlow Probability and pomp.
"""

from __future__ import annotations

import difflib
import dis
import inspect
import itertools
import os
import re
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping
from types import CodeType, TracebackType
from typing import Any

import numpy as np

from ssmppl.errors import Location, ModelError, SSMError, UnsupportedOperation
from ssmppl.expressions.expr import INDEX_BY_SYMBOL, topological
from ssmppl.expressions.numpy_protocols import INSTEAD
from ssmppl.language.distributions import DISTRIBUTIONS, Distribution
from ssmppl.language.model.closure_digest import INSTALLED, outer_values, plain_function
from ssmppl.language.model.model import location_of

Law = Callable[..., Any]


def instructions(code: CodeType) -> Iterator[tuple[dis.Instruction, int | None]]:
    """Those of a function and of the functions inside of it, each with its line."""
    for instruction in dis.get_instructions(code):
        yield instruction, instruction.positions.lineno if instruction.positions else None
    for inner in code.co_consts:
        if isinstance(inner, CodeType):
            yield from instructions(inner)


def check_lookups(function: Law, role: str, arguments: Mapping[str, Any]) -> None:
    """Refuse them; an argument that went through a call before may be a number, and is let pass."""
    found = [i for i, _ in instructions(plain_function(function).__code__)]
    outer, rebound = outer_values(function), _rebound(plain_function(function).__code__, found)
    for k, instruction in enumerate(found):
        if instruction.opname == "CONTAINS_OP":
            whole = _value(found[k - 1], outer)
            named = _tested(found[: k - 1], instruction)
        elif instruction.argval == "get" and k + 1 < len(found):
            whole = _value(found[k - 1], outer)
            after = [i for i in found[k + 1 : k + 4] if i.opname not in ("PUSH_NULL", "CACHE")]
            named = _loaded(after[0])[:1] if after else []
            if len(after) > 1 and _may_be_number(after[1]):
                named = []
        else:
            continue
        named = [n for n in named if n in arguments and n not in rebound]
        if named and _by_hash(whole):
            where = location_of(function)
            line = instruction.positions.lineno if instruction.positions else None
            raise ModelError(
                f"@{role} {function.__name__} looks {named[0]!r}, a symbol, up in a "
                f"{type(whole).__name__}, which never has it",
                fix=f"compare it: np.where(({named[0]} == 1) | ({named[0]} == 2), a, b); of a "
                "table, np.choose(k, values) is values[k] for a symbol k from 0",
                where=Location(where.file, line or where.line, function.__name__),
            )


def _rebound(code: CodeType, found: list[dis.Instruction]) -> set[str]:
    """Names that may stand for other things than the law's arguments: assigned anew, or local to a
    function inside."""
    names = {n for i in found if i.opname.startswith("STORE_") for n in _names(i)}
    inner = [c for c in code.co_consts if isinstance(c, CodeType)]
    for c in inner:
        names.update(c.co_varnames)
        inner += [d for d in c.co_consts if isinstance(d, CodeType)]
    return names


def _by_hash(whole: Any) -> bool:
    return isinstance(whole, (set, frozenset, Mapping)) or (
        type(whole).__module__.partition(".")[0] == "pandas" and hasattr(whole, "__contains__")
    )


def _value(instruction: dis.Instruction, outer: Mapping[str, Any]) -> Any:
    """What a constant or a name from outside is; None of others."""
    if instruction.opname == "LOAD_CONST":
        return instruction.argval
    return outer.get(str(instruction.argval)) if instruction.opname.startswith("LOAD_") else None


def _tested(before: list[dis.Instruction], contains: dis.Instruction) -> list[str]:
    """The local names on the left of `in`, from the last; none where it calls something."""
    names: list[str] = []
    begun = False  # where the source of the left side begins
    for instruction in reversed(before):
        if not _within(instruction, contains):
            # Python 3.13 loads two at once, and says where the first one was read
            return names if begun else names + _loaded(instruction)[1:]
        begun = _start(instruction) == _start(contains)
        if _may_be_number(instruction):
            return []
        names += reversed(_loaded(instruction))
    return names


def _may_be_number(instruction: dis.Instruction) -> bool:
    return "CALL" in instruction.opname or "ATTR" in instruction.opname


def _loaded(instruction: dis.Instruction) -> list[str]:
    return _names(instruction) if instruction.opname.startswith("LOAD_FAST") else []


def _names(instruction: dis.Instruction) -> list[str]:
    """One, or two where Python 3.13 does two things at once."""
    names = instruction.argval
    return list(names) if isinstance(names, tuple) else [names]


def _start(instruction: dis.Instruction) -> tuple[int | None, int | None]:
    at = instruction.positions
    return (at.lineno, at.col_offset) if at else (None, None)


def _within(a: dis.Instruction, b: dis.Instruction) -> bool:
    """Whether the source of a lies in that of b."""
    if a.positions is None or b.positions is None or None in (*a.positions, *b.positions):
        return False
    (first, last, start, end), (top, bottom, left, right) = a.positions, b.positions
    return (top, left) <= (first, start) and (last, end) <= (bottom, right)  # type: ignore[operator]


_NORMAL = "ssm.Normal(mean, sd=)"
_VECTOR = "ssm.MvNormal(mean, covariance=)"
_NEGATIVE = "ssm.NegativeBinomial(mean, dispersion=)"
_ZEROS = "ssm.ZeroInflated(ssm.{0}, p), p the probability of a structural zero"
_HURDLE = "ssm.ZeroInflated(ssm.Truncated(ssm.{0}, lower=1), p), p the probability of zero"
_MIXTURE = "ssm.Mixture(weights, [ssm.Normal(mean, sd=), ...])"
_POINT = "ssm.Dirac(value) for a state, or a line of Python in the law that needs it"
# lower case and without underscores -> what is written here
WRITTEN: dict[str, str] = {
    **dict.fromkeys(["gauss", "gaussian", "norm"], _NORMAL),
    **dict.fromkeys(
        ["multivariatenormal", "multinormal", "multivariatenormalfulltensor", "mvn"], _VECTOR
    ),
    **dict.fromkeys(["multivariategaussian", "mvgaussian", "gaussianmultivariate"], _VECTOR),
    **dict.fromkeys(
        ["gammapoisson", "negativebinomial2", "negbinomial2", "negbinomial", "nbinom", "negbin"],
        _NEGATIVE,
    ),
    "geometric": "ssm.NegativeBinomial(mean, dispersion=1), failures before a success: mean "
    "(1 - p) / p",
    **dict.fromkeys(["zeroinflatedpoisson", "zip"], _ZEROS.format("Poisson(rate)")),
    **dict.fromkeys(
        ["zeroinflatednegativebinomial", "zinb", "zeroinflatednegativebinomial2"],
        _ZEROS.format("NegativeBinomial(mean, dispersion=)"),
    ),
    "zeroinflatedbinomial": _ZEROS.format("Binomial(n, p)"),
    "zeroinflateddistribution": _ZEROS.format("Poisson(rate)"),
    "hurdlepoisson": _HURDLE.format("Poisson(rate)"),
    "hurdlenegativebinomial": _HURDLE.format("NegativeBinomial(mean, dispersion=)"),
    **dict.fromkeys(
        ["normalmixture", "mixturesamefamily", "mixturegeneral", "gaussianmixture"], _MIXTURE
    ),
    "multinomial": "ssm.Binomial for each category, out of those that are left: "
    "ssm.Binomial(left, p[k] / np.sum(p[k:])), where `left`, the trials that no earlier category "
    "has, is an input; where the total is random, independent ssm.Poisson",
    "dirichletmultinomial": "ssm.BetaBinomial(left, a[k], np.sum(a[k + 1:])) for each category but "
    "the last, where `left`, the trials that no earlier category has, is an input",
    **dict.fromkeys(["chisquared", "chisquare", "chi2"], "ssm.Gamma(df / 2, rate=1 / 2)"),
    "erlang": "ssm.Gamma(shape, rate=)",
    "rayleigh": "ssm.Weibull(2, scale=np.sqrt(2) * sigma)",
    **dict.fromkeys(
        ["halfstudentt", "halft"], "ssm.Truncated(ssm.StudentT(df, 0, scale=), lower=0)"
    ),
    **dict.fromkeys(
        ["truncatednormal", "truncnorm"],
        "ssm.Truncated(ssm.Normal(mean, sd=), lower=, upper=)",
    ),
    **dict.fromkeys(["invgamma", "inversegamma2"], "ssm.InverseGamma(shape, scale=)"),
    **dict.fromkeys(["lognorm"], "ssm.LogNormal(mean, sd=), both of the logarithm"),
    **dict.fromkeys(["doubleexponential"], "ssm.Laplace(loc, scale=)"),
    **dict.fromkeys(["t", "student", "studentst"], "ssm.StudentT(df, loc, scale=)"),
    **dict.fromkeys(["delta", "deterministic", "constant", "degenerate"], _POINT),
    "discreteuniform": "ssm.Categorical(np.full(n, 1 / n)), whose values begin at 0",
    "loguniform": "ssm.Uniform(lower, upper) for the logarithm as the parameter, and np.exp of it "
    "where it acts",
    "filter": "ssm.particle_filter(model, data, parameters), or ssm.kalman_filter for linear "
    "Gaussian models",
    **dict.fromkeys(["mcmc", "nuts"], "ssm.sample(model, data)"),
    "fit": "ssm.sample(model, data) for a posterior, ssm.maximize(model, data) for an estimate",
    **dict.fromkeys(["mle", "optimize", "optimise"], "ssm.maximize(model, data)"),
    **dict.fromkeys(["vonmisesfisher"], "ssm.VonMises(mean, concentration=) for an angle"),
}
CLOSE = 0.6  # least similarity of a misspelling


def advice(name: str, known: Iterable[str]) -> str:
    """What to write for a name that is none of `known`; empty where nothing comes near."""
    plain = name.lower().replace("_", "")
    if plain in WRITTEN:
        return f"write {WRITTEN[plain]}"
    spelled = {k.lower(): k for k in known}
    near = difflib.get_close_matches(name.lower(), spelled, n=1, cutoff=CLOSE)
    return f"write ssm.{spelled[near[0]]}" if near else ""


Known = Mapping[str, str]  # name of a quantity -> its role
_OWN = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__)))) + os.sep
# NumPy's messages about object arrays, which np.array makes of symbols
_OBJECT_ARRAY = re.compile(r"has no callable|dtype\('O'\)|not supported for the input types")
_BUILD = (
    "np.array([...]) of symbols is a plain object array to NumPy: build vectors by "
    "np.stack([a, b]) and matrices by np.block([[a, b], [c, d]])"
)
_NO_ELEMENTS = (
    "write the name without brackets and without a loop over it; what has several components is "
    "declared with a vector law (MvNormal, or arguments that are arrays)"
)
# Python's messages about a scalar symbol: what was asked of it, and what to write instead
_ASKED_OF_SYMBOLS = tuple(
    (re.compile(pattern), found, fix)
    for pattern, found, fix in (
        (r"^'Expr' object is not subscriptable",
         "takes an element, [...], of a symbol that is one number", _NO_ELEMENTS),
        (r"^'Expr' object does not support item",
         "assigns to an element, [...], of a symbol", "compute a new value under a new name"),
        (r"^'Expr' object is not iterable|cannot unpack non-iterable Expr",
         "goes through a symbol that is one number as through a list (for, in, sum(), max(), "
         "unpacking)", _NO_ELEMENTS),
        (r"^object of type 'Expr' has no len",
         "asks for the len() of a symbol that is one number",
         "write 1, or the count itself: lengths are known when the model is written"),
        (r"doesn't define __round__",
         "rounds a symbol by Python's round()", "write np.floor(x + 0.5)"),
        (r"doesn't define __trunc__|Expr.__trunc__",
         "cuts a symbol to a whole number by Python's trunc()",
         "write np.sign(x) * np.floor(np.abs(x))"),
        (r"format string passed to Expr",
         "formats a symbol as a number (an f-string, format())",
         "take the text out of the law: a symbol has no value while the model is traced"),
        (r"^'Expr' object is not callable",
         "calls a symbol as a function", "write x * (...) for a product"),
        (r"for divmod\(\).*'Expr'", "asks for divmod() of a symbol", "write x // n and x % n"),
        (r"for @.*'Expr'", "multiplies numbers by @, which is for vectors and matrices",
         "write * for a product of numbers"),
        (r"unsupported operand type\(s\) for (\S+?):? .*'Expr' and '(\w+)'",
         "has a symbol and a {1} on the two sides of {0}",
         "use numbers, symbols and arrays of them"),
        (r"unsupported operand type\(s\) for (\S+?):? '(\w+)' and 'Expr'",
         "has a {1} and a symbol on the two sides of {0}",
         "use numbers, symbols and arrays of them"),
        (r"^'Expr' object has no attribute '(\w+)'",
         "asks a symbol for {0!r}, which it does not have",
         "use NumPy's functions on it, such as np.exp(x); " + _BUILD),
    )
)  # fmt: skip


def call(function: Law, role: str, arguments: dict[str, Any], known: Known) -> Any:
    """What the law returns for these arguments.

    It is called twice: a law that is not the same again draws random numbers or changes something,
    and what was drawn would be frozen into the model.
    """
    check_lookups(function, role, arguments)
    first = once(function, role, arguments, known)
    again = once(function, role, arguments, known)
    if not _same(first, again):
        raise ModelError(
            f"@{role} {function.__name__} gives another law when it is called again",
            fix="draw no random numbers and change nothing inside of it: it runs on symbols, "
            "and randomness belongs into the distributions that it returns",
            where=return_location(function),
        )
    return first


def once(function: Law, role: str, arguments: dict[str, Any], known: Known) -> Any:
    """What the function returns; its errors are told at the user's line."""
    try:
        signature = inspect.signature(function)
        bound = signature.bind_partial()
        bound.arguments.update({n: arguments[n] for n in signature.parameters if n in arguments})
        return function(*bound.args, **bound.kwargs)
    except SSMError as error:
        told = _at_users_line(error, function)
        if told is error and isinstance(error, UnsupportedOperation):
            told = _of_a_library(error, function)
        if told is error:  # not its own cause: what packs errors follows causes to their end
            raise
        raise told from error
    except Exception as error:
        raise _wrapped(error, function, role, arguments, known) from error


def _same(a: Any, b: Any) -> bool:
    if not (isinstance(a, Mapping) and isinstance(b, Mapping)):
        return True  # refused for what it is
    if list(a) != list(b):
        return False
    pairs = [(a[n], b[n]) for n in a if isinstance(a[n], Distribution)]
    return all(type(d) is type(e) and _content(d) == _content(e) for d, e in pairs)


def _content(d: Distribution) -> list[tuple[str, str]]:
    nodes = topological(d.expressions())
    return [(n.op, repr(n.data) if n.op in ("const", "symbol") else "") for n in nodes]


def return_location(function: Law) -> Location:
    """The line of the law's only `return`; its `def` where there are several."""
    plain = plain_function(function)
    lines, line = set(), 0
    for instruction in dis.get_instructions(plain.__code__):
        position = instruction.positions
        line = (position.lineno if position else None) or line
        if instruction.opname in ("RETURN_VALUE", "RETURN_CONST"):
            lines.add(line)
    where = location_of(function)
    return Location(where.file, lines.pop(), where.function) if len(lines) == 1 else where


# -- names from outside of the law
def check_outer_names(function: Law, role: str, known: Known) -> None:
    """Refuse a law that reads a variable of Python's named as a quantity of the model, itself or
    in a function of the user's that it calls.

    With `phi = 0.9` at the top of the file, a law that forgets `phi` among its arguments would
    quietly use 0.9.
    """
    who = f"@{role} {function.__name__} reads"
    to_read: list[tuple[Callable[..., Any], str]] = [(function, who)]
    met = {id(function)}
    while to_read:
        reader, who = to_read.pop()
        for name, value in outer_values(reader).items():
            if inspect.isfunction(value) and id(value) not in met and _of_the_users(value):
                met.add(id(value))
                to_read.append((value, f"{value.__name__}(), which @{role} calls, reads"))
            if name not in known or callable(value) or inspect.ismodule(value):
                continue
            code = plain_function(reader).__code__
            raise ModelError(
                f"{who} the Python variable {name!r}, while {name!r} is {known[name]} of the model",
                fix=f"add {name!r} to the arguments of {reader.__name__}; if the variable is "
                "meant, rename it",
                where=_line_of_name(code, name, location_of(reader)),
            )


def _of_the_users(function: Callable[..., Any]) -> bool:
    file = plain_function(function).__code__.co_filename
    return not file.startswith((*INSTALLED, _OWN))


def _line_of_name(code: CodeType, name: str, where: Location) -> Location:
    for instruction, line in instructions(code):
        if instruction.opname.startswith("LOAD_") and instruction.argval == name and line:
            return Location(where.file, line, where.function)
    return where


# -- errors inside of the law
def _frames(function: Law, trace: TracebackType | None) -> list[traceback.FrameSummary]:
    file = plain_function(function).__code__.co_filename
    return [f for f in traceback.extract_tb(trace) if f.filename == file]


def _at_users_line(error: SSMError, function: Law) -> SSMError:
    """`error`, moved to the user's line where it arose inside of an installed library."""
    where = error.where
    file = plain_function(function).__code__.co_filename
    if not isinstance(where, Location) or where.file == file:
        return error
    frames = _frames(function, error.__traceback__)
    if not where.file.startswith(INSTALLED) or not frames:
        return error
    last = frames[-1]
    place = Location(file, last.lineno or 0, last.name)
    return type(error)(
        f"{error.found} (inside of {where.function}() of a library)",
        fix="write the computation by NumPy's functions, or wrap it by @ssm.primitive",
        where=place,
    )


def _library_function(function: Law, trace: TracebackType | None) -> str:
    """The name of the function of an installed library that the law called and that failed; ""
    where it was none."""
    file, called = plain_function(function).__code__.co_filename, ""
    for frame, after in itertools.pairwise(traceback.extract_tb(trace)):
        if frame.filename == file:
            there = after.filename.startswith(INSTALLED) and not after.filename.startswith(_OWN)
            called = after.name if there else ""
    return called.strip("_<>")


def _of_a_library(error: UnsupportedOperation, function: Law) -> UnsupportedOperation:
    """What a library's function for numbers asked of a symbol, told by the function's name."""
    name = _library_function(function, error.__traceback__)
    if name not in INSTEAD:
        return error
    return UnsupportedOperation(f"{name}() of a library takes numbers, not symbols",
                                fix=f"write {INSTEAD[name]}", where=error.where)  # fmt: skip


def _wrapped(
    error: Exception, function: Law, role: str, arguments: dict[str, Any], known: Known
) -> ModelError:
    """An exception inside a user's function, at the user's line."""
    frames = _frames(function, error.__traceback__)
    where = location_of(function)
    if frames:
        where = Location(frames[-1].filename, frames[-1].lineno or 0, frames[-1].name)
    shapes = ", ".join(f"{n} of shape {np.shape(v)}" for n, v in arguments.items())
    fix = (
        "the function runs once on symbols, for one particle and one time step; its "
        f"arguments were {shapes or 'none'}"
    )
    found = f"@{role} {function.__name__} raised {type(error).__name__}: {error}"
    if isinstance(error, NameError) and (role_of := known.get(str(error.name))):
        fix = f"add {error.name!r}, {role_of} of the model, to the arguments of "
        fix += function.__name__
    elif (called := _library_function(function, error.__traceback__)) in INSTEAD:
        found = f"{called}() of a library takes numbers, not symbols"
        fix = f"write {INSTEAD[called]}"
    elif told := _of_a_symbol(error):
        found, fix = f"@{role} {function.__name__} {told[0]}", told[1]
    elif _OBJECT_ARRAY.search(str(error)):
        fix = _BUILD
    elif isinstance(error, IndexError) and "only integers, slices" in str(error):
        fix = f"if the index is a symbol: {INDEX_BY_SYMBOL}"
    elif isinstance(error, AttributeError) and (attribute := _ssm_attribute(error)):
        found = f"@{role} {function.__name__} asks for ssm.{error.name}, which does not exist"
        fix = attribute
    return ModelError(found, fix=fix, where=where)


def _of_a_symbol(error: Exception) -> tuple[str, str] | None:
    """What was asked of a scalar symbol that only other objects of Python have, and the fix."""
    if not isinstance(error, (TypeError, AttributeError)):
        return None
    for pattern, found, fix in _ASKED_OF_SYMBOLS:
        if match := pattern.search(str(error)):
            return found.format(*match.groups()), fix.format(*match.groups())
    return None


def _ssm_attribute(error: AttributeError) -> str:
    if inspect.ismodule(error.obj) and error.obj.__name__.startswith("ssmppl"):
        told = advice(str(error.name), DISTRIBUTIONS)
        return f"{told}{'; ' if told else ''}the distributions are: {', '.join(DISTRIBUTIONS)}"
    return ""
