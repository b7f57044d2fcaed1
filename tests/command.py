"""A command of the line, run in this process."""

import json

from stagectl import cli


def call(capsys, *arguments):
    """Run a command in this process: (exit code, stdout, stderr)."""
    capsys.readouterr()
    code = cli.main([str(argument) for argument in arguments])
    out, err = capsys.readouterr()
    return code, out, err


def call_json(capsys, *arguments):
    """Run a command with --json: (exit code, the object, stderr)."""
    code, out, err = call(capsys, *arguments, "--json")
    return code, json.loads(out), err
