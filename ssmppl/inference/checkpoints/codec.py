"""Nested states as JSON and arrays, and back, bit for bit.

A state is made of arrays, numbers, texts, None, tuples, lists, mappings, random generators and
dataclasses of all these. Reading builds dataclasses of a given list and nothing else: a file names
what it holds, and cannot name what is run.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

BIT_GENERATORS = {"PCG64": np.random.PCG64}  # what np.random.default_rng gives


class Store:
    """Arrays of all shapes in few: one after the other, those of a type in one.

    packed : what `members` gave, by type.
    """

    def __init__(self, packed: Mapping[str, np.ndarray] | None = None):
        self.packed = packed or {}
        self._parts: dict[str, list[np.ndarray]] = {}
        self._sizes: dict[str, int] = {}

    def put(self, values: np.ndarray) -> list[Any]:
        """Take an array in; returns where it is.

        Raises
        ------
        TypeError : it is of objects.
        """
        if values.dtype.hasobject:
            raise TypeError(f"an array of {values.dtype} in a state that is to be kept")
        kind, order = values.dtype.str, "C" if values.flags.c_contiguous else "F"
        if order == "F" and not values.flags.f_contiguous:
            order = "C"
        at = self._sizes.get(kind, 0)
        self._parts.setdefault(kind, []).append(values.ravel(order))  # type: ignore[arg-type]
        self._sizes[kind] = at + values.size
        return [kind, at, list(values.shape), order]

    def get(self, where: list[Any]) -> np.ndarray:
        """The array that was put there: its own memory, laid out as it was."""
        kind, at, shape, order = where
        size = int(np.prod(shape, dtype=int))
        flat = self.packed[kind][at : at + size]
        return flat.reshape(shape, order=order).copy(order=order)

    def members(self) -> dict[str, np.ndarray]:
        """All that was put, by type."""
        return {kind: np.concatenate(parts) for kind, parts in self._parts.items()}


class Codec:
    """classes : the dataclasses that may stand in a state."""

    def __init__(self, classes: Sequence[type]):
        self.classes = {_name(c): c for c in classes}

    def encode(self, value: Any, store: Store) -> Any:
        """JSON for a value; its arrays are put into the store.

        Raises
        ------
        TypeError : it holds what no state may.
        """
        if value is None or isinstance(value, bool | int | float | str):
            if isinstance(value, np.generic):  # np.float64 is a float too
                return {"number": store.put(np.asarray(value))}
            return value
        if isinstance(value, np.ndarray):
            return {"array": store.put(value)}
        if isinstance(value, np.generic):
            return {"number": store.put(np.asarray(value))}
        if isinstance(value, np.random.Generator):
            bits = value.bit_generator
            return {"generator": type(bits).__name__, "at": self.encode(bits.state, store)}
        if isinstance(value, tuple):
            return {"tuple": [self.encode(v, store) for v in value]}
        if isinstance(value, list):
            return [self.encode(v, store) for v in value]
        if isinstance(value, Mapping):
            pairs = [[self.encode(k, store), self.encode(v, store)] for k, v in value.items()]
            return {"mapping": pairs}
        name = _name(type(value))
        if is_dataclass(value) and self.classes.get(name) is type(value):
            own = {f.name: self.encode(getattr(value, f.name), store) for f in fields(value)}
            return {"class": name, "fields": own}
        raise TypeError(f"a {name} in a state that is to be kept")

    def decode(self, node: Any, store: Store) -> Any:
        """The value of what `encode` gave.

        Raises
        ------
        ValueError, TypeError, KeyError, IndexError : nothing that it gives.
        """
        if isinstance(node, list):
            return [self.decode(v, store) for v in node]
        if not isinstance(node, dict):
            return node
        if "array" in node:
            return store.get(node["array"])
        if "number" in node:
            return store.get(node["number"])[()]
        if "tuple" in node:
            return tuple(self.decode(v, store) for v in node["tuple"])
        if "mapping" in node:
            return {self.decode(k, store): self.decode(v, store) for k, v in node["mapping"]}
        if "generator" in node:
            bits = BIT_GENERATORS[node["generator"]](0)
            bits.state = self.decode(node["at"], store)
            return np.random.Generator(bits)
        own = {k: self.decode(v, store) for k, v in node["fields"].items()}
        return self.classes[node["class"]](**own)


def _name(of: type) -> str:
    return f"{of.__module__.rpartition('.')[2]}.{of.__name__}"
