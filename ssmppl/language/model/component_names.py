"""Names of the components of vectors and matrices: dims and their coordinates, as xarray has them.

A model says them once, `ssm.Model(coords={"season": [...]}, dims={"effect": ["season"]})`, and all
results have them in place of `effect_dim_0` and 0, 1, 2, ...
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ssmppl.errors import Location, ModelError, listing

Shapes = Mapping[str, tuple[int, ...]]

# Dims that results have of their own.
TAKEN = {
    "chain", "draw", "time", "trajectory", "state", "state_", "quantile", "particle", "experiment",
}  # fmt: skip


@dataclass(frozen=True)
class ComponentNames:
    """dims : of a quantity, one for each of its axes. coords : the labels along a dim."""

    dims: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    coords: Mapping[str, tuple[Any, ...]] = field(default_factory=dict)

    @classmethod
    def of(cls, dims: Any, coords: Any, where: Location) -> ComponentNames:
        """As a model gives them.

        Raises
        ------
        ModelError : they are no mappings of names to names and of dims to labels.
        """
        found: dict[str, tuple[str, ...]] = {}
        for name, own in _mapping("dims", dims, '{"effect": ["season"]}', where).items():
            axes = (own,) if isinstance(own, str) else own
            if not isinstance(axes, Sequence) or not all(isinstance(d, str) for d in axes):
                raise ModelError(
                    f"dims of {name!r} are {own!r}",
                    fix="give a list of names, one for each axis",
                    where=where,
                )
            for d in axes:
                if not d.isidentifier() or d in TAKEN or d.startswith("time_"):
                    raise ModelError(
                        f"a dim of {name!r} is named {d!r}"
                        + (", which results have of their own" if d.isidentifier() else ""),
                        fix="choose another name, of letters, digits and _",
                        where=where,
                    )
            if len(set(axes)) < len(axes):
                raise ModelError(
                    f"dims of {name!r} are {list(axes)!r}: a dim twice",
                    fix=f"name the axes apart, as {axes[0]!r} and {axes[0] + '_other'!r}",
                    where=where,
                )
            found[name] = tuple(axes)
        labels: dict[str, tuple[Any, ...]] = {}
        used = sorted({d for axes in found.values() for d in axes})
        for d, values in _mapping("coords", coords, '{"season": ["w", "s"]}', where).items():
            if d not in used:
                raise ModelError(
                    f"coords has labels of {d!r}, which is no dim of any quantity",
                    fix=f'name it in dims=, {{"effect": [{d!r}]}}'
                    + (f"; dims are {listing(d, used)}" if used else ""),
                    where=where,
                )
            array = np.asarray(values)
            if array.ndim != 1 or isinstance(values, str):
                raise ModelError(
                    f"coords of {d!r} are {values!r}",
                    fix="give a list of labels, one for each component",
                    where=where,
                )
            if len(set(array.tolist())) < len(array):
                raise ModelError(
                    f"coords of {d!r} hold a label twice: {list(values)!r}",
                    fix="give each component a label of its own",
                    where=where,
                )
            labels[d] = tuple(array.tolist())
        return cls(found, labels)

    def with_axis(
        self, names: Iterable[str], dim: str, labels: tuple[Any, ...], shapes: Shapes
    ) -> ComponentNames:
        """With `dim` before the axes of these quantities, which have it already in `shapes`."""
        dims = dict(self.dims)
        for n in names:
            rest = tuple(f"{n}_dim_{k}" for k in range(1, len(shapes[n])))
            dims[n] = (dim, *self.dims.get(n, rest))
        return ComponentNames(dims, {**self.coords, dim: labels})

    def labels(self, name: str) -> tuple[Any, ...]:
        """Of the components of a vector; empty where it has none, or several axes."""
        axes = self.dims.get(name, ())
        return self.coords.get(axes[0], ()) if len(axes) == 1 else ()

    def check(self, shapes: Shapes, where: Location) -> None:
        """Hold them against the shapes of the model's quantities.

        Raises
        ------
        ModelError : a name is no quantity, or numbers of axes, components or labels differ.
        """
        sizes: dict[str, tuple[int, str]] = {}
        for name, axes in self.dims.items():
            if name not in shapes:
                raise ModelError(
                    f"dims names {name!r}, which the model does not have",
                    fix=f"use one of: {listing(name, list(shapes))}",
                    where=where,
                )
            shape = shapes[name]
            if len(axes) != len(shape):
                raise ModelError(
                    f"{name!r} has shape {shape}, and {len(axes)} dims: {list(axes)!r}",
                    fix=f"give {len(shape)}, one for each axis"
                    if shape
                    else "leave it out of dims=: it is one number",
                    where=where,
                )
            for d, size in zip(axes, shape, strict=True):
                if d in shapes:
                    raise ModelError(
                        f"the dim {d!r} of {name!r} is also a quantity of the model",
                        fix=f"rename the dim, as {d + '_name'!r}",
                        where=where,
                    )
                if d in self.coords and len(self.coords[d]) != size:
                    raise ModelError(
                        f"{name!r} has {size} components along {d!r}, coords has "
                        f"{len(self.coords[d])} labels: {list(self.coords[d])!r}",
                        fix="give one label for each component",
                        where=where,
                    )
                first, other = sizes.setdefault(d, (size, name))
                if size != first:
                    raise ModelError(
                        f"{name!r} has {size} components along {d!r}, {other!r} has {first}",
                        fix="name two dims",
                        where=where,
                    )

    @property
    def renamed(self) -> dict[str, str]:
        """The dims that results would have without names -> these."""
        return {
            f"{name}_dim_{k}": d for name, axes in self.dims.items() for k, d in enumerate(axes)
        }

    def label(self, name: str, index: Sequence[int]) -> str:
        """A component in words: `effect[winter]`, by its numbers where it has no labels."""
        axes = self.dims.get(name, ())
        at = [
            str(self.coords[axes[k]][i]) if k < len(axes) and axes[k] in self.coords else str(i)
            for k, i in enumerate(index)
        ]
        return f"{name}[{', '.join(at)}]" if at else name


def _mapping(what: str, given: Any, example: str, where: Location) -> Mapping[str, Any]:
    if given is None:
        return {}
    if not isinstance(given, Mapping) or not all(isinstance(k, str) for k in given):
        raise ModelError(
            f"{what} is {given!r}", fix=f"give a dictionary, {what}={example}", where=where
        )
    return given
