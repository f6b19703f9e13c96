"""The fix of an error in words of the command line: `steps=100` is `--steps 100` there."""

from __future__ import annotations

import re
import shlex
from collections.abc import Collection, Iterable

import click

__all__ = ["in_words_of"]

# A value as Python has it: a mapping, a text in quotes, or whatever stands together.
VALUE = r"""\{[^}]*\}|"[^"]*"|'[^']*'|[-+\w.]+"""
KEYWORD = re.compile(rf"(?<![\w.'-])([a-z_]+)=({VALUE})?(?![(\[{{])")
METHOD = re.compile(r"(?:method=)?ssm\.([A-Z]\w*)\(([^()]*)\)")
VERB = re.compile(r"ssm\.([a-z_]+)\b(?:\(([^()]*)\))?")
PARAMETERS = re.compile(r"(?<!=)\{('\w+': \.\.\.(?:, '\w+': \.\.\.)*)\}")
PAIR = re.compile(r"'?(\w+)'?: ((?:\[[^]]*\]|[^,}])+)")  # of a mapping


def in_words_of(parameters: Iterable[click.Parameter], verbs: Collection[str], fix: str) -> str:
    """`fix`, which is written for Python, with the options of a command and the other commands.

    What has no counterpart on the command line stays as it is.

    parameters : of the command that was called. verbs : the names of all commands.
    """
    options = {str(p.name): p for p in parameters if isinstance(p, click.Option)}
    methods = getattr(options["method"].type, "short", {}) if "method" in options else {}

    def keyword(match: re.Match[str]) -> str:
        option, value = options.get(match[1]), match[2]
        if option is None:
            return match[0]
        name = max(option.opts, key=len)
        if value == "None":
            return f"no {name}"
        if isinstance(option.type, click.Path) and value and value.startswith("{"):
            columns = [column for column, _ in PAIR.findall(value)]
            return f"{name} FILE, with the column{'s' * (len(columns) > 1)} {', '.join(columns)}"
        if option.is_flag:
            off = option.secondary_opts[0] if option.secondary_opts else f"no {name}"
            return off if value == "False" else name
        return f"{name} {_assigned(value)}" if value else name

    def method(match: re.Match[str]) -> str:
        if match[1] not in methods:
            return match[0]
        words, settings = ["--method", methods[match[1]]], re.findall(r"\w+=[^,. ][^, ]*", match[2])
        return " ".join([*words, "--settings", *settings] if settings else words)

    def verb(match: re.Match[str]) -> str:
        name = match[1].replace("_", "-")
        flags = (
            f"--{flag.replace('_', '-')}" for flag in re.findall(r"(\w+)=True", match[2] or "")
        )
        return f"`{' '.join(['ssmppl', name, *flags])}`" if name in verbs else match[0]

    fix = VERB.sub(verb, METHOD.sub(method, fix))
    if "parameters" in options:
        fix = PARAMETERS.sub(lambda m: f"--parameters {_assigned(m[0])}", fix)
    fix = KEYWORD.sub(keyword, fix)
    if "seed" in options:
        fix = fix.replace("or None for a random one", "or leave --seed out for a random one")
    return re.sub(r"\bor None\b", "or none of them", fix) if "--method" in fix else fix


def _assigned(value: str) -> str:
    """A mapping as name=value after name=value; other values without their quotes."""
    if value == "{...}":
        return "name=value"
    if value.startswith("{"):
        pairs = (f"{name}={own}" for name, own in PAIR.findall(value))
        return " ".join(shlex.quote(p) if " " in p else p for p in pairs)
    return value.strip("\"'")
