"""Commands that must fail, with one sentence, and commands that Ctrl-C ends."""

import re
import signal

from mi_diffind.commands.cli import main


def interrupt_at(monkeypatch, owner, name, number=1) -> list:
    """Press Ctrl-C in the call of ``owner.name`` with a number; return the list that the calls' arguments go to."""
    original, calls = getattr(owner, name), []

    def interrupting(*arguments, **options):
        calls.append(arguments)
        if len(calls) == number:
            signal.raise_signal(signal.SIGINT)
        return original(*arguments, **options)

    monkeypatch.setattr(owner, name, interrupting)
    return calls


def refused(capsys, *arguments):
    """Run a command that must fail with exit code 2 and one sentence, its own or its parser's; return the sentence."""
    capsys.readouterr()
    try:
        code = main([*map(str, arguments)])
    except SystemExit as e:
        code = e.code
    assert code == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if re.match("mi-diffind.*: error: ", line)]
    assert len(lines) == 1, lines
    assert "Traceback" not in lines[0] and "[parser.cpp" not in lines[0]
    return lines[0]
