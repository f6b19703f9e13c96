"""What is sent to other processes: pickled once here, unpickled once there; and models in pickles.

A model's distributions do not travel: what is sent is the trace, the expressions that they gave. Of
the user's functions only those travel that are called for every particle, `@ssm.primitive`, and
those that `diagnose` tries, `@ssm.effect`.
"""

from __future__ import annotations

import copyreg
import hashlib
import io
import pickle
import sys
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable
from typing import Any, Generic, TypeVar

from ssmppl.errors import Location, ModelError
from ssmppl.expressions.arrays import ExprArray, nodes_of, of_nodes
from ssmppl.expressions.expr import Expr, pack, unpack

try:
    import cloudpickle
except ImportError:  # Dask and loky bring it
    cloudpickle = None

Thing = TypeVar("Thing")

_own = threading.local()


class _Packer(pickle.Pickler if cloudpickle is None else cloudpickle.Pickler):  # type: ignore[misc]
    """Writes a number for each expression, of which all that is packed has one table: parts that
    expressions share, as those of a model and its derivatives do, are written once."""

    def __init__(self, file: io.BytesIO):
        super().__init__(file, pickle.HIGHEST_PROTOCOL)
        self.nodes: dict[Expr, int] = {}

    def persistent_id(self, thing: Any) -> int | None:
        return self.nodes.setdefault(thing, len(self.nodes)) if type(thing) is Expr else None

    def reducer_override(self, thing: Any) -> Any:
        if type(thing) is ExprArray:
            return of_nodes, (nodes_of(thing), thing.shape)
        return NotImplemented if cloudpickle is None else super().reducer_override(thing)


class _Unpacker(pickle.Unpickler):
    def __init__(self, file: io.BytesIO, nodes: list[Expr]):
        super().__init__(file)
        self.persistent_load = nodes.__getitem__  # type: ignore[method-assign]


def packed(value: Any) -> bytes:
    """Pickled: by cloudpickle where it is installed, so that what a notebook defines travels."""
    before = getattr(_own, "by_value", False)
    _own.by_value = cloudpickle is not None
    try:
        packer = _Packer(file := io.BytesIO())
        packer.dump(value)
        dumps = pickle.dumps if cloudpickle is None else cloudpickle.dumps
        content: bytes = dumps((*pack(packer.nodes), file.getvalue()), pickle.HIGHEST_PROTOCOL)
    finally:
        _own.by_value = before
    return content


def unpacked(content: bytes) -> Any:
    """What was packed; both picklers write what pickle reads."""
    table, places, body = pickle.loads(content)
    nodes = unpack(table)
    return _Unpacker(io.BytesIO(body), [nodes[i] for i in places]).load()


def digest_of(content: bytes) -> bytes:
    """What packed content is known by."""
    return hashlib.sha256(content).digest()


def holder_of(function: Callable[..., Any]) -> Any:
    """What a module has under a function's name, by which it can be pickled; None where the name
    means nothing to another process.

    A decorated function's name stands for what the decorator made. The names of a notebook or a
    script mean nothing to others: `packed` sends their functions themselves.
    """
    module = function.__module__
    if module == "__main__" and getattr(_own, "by_value", False):
        return None
    return getattr(sys.modules.get(module), function.__qualname__, None)


def reduced(thing: Any, state: dict[str, Any], functions: Iterable[Callable[..., Any]]) -> Any:
    """What `pickle` writes of something that holds a user's functions: `__reduce_ex__`.

    Functions that another process finds by their names go by these, as `pickle` sends all. Others
    (lambdas, functions of a notebook, a script or another function, and several of one name) are
    sent themselves, by cloudpickle.

    Raises
    ------
    ModelError : there is such a function and no cloudpickle; names it.
    """
    inside = getattr(_own, "reducing", False)  # a function of it refers to the thing itself
    own = [f for f in functions if inside or not _found_by_name(f)]
    if inside or not own:
        return copyreg.__newobj__, (type(thing),), state  # type: ignore[attr-defined]
    if cloudpickle is None:
        if all(_found_by_name(f, script=True) for f in own):  # where the same script is run
            return copyreg.__newobj__, (type(thing),), state  # type: ignore[attr-defined]
        code = own[0].__code__
        raise ModelError(
            f"a model cannot be pickled with {own[0].__qualname__!r}, which has no name that "
            "another process would find it by",
            fix="pip install cloudpickle, with which it can; or define the model's functions by "
            "def, under different names, at the top level of a module",
            where=Location(code.co_filename, code.co_firstlineno, own[0].__name__),
        )
    _own.reducing = True
    try:
        return _rebuilt, (type(thing), packed(state))
    finally:
        _own.reducing = False


def _rebuilt(kind: type[Thing], content: bytes) -> Thing:
    made = kind.__new__(kind)
    state = unpacked(content)
    if hasattr(made, "__setstate__"):
        made.__setstate__(state)
    else:
        made.__dict__.update(state)
    return made


def _found_by_name(function: Callable[..., Any], script: bool = False) -> bool:
    """script : whether the names of the script that runs count."""
    found: Any = sys.modules.get(function.__module__)
    if function.__module__ == "__main__" and not script:
        return False
    for name in function.__qualname__.split("."):
        found = getattr(found, name, None)
    return found is function


class UnpackedCache(Generic[Thing]):
    """The last things that were unpacked in this process, by digest."""

    def __init__(self, most: int):
        self.most = most
        self._things: OrderedDict[bytes, Thing] = OrderedDict()
        self._lock = threading.RLock()

    def get(self, digest: bytes, make: Callable[[], Thing] | None = None) -> Thing | None:
        """The thing of this digest, made where it is not known; by one thread, once."""
        with self._lock:
            if digest not in self._things:
                if make is None:
                    return None
                self.put(digest, make())
            self._things.move_to_end(digest)
            return self._things[digest]

    def put(self, digest: bytes, thing: Thing) -> None:
        """Remember a thing, and forget the one that was asked for longest ago."""
        with self._lock:
            self._things[digest] = thing
            while len(self._things) > self.most:
                self._things.popitem(last=False)
