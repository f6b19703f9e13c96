"""The layers of the package, read from its sources: who may import whom, and when."""

import ast
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGE = "ssmppl"
LONGEST = 800  # lines of a module
MOST = 12  # modules of a room

# Each layer and what it may import besides itself. The main chain, in its one direction:
CHAIN = [
    "errors",
    "markup",
    "status",
    "arguments",
    "compiling",
    "expressions",
    "language",
    "analysis",
    "codegen",
]
ALLOWED = {layer: set(CHAIN[:i]) for i, layer in enumerate(CHAIN)}
# Arrays in, ArviZ out, and the embedded series stand beside it ...
ALLOWED["counts"] = {"errors"}
ALLOWED["data"] = {"counts", "errors", "expressions", "language"}
ALLOWED["results"] = {"errors"}
ALLOWED["tables"] = {"arguments", "errors", "results"}
ALLOWED["datasets"] = {"errors"}
# ... and serve what follows. Adapters make simulators of the language.
ALLOWED["simulators"] = {"errors", "expressions", "language"}
ALLOWED["structural"] = {"arguments", "compiling", "errors", "expressions", "language"}
ALLOWED["inference"] = {*CHAIN, "counts", "data", "results"}
ALLOWED["drawing"] = {"errors", "data"}
ALLOWED["diagnosis"] = ALLOWED["inference"] | {"inference", "drawing"}
ALLOWED["plots"] = ALLOWED["diagnosis"] | {"diagnosis", "structural", "tables"}
# What the command line is made of: the demonstration, written as a user would, and files read.
ALLOWED["demo"] = {PACKAGE, "datasets", "results"}
ALLOWED["modelfile"] = {"data", "errors", "language"}
OWN = {"plots", "datasets", "demo", "modelfile", "tables", PACKAGE}
ALLOWED["cli"] = ALLOWED["plots"] | OWN
ALLOWED["__main__"] = {"cli"}
# The package itself holds the public names: it may import all but those who are above it.
ALLOWED[PACKAGE] = set(ALLOWED) - {"demo", "cli", "__main__"}

# They fail beside another thread's in Python 3.11.
PARSERS = {"ast.parse", "ast.literal_eval", "ast.PyCF_ONLY_AST"}

SLOW = (
    "arviz", "matplotlib", "pandas", "scipy.linalg", "scipy.optimize", "scipy.sparse",
    "scipy.stats", "xarray",
)  # fmt: skip


def dotted_name(path):
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {dotted_name(path): path for path in sorted((ROOT / PACKAGE).rglob("*.py"))}


def layer_of(name):
    """Layer of a module: the first part of its name below the package."""
    parts = name.split(".")
    return parts[1] if len(parts) > 1 else PACKAGE


class Imports(ast.NodeVisitor):
    """Every imported name of a module, absolute, with its line and how it is imported."""

    def __init__(self, name, source, is_package=False):
        self.found = []  # (imported name, line, inside of a function, for type checking only)
        self._package = name.split(".") if is_package else name.split(".")[:-1]
        self._functions = self._typing = 0
        self.visit(ast.parse(source))

    def _add(self, imported, node):
        self.found.append((imported, node.lineno, self._functions > 0, self._typing > 0))

    def visit_Import(self, node):
        for alias in node.names:
            self._add(alias.name, node)

    def visit_ImportFrom(self, node):
        base = self._package[: len(self._package) - node.level + 1] if node.level else []
        base = ".".join([*base, *filter(None, [node.module])])
        for alias in node.names:
            self._add(f"{base}.{alias.name}", node)

    def visit_If(self, node):
        typing = "TYPE_CHECKING" in ast.unparse(node.test)
        self._typing += typing
        for child in node.body:
            self.visit(child)
        self._typing -= typing
        for child in node.orelse:
            self.visit(child)

    def _visit_function(self, node):
        self._functions += 1
        self.generic_visit(node)
        self._functions -= 1

    visit_FunctionDef = visit_AsyncFunctionDef = visit_Lambda = _visit_function


def within(name, package):
    return name == package or name.startswith(package + ".")


