"""A wheel for one Python and one platform: the pure wheel, with archives of machine code in it.

`pip` prefers it where it fits, and takes the pure one elsewhere: both hold the same Python files.
"""

from __future__ import annotations

import base64
import hashlib
import platform
import re
import zipfile
from collections.abc import Mapping
from pathlib import Path

PLATFORM = "manylinux_2_17_x86_64"  # the code asks nothing of the C library but libm and memory
FITS = (platform.system(), platform.machine()) == ("Linux", "x86_64")  # where it can be made
HOME = "ssmppl/codegen/store/machine_code"


def with_machine_code(pure: Path, archives: Mapping[str, bytes], python: str) -> Path:
    """Write the wheel for a Python, such as "3.11", beside the pure one, with these files, by name.

    Tags, names and RECORD are those of the specification of binary distributions (PyPA).
    """
    tag = f"cp{python.replace('.', '')}-none-{PLATFORM}"
    made = pure.with_name(pure.name.replace("py3-none-any", tag))
    if made == pure:
        raise ValueError(f"{pure.name} is no pure wheel")
    with zipfile.ZipFile(pure) as source, zipfile.ZipFile(made, "w") as target:
        (record,) = (n for n in source.namelist() if n.endswith(".dist-info/RECORD"))
        lines = []
        files = {item.filename: (item, source.read(item)) for item in source.infolist()}
        del files[record]
        for name, content in archives.items():
            files[f"{HOME}/{name}"] = (_item(f"{HOME}/{name}"), content)
        for name, (item, content) in files.items():
            if name.endswith(".dist-info/WHEEL"):
                text = re.sub(r"(?m)^Tag: .*$", f"Tag: {tag}", content.decode())
                content = text.replace("Root-Is-Purelib: true", "Root-Is-Purelib: false").encode()
            target.writestr(item, content, compress_type=zipfile.ZIP_DEFLATED)
            digest = base64.urlsafe_b64encode(hashlib.sha256(content).digest()).rstrip(b"=")
            lines.append(f"{name},sha256={digest.decode()},{len(content)}\n")
        lines.append(f"{record},,\n")
        target.writestr(_item(record), "".join(lines), compress_type=zipfile.ZIP_DEFLATED)
    return made


def _item(name: str) -> zipfile.ZipInfo:
    item = zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0))
    item.external_attr = 0o100644 << 16
    return item
