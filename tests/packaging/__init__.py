"""The package as users get it: built, installed in clean environments, and used there.

    python -m tests.packaging              every Python found, every set of dependencies
    python -m tests.packaging.audit        known vulnerabilities of what an installation brings

Both need nothing but Python: they make environments of their own, in a temporary folder.

    project.py       what pyproject.toml says: lower bounds, the files of wheel and sdist
    environments.py  interpreters, environments, sets of dependencies
    smoke.py         what is run inside of an environment, with nothing of the source tree at hand
    user.py          a program of a user's, for a type checker
    audit.py         what pip-audit answers, and what follows from it
"""
