import json
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def exact_values():
    """Reference results that do not come from this package; see tests/reference/README.md."""
    path = Path(__file__).parent / "reference" / "exact_values.json"
    return json.loads(path.read_text(encoding="utf-8"))
