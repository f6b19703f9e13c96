import gc
import json
import os
import signal
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings
from hypothesis.internal.conjecture import providers

# How long examples take to draw depends on what else the machine does: no test is timed.
settings.register_profile("untimed", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("untimed")

# Hypothesis reads every module that the process has loaded for constants to try as values: 400 of
# the package and one for each compiled model, so that it tries others in each process.
if hasattr(providers, "_get_local_constants"):
    providers._get_local_constants = lambda: providers._local_constants

# The suite's own processes keep the processors busy.
os.environ.setdefault("SSMPPL_ONE_COMPILER", "1")

# A shell without job control starts its background jobs with Ctrl-C ignored; the tests of
# interrupts would wait for ever.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_finish(session):
    """What is there when the tests begin, a million objects, stays: the collector of garbage need
    not go through it again and again."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 20, 50)


@pytest.fixture(scope="session")
def exact_values():
    """Reference results that do not come from this package; see tests/reference/README.md."""
    path = Path(__file__).parent / "reference" / "exact_values.json"
    return json.loads(path.read_text(encoding="utf-8"))
