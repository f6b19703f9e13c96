"""Keep the records of one half in one file, so that a run that takes hours goes on elsewhere.

    python -m bench.gap.archive pack --half sealed     # cache/ -> sealed_records.tar.gz
    python -m bench.gap.archive unpack --half sealed   # and back

Records hold what a method said, no answers; packing opens neither. The file is the same for the
same records.
"""

from __future__ import annotations

import argparse
import gzip
import io
import tarfile
from pathlib import Path

from bench.gap.plan import SPLIT
from bench.gap.records import CACHE, HERE
from bench.gap.run import selected


def archive_of(half: str) -> Path:
    return HERE / f"{half}_records.tar.gz"


def pack(half: str, cache: Path = CACHE, path: Path | None = None) -> int:
    """The number of records packed."""
    ids = set(selected(half))
    found = sorted(p for p in cache.rglob("*.json") if p.stem in ids)
    text = io.BytesIO()
    with tarfile.open(fileobj=text, mode="w", format=tarfile.PAX_FORMAT) as tar:
        for p in found:
            content = p.read_bytes()
            entry = tarfile.TarInfo(p.relative_to(cache).as_posix())
            entry.size = len(content)
            tar.addfile(entry, io.BytesIO(content))
    (path or archive_of(half)).write_bytes(gzip.compress(text.getvalue(), mtime=0))
    return len(found)


def unpack(half: str, cache: Path = CACHE, path: Path | None = None) -> int:
    """The number of records that were not there."""
    new = 0
    with tarfile.open(path or archive_of(half)) as tar:
        for entry in tar:
            target, content = cache / entry.name, tar.extractfile(entry)
            if content is None or target.exists():
                continue
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(content.read())
            new += 1
    return new


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=["pack", "unpack"])
    parser.add_argument("--half", choices=list(SPLIT["halves"]), required=True)
    options = parser.parse_args()
    done = pack(options.half) if options.what == "pack" else unpack(options.half)
    print(f"{done} records {options.what}ed")


if __name__ == "__main__":
    main()