def beside_the_lock(name, source):
    """What parses, or makes generated code, and does not hold the lock of `ssmppl.compiling`."""
    for node in ast.walk(ast.parse(source)):
        place = f"{name}:{getattr(node, 'lineno', 0)}"
        if isinstance(node, ast.Attribute) and ast.unparse(node) in PARSERS:
            yield f"{place} uses {ast.unparse(node)}, and not ssmppl.compiling"
        if not isinstance(node, ast.FunctionDef):
            continue
        decorators = set(map(ast.unparse, node.decorator_list))
        if not decorators & {"cached_property", "cache", "lru_cache"}:
            continue
        made = [n.func for n in ast.walk(node) if isinstance(n, ast.Call)]
        made = [n.id for n in made if isinstance(n, ast.Name) and n.id.startswith("compile_")]
        if made:
            yield f"{place} calls {made[0]} where ssmppl.compiling has no lock"


def faults(name, source, is_package=False):
    """What a module does that the layout forbids."""
    layer = layer_of(name)
    if layer not in ALLOWED:
        yield f"{name}: the layer {layer!r} is not in the layout"
        return
    for imported, line, in_function, for_types in Imports(name, source, is_package).found:
        place = f"{name}:{line}"
        if within(imported, PACKAGE):
            target = layer_of(imported)
            if target not in ALLOWED:  # a name of the package itself
                target = PACKAGE
            if in_function:
                yield f"{place} imports {imported} inside of a function"
            if target != layer and target not in ALLOWED[layer]:
                yield f"{place} imports {imported}, which is not below {layer}"
        elif within(imported, "ast") and imported != "ast" and layer != "compiling":
            yield f"{place} imports {imported} by itself: ssmppl.compiling parses"
        elif layer == "analysis" and within(imported, "numba"):
            yield f"{place}: analyses do not import numba"
        elif not in_function and not for_types and any(within(imported, slow) for slow in SLOW):
            yield f"{place} imports {imported} at the top of the module, which is slow"
    if layer != "compiling":
        yield from beside_the_lock(name, source)
    if (length := len(source.splitlines())) > LONGEST:
        yield f"{name} has {length} lines; does it still have one reason to exist?"


@pytest.mark.parametrize("name", MODULES)
def test_module_keeps_to_the_layout(name):
    path = MODULES[name]
    source = path.read_text(encoding="utf-8")
    assert list(faults(name, source, path.name == "__init__.py")) == []


@pytest.mark.parametrize(
    ("name", "source"),
    [
        ("ssmppl.errors", "from ssmppl.expressions import expr"),
        ("ssmppl.expressions.expr", "import ssmppl.language.model.model"),
        ("ssmppl.expressions.expr", "from ..language import model"),
        ("ssmppl.analysis.structure", "from ssmppl import codegen"),
        ("ssmppl.language.model.model", "from ssmppl import Model"),
        ("ssmppl.language.model.model", "if TYPE_CHECKING:\n    from ssmppl.analysis import plan"),
        ("ssmppl.codegen.modules.program", "from ssmppl import data"),
        ("ssmppl.results", "from ssmppl.data import read"),
        ("ssmppl.inference.chains.pgas", "def f():\n    from ssmppl.codegen import program"),
        ("ssmppl.inference.chains.pgas", "f = lambda: __import__\nclass A:\n  import ssmppl.cli"),
        ("ssmppl.analysis.conjugacy.derive", "from numba import njit"),
        ("ssmppl.analysis.conjugacy.derive", "def f():\n    import numba.typed"),
        ("ssmppl.plots", "import matplotlib.pyplot as plt"),
        ("ssmppl.cli", "try:\n    import pandas as pd\nexcept ImportError:\n    pass"),
        ("ssmppl.language.distributions.continuous", "from scipy import stats"),
        ("ssmppl", "from ssmppl.cli import main"),
        ("ssmppl.helpers", ""),
        ("ssmppl.codegen.text.specialise", "import ast\nast.walk(ast.parse(text))"),
        ("ssmppl.inference.run.problem", "import ast\nf = ast.literal_eval"),
        ("ssmppl.diagnosis.report.model_file", "from ast import literal_eval"),
        (
            "ssmppl.diagnosis.model.smoothing",
            "@cached_property\ndef run(self):\n    return compile_rows(1)",
        ),
        ("ssmppl.data", "\n" * (LONGEST + 1)),
    ],
)
def test_faults_are_found(name, source):
    assert len(list(faults(name, source))) == 1


