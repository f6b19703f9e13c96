"""What follows from the answers of pip-audit; the answers are made up, in its JSON."""

import json

import pytest

from tests.packaging.audit import CONTROL, Verdict, canonical, verdict

CVE = {"id": "CVE-2019-11236", "fix_versions": ["1.24.3"], "aliases": [], "description": "-"}
KNOWN_TO_HAVE_ONE = {"name": CONTROL[0], "version": CONTROL[1], "vulns": [CVE]}


def sound(name):
    return {"name": name, "version": "1.0", "vulns": []}


def skipped(name):
    return {"name": name, "skip_reason": f"Dependency not found on PyPI: {name}"}


def judge(*dependencies, asked=("numpy", "typing-extensions"), status=0):
    return verdict(status, json.dumps({"dependencies": dependencies, "fixes": []}), "", asked)


def test_nothing_known():
    found = judge(sound("numpy"), sound("typing_extensions"), KNOWN_TO_HAVE_ONE, status=1)
    assert found == Verdict()
    assert found.status(no_answer_ok=False) == found.status(no_answer_ok=True) == 0


def test_a_known_vulnerability_fails_in_any_case():
    bad = {"name": "NumPy", "version": "1.0", "vulns": [CVE | {"id": "PYSEC-1"}, CVE]}
    for more in (
        [KNOWN_TO_HAVE_ONE, sound("typing-extensions")],
        [],
    ):  # the control answers, or not
        found = judge(bad, *more, status=1)
        assert found.known == (
            "numpy 1.0: PYSEC-1 (fixed in 1.24.3)",
            "numpy 1.0: CVE-2019-11236 (fixed in 1.24.3)",
        )
        assert found.status(no_answer_ok=True) == found.status(no_answer_ok=False) == 1


def test_a_mirror_without_advisories_is_no_clean_bill():
    # What pip-audit says, status 0, "No known vulnerabilities found", where versions answer 404 ...
    silent = judge(skipped("numpy"), skipped("typing-extensions"), skipped(CONTROL[0]))
    # ... and where a mirror serves the versions without their advisories.
    bare = judge(sound("numpy"), sound("typing-extensions"), sound(CONTROL[0]))
    for found in (silent, bare):
        assert not found.known
        assert len(found.unknown) == 1
        assert "no advisories at all" in found.unknown[0]
        assert found.status(no_answer_ok=True) == 0
        assert found.status(no_answer_ok=False) == 3


def test_a_package_that_was_not_looked_up_is_named():
    found = judge(sound("numpy"), skipped("typing-extensions"), KNOWN_TO_HAVE_ONE, status=1)
    assert found.unknown == ("typing-extensions: Dependency not found on PyPI: typing-extensions",)
    assert found.status(no_answer_ok=False) == 3
    forgotten = judge(sound("numpy"), KNOWN_TO_HAVE_ONE, status=1)
    assert forgotten.unknown == ("typing-extensions: no answer",)


@pytest.mark.parametrize(
    "messages",
    ["requests.exceptions.ConnectionError: Failed to resolve 'pypi.org'",
     "ERROR:pip_audit._cli:Could not connect to PyPI's vulnerability feed",
     "requests.exceptions.HTTPError: 503 Server Error"],
)  # fmt: skip
def test_no_connection_is_no_answer(messages):
    found = verdict(1, "", messages, ["numpy"])
    assert not found.known
    assert messages in found.unknown[0]
    assert found.status(no_answer_ok=True) == 0
    assert found.status(no_answer_ok=False) == 3


@pytest.mark.parametrize(
    ("status", "answer", "messages"),
    [(2, "", "pip-audit: error: unrecognized arguments: --spinner"),
     (1, "", "ModuleNotFoundError: No module named 'pip_audit'"),
     (1, "[]", "something else"),
     (2, "", "usage: ... ConnectionError is only a word here")],
)  # fmt: skip
def test_an_audit_that_did_not_run_is_no_missing_answer(status, answer, messages):
    with pytest.raises(RuntimeError, match=f"ended with status {status}"):
        verdict(status, answer, messages, ["numpy"])


def test_names_are_compared_as_indices_do():
    assert canonical("typing_Extensions") == canonical("typing.extensions") == "typing-extensions"
