"""Commands on sessions, as a shell gives them."""

from typer.testing import CliRunner

from thermostand.stand.commands.sessions.session_commands import app

runner = CliRunner()
COUNT = 12  # half seconds, a frame each


def ask(*arguments: object, status: int = 0):
    result = runner.invoke(app, [str(argument) for argument in arguments])
    assert result.exit_code == status, result.output
    return result


def read_refusal(*arguments: object) -> str:
    """The one line that says what is wrong with the arguments."""
    (line,) = ask(*arguments, status=2).stderr.splitlines()
    return line