@pytest.mark.parametrize(
    ("name", "source"),
    [
        (
            "ssmppl.language.model.model",
            "from ssmppl.expressions.expr import Expr\nfrom . import trace",
        ),
        ("ssmppl.inference.chains.pgas", "from ssmppl import data, results\nimport numba"),
        ("ssmppl.results", "def f():\n    import arviz"),
        ("ssmppl.codegen.text.module", "import ast\nast.unparse(node)"),
        (
            "ssmppl.diagnosis.model.smoothing",
            "@once_property\ndef run(self):\n    return compile_rows(1)",
        ),
        ("ssmppl.results", "if TYPE_CHECKING:\n    import xarray as xr"),
        ("ssmppl.language.distributions.continuous", "from scipy import special"),
        ("ssmppl.cli", "import ssmppl as ssm\nfrom ssmppl import Model, plots"),
        ("ssmppl.cli.states", "from ssmppl.cli.group import command\nfrom ssmppl import modelfile"),
    ],
)
def test_what_is_allowed_passes(name, source):
    assert list(faults(name, source)) == []


def room_of(name):
    """The folder that a module stands in; a package's own module stands beside its rooms."""
    path = MODULES[name].relative_to(ROOT)
    return ".".join(path.parent.parts)


def arrows():
    """Module -> modules that it imports, packages left out: they hold nothing but names."""
    plain = {name for name, path in MODULES.items() if path.name != "__init__.py"}
    out = {}
    for name in plain:
        source = MODULES[name].read_text(encoding="utf-8")
        found = {imported for imported, _, _, typing in Imports(name, source).found if not typing}
        targets = {m for i in found for m in (i, i.rpartition(".")[0]) if m in plain}
        out[name] = targets - {name}
    return out


def circles(graph):
    """The names that can be reached from themselves."""
    left = {a: set(b) for a, b in graph.items()}
    while True:
        ends = {a for a, b in left.items() if not b & set(left)}
        if not ends:
            return sorted(left)
        left = {a: b for a, b in left.items() if a not in ends}


def test_no_circle_of_imports():
    assert circles(arrows()) == []


def test_no_circle_of_rooms():
    """Between folders that hold no others: each of these has one reason to import another."""
    parents = {room_of(n).rpartition(".")[0] for n in MODULES}
    graph = {}
    for a, targets in arrows().items():
        if room_of(a) not in parents:
            rooms = {room_of(b) for b in targets} - parents - {room_of(a)}
            graph.setdefault(room_of(a), set()).update(rooms)
    assert circles(graph) == []


def test_circles_are_found():
    assert circles({"a": {"b"}, "b": {"c"}, "c": set()}) == []
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"b"}, "d": {"e"}, "e": set()}) == ["a", "b", "c"]


def test_rooms_are_not_crowded():
    size = Counter(room_of(n) for n, path in MODULES.items() if path.name != "__init__.py")
    assert {room: n for room, n in size.items() if n > MOST} == {}


USERS = {"augmented_model.py", "motor.py", "NAME.py", "mymodel.py", "file.py"}  # files of theirs
MENTION = re.compile(r"`((?:\w+/)*\w+\.py)`")


@pytest.mark.parametrize("name", MODULES)
def test_files_that_are_mentioned_exist(name):
    """`file.py` in a docstring or a comment is one of the same folder, or below the package."""
    text = MODULES[name].read_text(encoding="utf-8")
    files = [str(p.relative_to(ROOT / PACKAGE)) for p in MODULES.values()]
    known = {*files, *(str(p.relative_to(ROOT)) for p in (ROOT / "tests").rglob("*.py")), *USERS}
    lacking = [
        m for m in MENTION.findall(text) if not (MODULES[name].parent / m).exists() and not
        any(f"/{k}".endswith("/" + m) for k in known)
    ]  # fmt: skip
    assert lacking == []


def test_importing_the_package_imports_nothing_slow():
    """Neither directly nor through what it imports; the diagnosis belongs to it too."""
    slow = (*SLOW, f"{PACKAGE}.diagnosis", f"{PACKAGE}.plots")
    code = f"import sys, {PACKAGE}; print(*(m for m in {slow!r} if m in sys.modules))"
    run = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True
    )
    assert run.stdout.split() == []


def test_all_public_names_are_there():
    """Those too that are imported later, and `dir` lists them."""
    code = f"import {PACKAGE} as p; assert all(hasattr(p, n) and n in dir(p) for n in p.__all__)"
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True)
