"""Draws on disk as they come, read as arrays that need no memory.

A folder with a file of plain numbers for each variable, (chain, draw, ...), with room for the draws
that are asked for. What counts is never written again: a checkpoint says how many draws of each
chain do, and what else there is (after a kill, or a full disk) is written over. Where more draws
are asked for later, files with more room take the place of the old.
"""

from __future__ import annotations

import contextlib
import os
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ssmppl.errors import ArgumentError
from ssmppl.inference.checkpoints.archive import sync_folder

PIECE = 2**24  # bytes that are read at once


class Spool:
    """room : draws of a chain that files have room for. counts : draws that each chain has.
    variables : by name [dtype, shape of a draw, checksum of each chain]."""

    def __init__(
        self, folder: Path, room: int, counts: Sequence[int] = (),
        variables: Mapping[str, list[Any]] | None = None,
    ):  # fmt: skip
        self.folder, self.room, self.counts = folder, room, list(counts)
        self.variables = {n: list(v) for n, v in (variables or {}).items()}

    def as_json(self) -> list[Any]:
        """What `__init__` takes after the folder."""
        return [self.room, self.counts, self.variables]

    def append(self, chains: Sequence[Mapping[str, np.ndarray]], draws: int) -> None:
        """More draws of each chain: arrays (n, ...) by name, of n draws each, or nothing.

        draws : of a chain that may come, all in all.

        Raises
        ------
        OSError : they cannot be written; those of before count.
        """
        before = self.counts or [0] * len(chains)
        after = [
            n + len(next(iter(own.values()), ())) for n, own in zip(before, chains, strict=True)
        ]
        known = {name: [kind, shape, list(sums)] for name, (kind, shape, sums) in
                 self.variables.items()}  # fmt: skip
        try:
            if not self.folder.is_dir():
                self.folder.mkdir()
                sync_folder(self.folder.parent)
            if max(after) > self.room:
                self._make_room(draws if max(after) <= draws else max(*after, 2 * self.room))
            for name in dict.fromkeys(name for own in chains for name in own):
                places = []
                for i, own in enumerate(chains):
                    if name not in own:
                        continue
                    kind, shape = own[name].dtype.str, list(own[name].shape[1:])
                    entry = known.setdefault(name, [kind, shape, [0] * len(chains)])
                    if entry[:2] != [kind, shape]:
                        raise AssertionError(f"{name} changed its type")
                    content, size = _bytes(own[name]), _size(kind, shape)
                    places.append(((i * self.room + before[i]) * size, content))
                    entry[2][i] = zlib.crc32(content, entry[2][i])
                self._put(name, places, len(chains) * self.room * size)
            sync_folder(self.folder)
        except OSError:
            if not any(before):
                self.clear()
            raise
        self.variables, self.counts = known, after

    def view(self, name: str) -> np.ndarray:
        """(chain, room, ...), read from disk where it is looked at; not to be written to."""
        kind, shape, _ = self.variables[name]
        whole = (len(self.counts), self.room, *shape)
        if not _size(kind, shape):
            return np.empty(whole, dtype=kind)
        return np.memmap(self.file(name), dtype=kind, mode="r", shape=whole)

    def check(self, of: Path) -> None:
        """Whether all is there as it was written. of : the checkpoint that says so.

        Raises
        ------
        ArgumentError : what is not.
        """
        for name in self.variables:
            try:
                fault = self._fault(name)
            except OSError as error:
                fault = f"cannot be read: {error.strerror or error}"
            if fault:
                raise ArgumentError(
                    f"the checkpoint {of} keeps draws in the folder {self.folder}, of which "
                    f"{self.file(name).name} {fault}",
                    fix="put the folder back as it was beside the checkpoint, or delete both to "
                    "start anew",
                )

    def _fault(self, name: str) -> str:
        kind, shape, checksums = self.variables[name]
        size = _size(kind, shape)
        if not size:
            return ""
        with open(self.file(name), "rb") as f:
            missing = len(self.counts) * self.room * size - os.fstat(f.fileno()).st_size
            if missing > 0:
                return f"lacks {missing} bytes"
            for i, (count, checksum) in enumerate(zip(self.counts, checksums, strict=True)):
                f.seek(i * self.room * size)
                left, found = count * size, 0
                while left and (piece := f.read(min(left, PIECE))):
                    found, left = zlib.crc32(piece, found), left - len(piece)
                if left or found != checksum:
                    return "is damaged"
        return ""

    def file(self, name: str, room: int | None = None) -> Path:
        """Where a variable is."""
        return self.folder / f"{name.replace('/', ' ')} {self.room if room is None else room}.raw"

    def clear(self) -> None:
        """Take away what does not count."""
        counting = {self.file(name) for name in self.variables if any(self.counts)}
        with contextlib.suppress(OSError):
            for file in self.folder.glob("*.raw"):
                if file not in counting:
                    file.unlink()
            if not counting:
                self.folder.rmdir()

    def _make_room(self, room: int) -> None:
        """Files for more draws, with those that count. The old files stay until `clear`."""
        old = self.room
        self.room = room
        try:
            for name, (kind, shape, _) in self.variables.items():
                size = _size(kind, shape)
                for i, count in enumerate(self.counts):
                    with open(self.file(name, old), "rb") as f:
                        for at in range(0, count * size, PIECE):
                            f.seek(i * old * size + at)
                            piece = f.read(min(PIECE, count * size - at))
                            place = i * room * size + at
                            self._put(name, [(place, piece)], len(self.counts) * room * size)
        except OSError:
            self.room = old
            raise

    def _put(self, name: str, places: Sequence[tuple[int, Any]], whole: int) -> None:
        """(where, bytes) into a file of so many."""
        file = self.file(name)
        with open(file, "r+b" if file.exists() else "w+b", buffering=0) as f:
            if os.fstat(f.fileno()).st_size != whole:
                f.truncate(whole)
            for at, content in places:
                f.seek(at)
                left = memoryview(content)
                while left:
                    left = left[f.write(left) :]
            os.fsync(f.fileno())


def _bytes(values: np.ndarray) -> Any:
    return np.ascontiguousarray(values).data.cast("B") if values.size else b""


def _size(kind: str, shape: Sequence[int]) -> int:
    """Bytes of a draw."""
    return int(np.prod(shape, dtype=int)) * np.dtype(kind).itemsize
