"""The command `completion`: what a shell needs to complete commands, options and files."""

from __future__ import annotations

import click
from click.shell_completion import get_completion_class

from ssmppl.cli.group import Argument, command

__all__ = ["completion"]

PROGRAM, VARIABLE = "ssmppl", "_SSMPPL_COMPLETE"  # click's names, for a program of this name


@command("completion", "The script that completes commands in bash, zsh, fish.", prints_json=False)
@click.argument(
    "shell", type=click.Choice(["bash", "zsh", "fish"]), metavar="bash|zsh|fish", cls=Argument,
    about="The shell.",
)  # fmt: skip
def completion(shell: str) -> None:
    """The script that completes commands, options and files in a shell.

    Prints it. A line in the start-up file of the shell reads it; the file is ~/.bashrc, ~/.zshrc,
    or for fish the script itself is kept where fish looks for it. Nothing is written.

    \b
        eval "$(ssmppl completion bash)"        # a line for ~/.bashrc
        eval "$(ssmppl completion zsh)"         # a line for ~/.zshrc, after compinit
        ssmppl completion fish > ~/.config/fish/completions/ssmppl.fish
    """
    kind = get_completion_class(shell)
    assert kind is not None  # click has these three
    root = click.get_current_context().find_root().command
    click.echo(kind(root, {}, PROGRAM, VARIABLE).source())
