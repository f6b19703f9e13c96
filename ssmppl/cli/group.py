"""The group of commands: how help is laid out, how errors are shown, what the exit codes are.

====  ==============================================================================
code  when
====  ==============================================================================
0     all is done
1     a fault of the model, of the data or of a value; or of this package, with a traceback
2     the command line is not one: an unknown option, a file that is not there
3     incomplete result: what failed is named in the result and on standard error
130   interrupted by Ctrl-C; what was kept is said on standard error
====  ==============================================================================

The fix of an error is in words of the command line: `steps=100` is `--steps 100` there.
"""

from __future__ import annotations

import os
import re
import shlex
import warnings
from collections.abc import Callable, Collection, Iterable, Sequence
from typing import IO, Any, TypeVar

import click

from ssmppl.errors import SSMError

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


IN_PART, INTERRUPTED = 3, 130
AS_JSON = "ssmppl.json"  # whether the answer is wanted as JSON, in the context's `meta`

# Options that take all the name=value which follow.
ASSIGNMENTS = ("--parameters", "-p", "--fixed", "--start", "--settings")

# Options stand in the help under these, in this order.
SECTIONS = ("Model and data", "Method", "Run", "Output", "Shown")

F = TypeVar("F", bound=Callable[..., Any])


class Fault(click.ClickException):
    """A fault of the user's: its message in words, without a traceback, exit code 1."""

    def __init__(self, message: str):
        super().__init__(message)
        context = click.get_current_context(silent=True)
        self.color = context.color if context is not None else None

    def show(self, file: IO[Any] | None = None) -> None:
        word = click.style("Error:", fg="red", bold=True)
        click.echo(f"{word} {self.format_message()}", file=file, err=True, color=self.color)


class Option(click.Option):
    """An option that stands under a title in the help of its command."""

    def __init__(self, *args: Any, section: str = "Method", **settings: Any):
        super().__init__(*args, **settings)
        self.section = section


class Argument(click.Argument):
    """An argument that stands in the help with what it is."""

    section = SECTIONS[0]

    def __init__(self, *args: Any, about: str = "", **settings: Any):
        super().__init__(*args, **settings)
        self.about = about

    def get_help_record(self, ctx: click.Context) -> tuple[str, str]:
        return self.metavar or self.name or "", self.about


class Commands(click.Group):
    """Turns errors on purpose into messages, and Ctrl-C into a sentence."""

    def __init__(self, *args: Any, families: Sequence[str] = (), **settings: Any):
        super().__init__(*args, **settings)
        self.families: dict[str, list[str]] = {title: [] for title in families}

    def add_family(self, title: str, *commands: click.Command) -> None:
        """Commands that stand together in the help."""
        for one in commands:
            self.add_command(one)
            self.families.setdefault(title, []).append(str(one.name))

    def make_context(self, *args: Any, **extra: Any) -> click.Context:
        if _plain():
            extra["color"] = False
        return super().make_context(*args, **extra)

    def invoke(self, ctx: click.Context) -> Any:
        with warnings.catch_warnings():
            warnings.showwarning = _show_warning
            try:
                return super().invoke(ctx)
            except SSMError as error:
                called = self.commands[str(ctx.invoked_subcommand)]
                fix = in_words_of(called.params, self.commands, error.fix)
                raise Fault(_message(error, fix)) from error
            except KeyboardInterrupt:
                click.echo(
                    "Interrupted before there was anything to keep: nothing written.", err=True
                )
                ctx.exit(INTERRUPTED)

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(self.commands)  # as they stand here: in the order of use

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        longest = max(map(len, self.commands), default=0)
        room = formatter.width - longest - 6
        for title, names in self.families.items():
            rows = [(n.ljust(longest), self.commands[n].get_short_help_str(room)) for n in names]
            if rows:
                with formatter.section(title):
                    formatter.write_dl(rows)


class Command(click.Command):
    """A command whose name=value options take all that follow: `--fixed a=1 b=2`."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        spread: list[str] = []
        option = ""
        for arg in args:
            if arg in ASSIGNMENTS:
                option = arg
            elif option and spread[-1] != option and re.match(r"[A-Za-z_]\w*\s*=", arg):
                spread.append(option)
            elif option and spread[-1] != option:
                option = ""
            spread.append(arg)
        return super().parse_args(ctx, spread)

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        rows: dict[str, list[tuple[str, str]]] = {title: [] for title in SECTIONS}
        for parameter in self.get_params(ctx):
            record = parameter.get_help_record(ctx)
            if record is not None:
                rows[getattr(parameter, "section", SECTIONS[-1])].append(record)
        for title, records in rows.items():
            if records:
                with formatter.section(title):
                    formatter.write_dl(records)


def command(
    name: str, brief: str, *, prints_json: bool = True
) -> Callable[[Callable[..., Any]], click.Command]:
    """A command of the group, with the options that all have: `--json` and `--no-color`.

    brief : what it is, in the list of all.
    """

    def decorate(function: Callable[..., Any]) -> click.Command:
        made = click.command(name, cls=Command, short_help=brief)(plain_option(function))
        if prints_json:
            made.params.insert(
                0,
                Option(
                    ["--json"], is_flag=True, expose_value=False, is_eager=True, section="Shown",
                    callback=_remember_json, help="Print the answer as one line of JSON.",
                ),
            )  # fmt: skip
        return made

    return decorate


def plain_option(function: F) -> F:
    """The option `--no-color`, for commands and for the group."""
    return click.option(
        "--no-color", "--no-colour", cls=Option, section="Shown", is_flag=True, is_eager=True,
        expose_value=False, callback=_without_colour,
        help="No colours; neither where NO_COLOR is set, nor where there is no terminal.",
    )(function)  # fmt: skip


def _remember_json(ctx: click.Context, option: click.Parameter, value: bool) -> None:
    ctx.meta[AS_JSON] = value


def _without_colour(ctx: click.Context, option: click.Parameter, value: bool) -> None:
    if not value:
        return
    one: click.Context | None = ctx
    while one is not None:  # the group shows the error
        one.color = False
        one = one.parent
    before = os.environ.get("NO_COLOR")
    os.environ["NO_COLOR"] = "1"  # for the bar that shows progress
    ctx.find_root().call_on_close(lambda: _restore(before))


def _restore(before: str | None) -> None:
    if before is None:
        os.environ.pop("NO_COLOR", None)
    else:
        os.environ["NO_COLOR"] = before


def _plain() -> bool:
    """https://no-color.org: set, and not empty."""
    return bool(os.environ.get("NO_COLOR")) or os.environ.get("TERM") == "dumb"


def _message(error: SSMError, fix: str) -> str:
    text = str(error).removesuffix(error.fix) + fix
    return "\n".join([f"{type(error).__name__}\n{text}", *getattr(error, "__notes__", ())])


def _show_warning(
    message: Warning | str, category: type[Warning], filename: str, lineno: int,
    file: Any = None, line: str | None = None,
) -> None:  # fmt: skip
    click.echo(f"{click.style('Warning:', fg='yellow')} {message}", err=True)
