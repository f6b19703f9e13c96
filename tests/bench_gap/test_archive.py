"""Records of a half, packed and unpacked."""

from __future__ import annotations

from bench.gap.archive import pack, unpack
from bench.gap.run import selected


def test_records_of_the_half_come_back_and_others_are_left(tmp_path):
    mine, other = selected("sealed")[0], selected("tuning")[0]
    for id in (mine, other):
        (tmp_path / "cache" / "diagnose" / "d1").mkdir(parents=True, exist_ok=True)
        (tmp_path / "cache" / "diagnose" / "d1" / f"{id}.json").write_text(f'{{"id": "{id}"}}')
    archive = tmp_path / "sealed.tar.gz"
    assert pack("sealed", tmp_path / "cache", archive) == 1
    first = archive.read_bytes()
    assert unpack("sealed", tmp_path / "new", archive) == 1
    (found,) = (tmp_path / "new").rglob("*.json")
    assert found.relative_to(tmp_path / "new").as_posix() == f"diagnose/d1/{mine}.json"
    assert found.read_text() == f'{{"id": "{mine}"}}'
    assert unpack("sealed", tmp_path / "new", archive) == 0  # what is there stays
    pack("sealed", tmp_path / "new", archive)
    assert archive.read_bytes() == first
