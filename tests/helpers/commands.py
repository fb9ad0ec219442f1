"""Commands that must fail, with one sentence."""

from mi_diffind.commands.cli import main


def refused(capsys, *arguments):
    """Run a command that must fail with exit code 2 and one sentence; returns it."""
    capsys.readouterr()
    assert main(list(arguments)) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    lines = [line for line in lines if line.startswith("mi-diffind: error: ")]
    assert len(lines) == 1, lines
    assert "Traceback" not in lines[0] and "[parser.cpp" not in lines[0]
    return lines[0]
