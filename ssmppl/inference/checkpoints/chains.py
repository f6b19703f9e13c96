"""The checkpoint of `sample`: where its chains stand, what they drew, and how they were begun.

One archive (`archive.py`): a JSON text, the arrays of the states, the draws. It is written when it
is new, after each part of the pilot that runs before the chains, then now and then, and at the end.
A chain's state carries everything that its future depends on, and what the pilot found is kept, so
that a call which goes on from the file gives the draws of one that was never stopped, bit for bit:
with the same sources of this package and the same versions of what computes (others are refused),
on the same type of CPU (on another there is a warning: the chains are as good, their digits may
differ).

Draws beyond what should be held in memory go to a folder beside it (`spool.py`), from where the
result reads them.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import llvmlite.binding
import numpy as np

from ssmppl.errors import ArgumentError, warn
from ssmppl.inference.checkpoints.archive import clear, no_checkpoint, read, unwritable, write
from ssmppl.inference.checkpoints.codec import Codec, Store
from ssmppl.inference.checkpoints.origin import Origin, origin_of
from ssmppl.inference.checkpoints.spool import Spool
from ssmppl.inference.run.draws import Block, ChainDraws, Checkpoint, Standing, stack

SECONDS = 30.0  # between two writings, at least
SHARE = 0.03  # of the time that may go into writing
HELD = 2**27  # bytes of draws in memory, and in the archive, from which they go to the folder
HEADER, MORE = "sample", "where it stands"
WHAT = "`sample`"
KINDS = ("draws", "stats")


class CheckpointFile(Checkpoint):
    """The `Checkpoint` of a call of `sample`, as a file.

    path : the file, in a folder that exists. origin : of the call. seed : as in the call; None goes
    on with the random numbers of the file, if there is one. root : the random numbers of the call,
    where there is none. codec : of the states, and of what the pilot finds. draws : how many each
    chain is asked for.

    Raises
    ------
    ArgumentError : there can be no file, or there is one of something else; it is left as it is.
    """

    def __init__(
        self, path: str | os.PathLike[str], origin: Origin, seed: Any,
        root: np.random.SeedSequence, codec: Codec, draws: int,
    ):  # fmt: skip
        self.file, self.codec = _checked(path), codec
        self.report: dict[str, Any] | None = None
        self._pilot: dict[str, Any] = {}
        self._standings: list[Standing[Any]] | None = None  # without the draws of the spool
        self._spool = Spool(self.file.with_name(f"{self.file.name}.draws"), draws)
        self._draws = draws
        self._begun, self._before = time.perf_counter(), 0.0
        self._written, self._cost, self._failed = time.monotonic(), 0.0, False
        with_seed = replace(origin, plain={**origin.plain, "seed=": str(root.entropy)})
        clear(self.file)
        self._found = self._stat()
        if self._found is None:
            self.origin, self.entropy, self._cpu = with_seed, root.entropy, _cpu()
            try:
                self._write()
            except OSError as error:
                raise unwritable(self.file, error) from error
        else:
            self._take(origin if seed is None else with_seed)

    @property
    def root(self) -> np.random.SeedSequence:
        """The seed of all random numbers."""
        return np.random.SeedSequence(self.entropy)

    @property
    def seconds(self) -> float:
        """Seconds spent so far, in all calls."""
        return self._before + time.perf_counter() - self._begun

    def once(self, name: str, make: Callable[[], Any]) -> Any:
        """What `make` gives, or gave in an earlier call."""
        if name not in self._pilot:
            self._pilot[name] = make()
            self._try_to_write()
        return self._pilot[name]

    def finished(self, draws: int) -> bool:
        """Whether every chain has so many draws, those of the warmup included."""
        chains = self._standings
        return chains is not None and min(s.done for s in chains) >= draws

    # -- what the chains ask of it
    def standings(self) -> list[Standing[Any]] | None:
        """How far the chains have come."""
        return self._standings

    def due(self, chains: Sequence[Standing[Any]]) -> bool:
        """Whether it is time to write."""
        since = time.monotonic() - self._written
        if since > max(SECONDS, self._cost / SHARE):
            return True
        return not self._failed and _held(chains) > HELD

    def keep(self, chains: Sequence[Standing[Any]], last: bool = False) -> list[Standing[Any]]:
        """Write the chains as they stand, if they have moved; and as they are to go on.

        last : then all their draws are with them, those on disk as arrays that are read from there.
        """
        moved = [c.done for c in chains] != [c.done for c in self._standings or ()]
        self._standings = list(chains)
        rest = last and any(self._spool.counts) and _held(chains) > 0
        if moved or rest or self._failed:
            self._try_to_write(rest)
        if not last or not any(self._spool.counts):
            return self._standings
        return [replace(s, blocks=(self._spooled(i), *s.blocks))
                for i, s in enumerate(self._standings)]  # fmt: skip

    def stack(
        self, chains: Sequence[ChainDraws[Any]]
    ) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
        """As `runner.stack`; where draws are on disk, large variables are read from there."""
        n = len(next(iter(chains[0].draws.values())))
        if not 0 < n <= min(self._spool.counts, default=0):
            return stack(chains)
        out: dict[str, dict[str, np.ndarray]] = {kind: {} for kind in KINDS}
        for name in self._spool.variables:
            values = self._spool.view(name)[:, :n]
            kind, _, variable = name.partition("/")
            out[kind][variable] = values if values.nbytes > HELD else np.array(values)
        return out["draws"], out["stats"]

    def _spooled(self, chain: int) -> Block:
        own: dict[str, dict[str, np.ndarray]] = {kind: {} for kind in KINDS}
        for name in self._spool.variables:
            kind, _, variable = name.partition("/")
            own[kind][variable] = self._spool.view(name)[chain, : self._spool.counts[chain]]
        return Block(**own)

    def _spool_out(self) -> None:
        """All draws go to the disk, and out of memory."""
        assert self._standings is not None
        self._spool.append([_joined(s.blocks) for s in self._standings], self._draws)
        self._standings = [replace(s, blocks=()) for s in self._standings]

    # -- writing
    def _try_to_write(self, rest: bool = False) -> None:
        """A disk that is full ends no sampling: there is a warning, and another try later."""
        try:
            self._write(rest)
            self._failed = False
        except OSError as error:
            if not self._failed:
                warn(
                    f"the checkpoint {self.file} cannot be written: {error.strerror or error}. It "
                    "stays as it was. Sampling goes on, its draws in memory, and tries again later"
                )
            self._written, self._failed = time.monotonic(), True

    def _write(self, rest: bool = False) -> None:
        begin = time.monotonic()
        if self._stat() not in (None, self._found):
            raise OSError("another run has written it meanwhile")
        if rest or _held(self._standings or ()) > HELD:
            self._spool_out()
        write(self.file, self._members())
        self._spool.clear()
        self._found = self._stat()
        self._written = time.monotonic()
        self._cost = self._written - begin

    def _stat(self) -> tuple[int, ...] | None:
        """The figures by which a file is recognised; None: there is no file."""
        try:
            found = os.stat(self.file)
        except FileNotFoundError:
            return None
        return found.st_ino, found.st_mtime_ns, found.st_size

    def _members(self) -> Iterator[tuple[str, np.ndarray]]:
        store, chains = Store(), self._standings
        states = None
        if chains is not None:
            states = [[self.codec.encode(s.state, store), s.done] for s in chains]
        header = {
            "cpu": self._cpu, "seconds": self.seconds,
            "entropy": self.codec.encode(self.entropy, store),
            "pilot": self.codec.encode(self._pilot, store),
            "report": self.codec.encode(self.report, store), "chains": states,
            "spool": self._spool.as_json(),
        }  # fmt: skip
        yield HEADER, _as_bytes(self.origin.as_text())
        yield MORE, _as_bytes(json.dumps(header))
        yield from ((f"states/{kind}", values) for kind, values in store.members().items())
        for i, s in enumerate(chains or ()):
            yield from ((f"drawn/{i}/{name}", v) for name, v in _joined(s.blocks).items())

    # -- reading
    def _take(self, origin: Origin) -> None:
        """What the file holds, once it is one of this call."""
        arrays = read(self.file, WHAT)
        try:
            self.origin = origin_of(arrays.pop(HEADER).tobytes().decode())
            header = json.loads(arrays.pop(MORE).tobytes())
        except (KeyError, ValueError, TypeError, AttributeError) as error:
            raise no_checkpoint(self.file, WHAT, "it holds something else") from error
        origin.check(self.file, self.origin)
        try:
            self._decode(header, arrays)
        except (KeyError, ValueError, TypeError, IndexError, AttributeError) as error:
            raise no_checkpoint(self.file, WHAT, "its parts do not fit together") from error
        self._spool.check(self.file)
        if self._cpu != _cpu():
            warn(
                f"the checkpoint {self.file} was made on a CPU of type {self._cpu}, and this is "
                f"{_cpu()}: sampling resumes, but draws may differ in the last digits from those "
                "of an uninterrupted run"
            )

    def _decode(self, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> None:
        packed = {n.removeprefix("states/"): v for n, v in arrays.items() if n[:7] == "states/"}
        store, decode = Store(packed), self.codec.decode
        self._cpu, self._before = str(header["cpu"]), float(header["seconds"])
        self.entropy = decode(header["entropy"], store)
        self._pilot = decode(header["pilot"], store)
        self.report = decode(header["report"], store)
        if header["chains"] is None:
            return
        self._spool = Spool(self._spool.folder, *header["spool"])
        drawn: list[dict[str, dict[str, np.ndarray]]] = [
            {kind: {} for kind in KINDS} for _ in header["chains"]
        ]
        for name, values in arrays.items():
            if name.startswith("drawn/"):
                _, i, kind, variable = name.split("/", 3)
                drawn[int(i)][kind][variable] = values
        self._standings = [
            Standing(decode(state, store), int(done), (Block(**own),) if own["draws"] else ())
            for (state, done), own in zip(header["chains"], drawn, strict=True)
        ]


def _joined(blocks: Sequence[Block]) -> dict[str, np.ndarray]:
    """All their arrays, by kind and name."""
    out = {}
    for kind in KINDS:
        parts = [getattr(b, kind) for b in blocks]
        for name in parts[0] if parts else ():
            out[f"{kind}/{name}"] = np.concatenate([p[name] for p in parts])
    return out


def _held(chains: Sequence[Standing[Any]]) -> int:
    """Bytes of draws in memory."""
    total = 0
    for s in chains:
        if s.blocks:
            n = sum(len(next(iter(b.draws.values()))) for b in s.blocks)
            block = s.blocks[0]
            total += n * sum(v[0].nbytes for kind in KINDS for v in getattr(block, kind).values())
    return total


def _checked(path: str | os.PathLike[str]) -> Path:
    if not isinstance(path, str | os.PathLike):
        raise ArgumentError(f"checkpoint={path!r}", fix="give the path of a file, or None")
    file = Path(path)
    if file.is_dir():
        raise ArgumentError(
            f"the checkpoint {file} is a folder", fix=f"give a file: {file / 'sample.npz'}"
        )
    if not file.parent.is_dir():
        raise ArgumentError(
            f"the checkpoint {file} is in a folder that does not exist",
            fix=f"make the folder {file.parent}, or give another path",
        )
    return file


def _as_bytes(text: str) -> np.ndarray:
    return np.frombuffer(text.encode(), dtype=np.uint8)


def _cpu() -> str:
    return str(llvmlite.binding.get_host_cpu_name())
