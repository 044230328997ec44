"""The command line: one file a command, loaded only when it is called."""

from __future__ import annotations

import importlib
import io
import os
import sys
from typing import TYPE_CHECKING, Any

import click

from operando import __version__

if TYPE_CHECKING:
    from click.shell_completion import CompletionItem

# command -> (module of this package, what it does); the texts stand here so that --help loads no command
COMMANDS: dict[str, tuple[str, str]] = {
    "demo": ("demo", "The packaged example, from raw UFF to the report."),
    "init": ("init", "Look at the files in a folder and write a test file."),
    "inspect": ("inspect", "What is in files: sets, channels, DOFs, units, sampling, findings."),
    "run": ("run", "All stages of a test, from raw files to the report."),
    "frf": ("stages", "A test up to the idle FRFs."),
    "ema": ("stages", "A test up to the idle modes."),
    "oma": ("stages", "A test up to the operational modes."),
    "ofrf": ("ofrf", "Operational FRFs of any pair of DOFs."),
    "compare": ("compare", "Any model against any measurement."),
    "compare-libraries": ("libraries", "The same data through sdypy-EMA and pyOMA-2 beside operando."),
    "diagnose": ("diagnose", "Where the error of the idle model lies in operation, and which effect is missing."),
    "add": ("add", "Add effects to the idle model and see the error before and after."),
    "remove": ("remove", "Take an added effect back."),
    "effects": ("effects", "The catalogue of effects, with locations, parameters and units."),
    "convert": ("convert", "Convert between file formats."),
    "report": ("report", "Rebuild report.html of a results folder."),
    "workbench": ("workbench", "A test in the browser: choose its modes, effects, channels and runs by hand."),
    "campaign": ("campaign", "Many tests: modes and missing effects over speed, load or date."),
    "completion": ("completion", "Completion of commands and options at the Tab key of a shell."),
}


class UnknownCommand(click.UsageError):
    """There is no such command; the nearest is named."""

    def __init__(self, name: str, near: str | None, ctx: click.Context) -> None:
        self.hint = f"did you mean {near!r}?" if near else "commands: " + ", ".join(COMMANDS)
        super().__init__(f"there is no command {name!r}; {self.hint}", ctx)


class LazyGroup(click.Group):
    """A group that imports the module of a command when the command is called."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Names, in the order of a test."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """The command of that name, or None."""
        if cmd_name not in COMMANDS:
            return None
        module = importlib.import_module(f"operando.cli.{COMMANDS[cmd_name][0]}")
        command: click.Command = getattr(module, cmd_name.replace("-", "_"))
        return command

    def resolve_command(self, ctx: click.Context, args: list[str]) -> tuple[str | None, click.Command | None, list[str]]:
        """The command asked for; of an unknown one the nearest is named."""
        name = args[0]
        if name not in COMMANDS and not name.startswith("-"):
            from difflib import get_close_matches

            near = get_close_matches(name, COMMANDS, 1, 0.5)
            raise UnknownCommand(name, near[0] if near else None, ctx)
        return super().resolve_command(ctx, args)

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        """Commands and options that begin so, without loading a command."""
        from click.shell_completion import CompletionItem

        found = [CompletionItem(name, help=text) for name, (_, text) in COMMANDS.items() if name.startswith(incomplete)]
        return found + (click.Command.shell_complete(self, ctx, incomplete) if incomplete.startswith("-") else [])

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """The list of commands, without loading them."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, text) for name, (_, text) in COMMANDS.items()])

    def main(self, *args: Any, **kwargs: Any) -> Any:
        """Run; with --json, wrong usage is answered by a JSON document too (exit code 2)."""
        if not kwargs.get("standalone_mode", True):
            return super().main(*args, **kwargs)
        _open_closed_streams()
        given = kwargs.get("args") or (args[0] if args else None) or sys.argv[1:]
        try:
            code = super().main(*args, **{**kwargs, "standalone_mode": False})
        except click.UsageError as error:
            if "--json" in given:
                from operando.cli.answer import print_json

                usage = error.ctx.get_usage() if error.ctx is not None else None
                hint = error.hint if isinstance(error, UnknownCommand) else usage
                print_json({"schema": "operando/error/1", "error": error.format_message(), "where": "command line", "hint": hint})
            _show(error)
            sys.exit(2)
        except click.ClickException as error:
            _show(error)
            sys.exit(error.exit_code)
        except (click.Abort, KeyboardInterrupt):
            click.echo("interrupted", err=True)
            sys.exit(130)
        except BrokenPipeError:
            sys.stdout = None
            sys.exit(1)
        except OSError as error:  # all others are explained where they occur
            click.echo(f"operando: the answer cannot be written to stdout: {error.strerror}", err=True)
            sys.exit(1)
        sys.exit(code if isinstance(code, int) else 0)


def _open_closed_streams() -> None:
    """Give a standard stream that is closed the null device: else the next file opened takes its number, and what is printed."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode, encoding="utf-8"))  # noqa: SIM115


def _show(error: click.ClickException) -> None:
    """What click says of wrong usage; words of the command line may come from file names and are shown, not sent to the terminal."""
    from operando.printable import printable

    text = io.StringIO()
    error.show(text)
    click.echo(printable(text.getvalue(), lines=True), err=True, nl=False)


@click.command(
    cls=LazyGroup,
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog="Start with `operando demo`, or with your own files: `operando init DIR`, then `operando run DIR/test.toml`.",
)
@click.version_option(__version__, prog_name="operando")
def main() -> None:
    """Operational FRFs of running machines from raw vibration measurements.

    Every command takes --json (one JSON document on stdout); progress goes to stderr. Exit code 0: done, 1: failed and explained,
    2: wrong usage.
    """
