"""The page of the commands, from the argument parser itself."""

from __future__ import annotations

import argparse
import re
import textwrap

from mi_refgs import cli
from mi_refgs.cli import build_parser
from site_pages import table


def page() -> str:
    """Every command with its options and its example."""
    commands = subcommands(build_parser())
    text = [
        "# Commands",
        "`refgs COMMAND --help` says the same. Results go to standard output, progress and warnings to "
        "standard error; with `--json` a command prints one JSON object and nothing else on standard output.",
        table(
            ["command", "what it does"],
            [[f"[`refgs {name}`](#{name})", summary] for name, (_, summary) in commands.items()],
        ),
        table(["exit code", "meaning"], [[code, what] for code, what in exit_codes()]),
    ]
    for name, (parser, _) in commands.items():
        text += command(name, parser)
    return "\n\n".join(text) + "\n"


def exit_codes() -> list[tuple[str, str]]:
    """Code and meaning, from the sentence in the docstring of `mi_refgs.cli`."""
    sentence = (cli.__doc__ or "").partition("Exit codes: ")[2].partition(".\n")[0]
    return re.findall(r"(\d+) ([^,]+)", " ".join(sentence.split()))


def subcommands(parser: argparse.ArgumentParser) -> dict[str, tuple[argparse.ArgumentParser, str]]:
    """Name → parser and summary of each command."""
    [action] = [a for a in parser._actions if isinstance(a, argparse._SubParsersAction)]
    summaries = {choice.dest: choice.help or "" for choice in action._choices_actions}
    return {name: (inner, summaries[name]) for name, inner in action.choices.items()}


def command(name: str, parser: argparse.ArgumentParser) -> list[str]:
    """The section of one command."""
    usage = re.sub(r"\s+", " ", parser.format_usage()).strip().removeprefix("usage: ")
    text = [
        f"## refgs {name} {{#{name}}}",
        escaped(parser.description or ""),
        f"```text\n{_folded(usage)}\n```",
    ]
    rows = [
        [
            f"`{invocation(action)}`",
            escaped(meaning(parser, action)) + (" **(required)**" if _must(action) else ""),
        ]
        for group in parser._action_groups
        for action in group._group_actions
        if not isinstance(action, argparse._HelpAction)
    ]
    text.append(table(["option", "meaning"], rows))
    text += [
        f"{(group.title or '').capitalize()}:\n\n```text\n{textwrap.dedent(group.description).strip()}\n```"
        for group in parser._action_groups
        if group.description
    ]
    if parser.epilog:
        example = parser.epilog.removeprefix("example:").strip("\n")
        text.append("```sh\n" + "\n".join(line.strip() for line in example.splitlines()) + "\n```")
    return text


def invocation(action: argparse.Action) -> str:
    """How an option or argument is written: `-o RUN, --output RUN`."""
    return argparse.HelpFormatter("refgs", width=1000)._format_action_invocation(action)


def meaning(parser: argparse.ArgumentParser, action: argparse.Action) -> str:
    """Its help, with its default filled in."""
    return parser._get_formatter()._expand_help(action) if action.help else ""


def escaped(text: str) -> str:
    """Plain text as Markdown: no `<`, `*` or `_` has a meaning outside of backticks."""
    parts = re.split(r"(`[^`]*`)", text)
    return "".join(p if p.startswith("`") else re.sub(r"([<*_\[\]])", r"\\\1", p) for p in parts)


def _must(action: argparse.Action) -> bool:
    return bool(action.option_strings) and action.required


def _folded(usage: str, width: int = 80) -> str:
    """The usage in lines of that many characters, broken before an option."""
    lines = [""]
    for part in re.findall(r"\[[^\]]*\](?:[^\s]*)|\S+", usage):
        if len(lines[-1]) + len(part) >= width:
            lines.append("   ")
        lines[-1] += (" " if lines[-1] else "") + part
    return "\n".join(lines)
