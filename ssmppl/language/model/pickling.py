"""What is sent to other processes: pickled once here, unpickled once there.

A model's distributions do not travel: what is sent is the trace, the expressions that they gave. Of
the user's functions only those travel that are called for every particle, `@ssm.primitive`, and
those that `diagnose` tries, `@ssm.effect`.
"""

from __future__ import annotations

import hashlib
import pickle
import sys
import threading
from collections import OrderedDict
from collections.abc import Callable
from typing import Any, Generic, TypeVar

try:
    import cloudpickle
except ImportError:  # Dask and loky bring it
    cloudpickle = None

Thing = TypeVar("Thing")

_own = threading.local()


def packed(value: Any) -> bytes:
    """Pickled: by cloudpickle where it is installed, so that what a notebook defines travels."""
    if cloudpickle is None:
        return pickle.dumps(value, pickle.HIGHEST_PROTOCOL)
    before = getattr(_own, "by_value", False)
    _own.by_value = True
    try:
        content: bytes = cloudpickle.dumps(value)
    finally:
        _own.by_value = before
    return content


def unpacked(content: bytes) -> Any:
    """What was packed; both picklers write what pickle reads."""
    return pickle.loads(content)


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
