"""`refgs completion`: scripts that shells source."""

from __future__ import annotations

import contextlib
import io
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

from mi_refgs.cli.command import Common, Result


@dataclass(frozen=True, kw_only=True)
class Completion:
    """Completes commands, options and files.

    example:
      refgs completion bash > ~/.local/share/bash-completion/completions/refgs
    """

    shell: Annotated[Positional[Literal["bash", "zsh", "tcsh", "fish"]], arg(metavar="{bash,zsh,tcsh,fish}")]
    """the shell"""
    common: Common = Common()

    def run(self) -> Result:
        """Write the script for all commands."""
        import tyro
        from tyro.conf import FlagCreatePairsOff, OmitArgPrefixes

        from mi_refgs.cli import COMMANDS, command_class

        commands: dict[str, Any] = {
            name: command_class(name)[0] for group in COMMANDS.values() for name in group
        }
        script = io.StringIO()
        with contextlib.redirect_stdout(script), contextlib.suppress(SystemExit):
            tyro.extras.subcommand_cli_from_dict(
                commands,
                prog="refgs",
                args=["--tyro-print-completion", self.shell],
                config=(FlagCreatePairsOff, OmitArgPrefixes),
            )
        # In bash, tyro joins preceding words to values with colons, which refgs does not have, and completes
        # files after options only, not as arguments.
        files = '"__TYRO_COMPLETE_FILES__"'
        text = script.getvalue().replace("local i=$COMP_CWORD\n", "local i=0\n")
        text = text.replace(f"== {files} ]]", f'== {files} || (-z "$completions" && "$cur" != -*) ]]')
        return Result({"shell": self.shell, "script": text}, text)
