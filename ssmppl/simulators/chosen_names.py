"""Names in files of others: which of them are chosen, and as what they stand in a model."""

from __future__ import annotations

import importlib
import keyword
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from ssmppl.errors import ModelError, nearest_first
from ssmppl.expressions.expr import user_location

Chosen = str | Sequence[str] | Mapping[str, str] | None


def required(package: str, extra: str) -> Any:
    """A package that is an optional extra, imported.

    Raises
    ------
    ModelError : it is not installed; with the command that does.
    """
    try:
        return importlib.import_module(package)
    except ImportError as error:
        raise ModelError(
            f"ssm.simulators.{extra} needs the package {package}: {error}",
            fix=f"pip install 'ssmppl[{extra}]'",
            where=user_location(),
        ) from None


def identifier(name: str) -> str:
    """A name as it can stand before an equals sign: what cannot becomes an underscore."""
    word = "".join(c if c.isalnum() or c == "_" else "_" for c in name)
    if not word or word[0].isdigit() or keyword.iskeyword(word):
        word = f"_{word}" if word and word[0].isdigit() else f"{word}_"
    return word


def chosen(
    given: Chosen,
    known: Mapping[str, Sequence[str]],
    what: str,
    file: str,
    spelled: Callable[[str], str] = identifier,
) -> dict[str, str]:
    """Name in the model -> name in the file, for those of `known` that are asked for.

    Parameters
    ----------
    given : None for all; names of the file; or a mapping from a name in the model to one of the
        file.
    known : names of the file that can be asked for -> the columns that they stand for, one or
        several.
    what : of the argument, for messages. file : likewise.
    spelled : a column's name in the model, where none is given.

    Raises
    ------
    ModelError : a name that the file does not have, with those that it has.
    """
    if given is None:
        covered: set[str] = set()
        given = []
        for name, columns in known.items():
            if not covered.issuperset(columns):
                given.append(name)
                covered.update(columns)
    if isinstance(given, str):
        given = [given]
    pairs: Iterable[tuple[str | None, str]]
    pairs = given.items() if isinstance(given, Mapping) else ((None, n) for n in given)
    out: dict[str, str] = {}
    for own, name in pairs:
        if name not in known:
            raise unknown(what, name, known, file)
        columns = known[name]
        for k, column in enumerate(columns):
            title = spelled(column) if own is None else own if len(columns) == 1 else f"{own}_{k}"
            if title in out:
                raise ModelError(
                    f"{what}: {title!r} stands twice",
                    fix="give each a name of its own by a mapping, name -> name in the file",
                    where=user_location(),
                )
            out[title] = column
    return out


def unknown(what: str, name: object, known: Iterable[str], file: str) -> ModelError:
    """The error of a name that the file does not have."""
    names = nearest_first(name, known)
    listed = ", ".join(names[:40]) + (", ..." if len(names) > 40 else "")
    return ModelError(
        f"{what}: {file} has no {name!r}",
        fix=f"it has: {listed}" if names else "it has none; leave the argument out",
        where=user_location(),
    )
