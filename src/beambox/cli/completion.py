"""Completion in shells: `beambox completion bash` prints a script, which asks `beambox` for what may follow."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any

import typer

from beambox.checks import BeamboxError, did_you_mean

__all__ = ["ASK", "command", "complete"]

ASK = "_BEAMBOX_WORDS"
"""Variable of the environment by which a shell asks: the words are printed that may stand last."""

BASH = """_beambox() {
    local IFS=$'\\n'
    COMPREPLY=($(_BEAMBOX_WORDS=1 beambox "${COMP_WORDS[@]:1:COMP_CWORD}" 2>/dev/null))
}
complete -o bashdefault -o default -F _beambox beambox
"""
SCRIPTS = {
    "bash": BASH,
    "zsh": "autoload -U +X compinit && compinit\nautoload -U +X bashcompinit && bashcompinit\n" + BASH,
    "fish": "complete -c beambox -a "
    "'(env _BEAMBOX_WORDS=1 beambox (commandline -opc)[2..] (commandline -ct) 2>/dev/null)'\n",
}
TAKES_MODEL = ("evaluate", "bench", "models", "export")
"""Commands whose first word is a model."""


def command(shell: Annotated[str, typer.Argument(metavar="SHELL", help="bash, zsh or fish.")]) -> None:
    """Print a script that completes commands, options and names of weights and recipes; other words are files.

    Examples:
      beambox completion bash >> ~/.bashrc
      beambox completion zsh >> ~/.zshrc
      beambox completion fish > ~/.config/fish/completions/beambox.fish
    """
    if shell not in SCRIPTS:
        raise BeamboxError(f'no completion for the shell "{shell}"{did_you_mean(shell, SCRIPTS)}')
    print(SCRIPTS[shell], end="")


def complete(words: Sequence[str]) -> list[str]:
    """Return what may stand in the place of the last word; nothing where files may.

    Args:
        words: after `beambox`, the last one unfinished and perhaps empty.
    """
    from beambox.cli.commands import COMMANDS

    *before, last = words or [""]
    if not before:
        return _begin(last, [*COMMANDS, "--help", "--version"])
    if before[0] not in COMMANDS:
        return []
    known = _click_command(before[0])
    inner = getattr(known, "commands", None)
    if inner is not None and len(before) == 1:
        return _begin(last, [*inner, "--help"])
    if inner is not None:
        known = inner.get(before[1])
    if last.startswith("-") and known is not None:
        options = [word for option in known.params for word in (*option.opts, *option.secondary_opts)]
        return _begin(last, ["--help", *(word for word in options if word.startswith("-"))])
    return _begin(last, _names(before))


def _names(before: Sequence[str]) -> list[str]:
    """List the shipped names that may follow, where a model or a recipe is wanted."""
    if before[-1] in ("--model", "-m") or (before[0] in TAKES_MODEL and len(before) == 1):
        from beambox.zoo import shipped

        return list(shipped())
    if list(before) in (["train"], ["recipes"]):
        from beambox.train.recipes import recipe_files

        return sorted(recipe_files())
    return []


def _click_command(name: str) -> Any:
    from importlib.metadata import EntryPoint

    from beambox.cli.commands import COMMANDS

    found = EntryPoint(name, COMMANDS[name][0], "beambox").load()
    if not isinstance(found, typer.Typer):
        app = typer.Typer(add_completion=False)
        app.command(name)(found)
        found = app
    return typer.main.get_command(found)


def _begin(start: str, words: Sequence[str]) -> list[str]:
    return [word for word in words if word.startswith(start)]
