"""One file of named arrays, which is replaced whole or not at all.

A NumPy archive (.npz: a zip of .npy members, each with its CRC) is written beside the old one,
forced to the disk and put in its place, so that a kill at any moment leaves one or the other.
Nothing is pickled: reading executes nothing.
"""

from __future__ import annotations

import glob
import os
import zipfile
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from ssmppl.errors import ArgumentError


def write(file: Path, members: Iterable[tuple[str, np.ndarray]]) -> None:
    """Put these arrays in the place of what `file` held.

    Raises
    ------
    OSError : it cannot be written; `file` is then as it was.
    """
    beside = file.with_name(f"{file.name}.{os.getpid()}.part")
    try:
        with open(beside, "wb") as out:
            with zipfile.ZipFile(out, "w") as archive:
                for name, values in members:
                    with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                        np.lib.format.write_array(member, values, allow_pickle=False)
            out.flush()
            os.fsync(out.fileno())
        os.replace(beside, file)
    except BaseException:
        beside.unlink(missing_ok=True)
        raise
    sync_folder(file.parent)


def sync_folder(folder: Path) -> None:
    """Force new names in a folder to the disk, where folders can be opened for that."""
    try:
        handle = os.open(folder, os.O_RDONLY)
    except OSError:
        return
    try:
        os.fsync(handle)
    except OSError:  # some file systems do not
        pass
    finally:
        os.close(handle)


def clear(file: Path) -> None:
    """Take away what processes left that were killed in the middle of `write`."""
    if os.name != "posix":  # elsewhere nothing tells whether a process lives
        return
    for part in file.parent.glob(f"{glob.escape(file.name)}.*.part"):
        number = part.name.removesuffix(".part").rpartition(".")[2]
        if number.isdigit() and not _lives(int(number)):
            part.unlink(missing_ok=True)


def _lives(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):
        pass
    return True


def read(file: Path, what: str) -> dict[str, np.ndarray]:
    """All arrays by name. what : of what it should be a checkpoint, for messages.

    Raises
    ------
    ArgumentError : there is no such file, or it is none of `write`'s, or damaged.
    """
    try:
        with zipfile.ZipFile(file) as archive:
            return {n.removesuffix(".npy"): _member(archive, n) for n in archive.namelist()}
    except OSError as error:
        raise ArgumentError(
            f"the checkpoint {file} cannot be read: {error.strerror or error}",
            fix="give the path of a file that you may read",
        ) from error
    except (ValueError, KeyError, EOFError, zipfile.BadZipFile, NotImplementedError) as error:
        raise no_checkpoint(file, what, _damage(file)) from error


def _member(archive: zipfile.ZipFile, name: str) -> np.ndarray:
    with archive.open(name) as member:
        values = np.lib.format.read_array(member, allow_pickle=False)
        if member.read(1):
            raise ValueError("more than an array")
        return values


def _damage(file: Path) -> str:
    with open(file, "rb") as f:
        begin = f.read(2)
    if not begin:
        return "it is empty"
    return "it is damaged or cut short" if begin == b"PK" else "it holds something else"


def no_checkpoint(file: Path, what: str, why: str) -> ArgumentError:
    """The error about a file that is none."""
    return ArgumentError(
        f"{file} is no checkpoint of {what}: {why}",
        fix="give the path of one or of a file that does not exist yet, or delete it to start anew",
    )


def unwritable(file: Path, error: OSError) -> ArgumentError:
    """The error about a file that cannot be written."""
    return ArgumentError(
        f"the checkpoint {file} cannot be written: {error.strerror or error}",
        fix="give another path, or checkpoint=None",
    )
