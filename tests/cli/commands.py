"""Run `mkc` in this process, and check its failures."""

from typer.testing import CliRunner

from mkc_torch.cli.app import app


def mkc(*arguments):
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def flat(text):
    """Return text with single spaces, without the borders of a panel."""
    return " ".join(text.replace("│", " ").split())


def assert_refused(result, *words, code=1, lines=1):
    """Assert a failure in so many lines that contain the words, without a traceback."""
    assert result.exit_code == code, result.output
    assert result.exception is None or isinstance(result.exception, SystemExit)
    assert "Traceback" not in result.output
    if code == 1:
        # a busy machine reports progress too
        assert len([line for line in result.stderr.strip().splitlines() if "mkc: after " not in line]) == lines
    for word in words:
        assert word in flat(result.stderr), flat(result.stderr)
