"""Look over the built pages: links, anchors, images, navigation, and what notebooks left behind.

    python docs/check_built.py docs/_build/html

Sphinx knows the links between sources, and this what came of them: links made by templates and in
outputs, pages that no link leads to, warnings, progress bars and paths of the machine that ran the
notebooks. It asks no network (`make linkcheck` does).
"""

import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

# What no output should hold, and what to call it.
LEFTOVERS = {
    r"ipykernel|/tmp/|/home/|/root/|/Users/": "a path of the machine",
    r"\b[A-Z]\w*Warning: |\bWARNING\b": "a warning",
    r"\d{6,}\.py": "a cell's file",
    r"Traceback \(most recent call last\)": "a traceback",
    r"\d(it/s|s/it)\b|\d+%\|": "a progress bar",
}
UNLINKED = {"search.html", "_modules/index.html"}  # opened by the search box; nobody needs it
VOID = {"area", "br", "col", "embed", "hr", "img", "input", "link", "meta", "source", "wbr"}


@dataclass
class Page(HTMLParser):
    """Links, anchors and texts of one page.

    links : (reference, whether it is a link rather than an image or a script).
    outputs : texts of the outputs of cells.
    """

    text: str
    links: list[tuple[str, bool]] = field(default_factory=list)
    anchors: set[str] = field(default_factory=set)
    outputs: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        super().__init__()
        self._depth, self._output = 0, 0  # open tags, and at how many the output began
        self.feed(self.text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = dict(attrs)
        self.anchors |= {found[key] or "" for key in ("id", "name") if key in found}
        for key in ("href", "src"):
            if found.get(key):
                self.links.append((str(found[key]), tag == "a"))
        if tag in VOID:
            return
        self._depth += 1
        if not self._output and "cell_output" in (found.get("class") or "").split():
            self._output = self._depth
            self.outputs.append("")

    def handle_endtag(self, tag: str) -> None:
        if tag in VOID:
            return
        if self._depth == self._output:
            self._output = 0
        self._depth -= 1

    def handle_data(self, data: str) -> None:
        if self._output:
            self.outputs[-1] += data


def faults(root: Path) -> Iterator[str]:
    """What is wrong with the pages under `root`, one line each."""
    root = root.resolve()
    pages = {path: Page(path.read_text("utf-8")) for path in sorted(root.rglob("*.html"))}
    led_to: dict[Path, set[Path]] = {path: set() for path in pages}
    for path, page in pages.items():
        name = path.relative_to(root)
        for reference, is_link in page.links:
            parts = urlsplit(reference)
            if parts.scheme or parts.netloc:
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            if target.is_dir():
                target = target / "index.html"
            if not target.is_file():
                yield f"{name}: {reference!r} leads nowhere"
            elif is_link and target in pages:
                led_to[path].add(target)
                if name.parts[0] == "_modules":
                    continue  # Sphinx guesses at anchors there, on pages that hold one name each
                if parts.fragment and unquote(parts.fragment) not in pages[target].anchors:
                    yield f"{name}: {reference!r} names an anchor that is not there"
        for output in page.outputs:
            for pattern, what in LEFTOVERS.items():
                for found in re.finditer(pattern, output):
                    line = output[: found.end()].count("\n")
                    yield f"{name}: {what} in an output: {output.splitlines()[line].strip()!r}"
    reached, rest = set(), [root / "index.html"]
    while rest:
        path = rest.pop()
        if path not in reached:
            reached.add(path)
            rest += led_to.get(path, ())
    for path in sorted(set(pages) - reached):
        if (name := path.relative_to(root)).as_posix() not in UNLINKED:
            yield f"{name}: no link leads to it"


def main(folder: str) -> int:
    found = list(dict.fromkeys(faults(Path(folder))))
    print(*found, sep="\n")
    print(
        f"{folder}: {len(found)} faults" if found else f"{folder}: links and outputs are in order"
    )
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
