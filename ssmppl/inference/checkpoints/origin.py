"""What numbers were computed from: digests of model, data and sources; versions; plain settings."""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from ssmppl.data import Experiment
from ssmppl.errors import ArgumentError
from ssmppl.expressions.expr import Expr, topological
from ssmppl.language.distributions import Distribution
from ssmppl.language.distributions.from_density import UserDefined
from ssmppl.language.model.trace import Site, Trace
from ssmppl.language.user_defined.primitive import Opaque

# What the digits of draws depend on besides this package: compilers, random number generators,
# special functions, factorisations.
LIBRARIES = ("numpy", "scipy", "numba", "llvmlite")
PLURAL = ("data", "settings")


@dataclass(frozen=True)
class Origin:
    """digests : by what they are of, and which tell no more than that something differs. plain :
    texts that a message can show, by names such as "chains=" or "numpy"."""

    digests: Mapping[str, str]
    plain: Mapping[str, str] = field(default_factory=dict)

    def as_text(self) -> str:
        """JSON, as `origin_of` takes it."""
        return json.dumps({"digests": dict(self.digests), "plain": dict(self.plain)})

    def check(self, file: Path, was: Origin) -> None:
        """Refuse a checkpoint that was made from something else.

        Raises
        ------
        ArgumentError : names all that differs.
        """
        other = [
            f"{'other' if k in PLURAL else 'another'} {k}"
            for k, v in self.digests.items() if was.digests.get(k) != v
        ]  # fmt: skip
        for k, v in self.plain.items():
            if was.plain.get(k) != v:
                found = f"{k}{'' if k.endswith('=') else ' '}{was.plain.get(k, 'nothing')}"
                other.append(f"{found} (now {v})")
        if other:
            listed = " and ".join(filter(None, [", ".join(other[:-1]), other[-1]]))
            raise ArgumentError(
                f"the checkpoint {file} was made with {listed}",
                fix="give another path, or delete it to start anew",
            )


def origin_of(text: str) -> Origin:
    """The origin that `as_text` wrote.

    Raises
    ------
    ValueError : it is none.
    """
    parts = json.loads(text)
    if not isinstance(parts, dict) or set(parts) != {"digests", "plain"}:
        raise ValueError("no origin")
    return Origin(**{k: {str(n): str(v) for n, v in dict(p).items()} for k, p in parts.items()})


def digest(*parts: str) -> str:
    """A digest of texts."""
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:20]


def text_of(value: Any) -> str:
    """A setting as a text that is the same wherever its value is."""
    if isinstance(value, Mapping):
        return ", ".join(f"{k}: {text_of(v)}" for k, v in sorted(value.items()))
    return repr(value.tolist()) if isinstance(value, np.ndarray) else repr(value)


def data_digest(experiments: Sequence[Experiment]) -> str:
    """A digest of measurements, gaps, inputs and labels of rows."""
    return digest(*(_data(e) for e in experiments))


def _data(e: Experiment) -> str:
    own = hashlib.sha256()
    for values in (e.y, e.seen, e.u):
        own.update(repr(values.shape).encode())
        own.update(np.ascontiguousarray(values).tobytes())
    own.update(repr(None if e.time is None else [str(t) for t in e.time]).encode())
    return own.hexdigest()


def model_digest(trace: Trace) -> str:
    """A digest of distributions and expressions, without where they were written."""
    lines = [trace.name, repr(trace.inputs)]
    lines += [repr(trace.time_step)] if trace.time_step else []
    roots: list[Expr] = []
    for role in ("parameters", "initial", "transition", "observations", "proposal"):
        for name, site in getattr(trace, role).items():
            lines.append(f"{role} {name} {site.shape} {_law(site.distribution)}")
            roots += _roots(site)
    number: dict[Expr, int] = {}
    for e in topological(roots):
        number[e] = len(number)
        data = e.data.key if isinstance(e.data, Opaque) else repr(e.data)
        lines.append(f"{e.op} {data} {[number[a] for a in e.args]}")
    lines.append(repr([number[e] for e in roots]))
    return digest("\n".join(lines))


def _law(law: Distribution) -> str:
    """What its expressions are of: Normal(x, sd=a) and Normal(x, variance=a) hold the same."""
    parts = [type(law).__name__, repr(law.shape), *law.parameters, *map(_law, law.inside())]
    if isinstance(law, UserDefined):
        parts += [repr(law.bounds), repr(law.patterns.tolist()),
                  repr([(pattern, *forms) for pattern, forms in law.forms.items()])]  # fmt: skip
    return f"({' '.join(parts)})"


def _roots(site: Site) -> list[Expr]:
    return [*site.value.ravel(), *site.distribution.expressions()]


@cache
def sources_digest(*folders: str) -> str:
    """A digest of the sources that numbers come from, by folder of the package."""
    package = Path(__file__).parents[2]
    return digest(*(f.read_text(encoding="utf-8") for folder in folders
                    for f in sorted((package / folder).rglob("*.py"))))  # fmt: skip


def versions() -> dict[str, str]:
    """Versions of this package, by its sources, and of all else that the digits depend on."""
    own = sources_digest("expressions", "language", "data", "analysis", "codegen", "inference")
    return {
        "ssmppl": f"{_version('ssmppl')} (sources {own[:8]})",
        "Python": ".".join(platform.python_version_tuple()[:2]),
        **{name: _version(name) for name in LIBRARIES},
    }


def _version(distribution: str) -> str:
    try:
        return version(distribution)
    except PackageNotFoundError:
        return "unknown"
