"""What all commands have in common: the log file, completion in the shell."""

import re
import subprocess

import pytest

from raytwin.cli import COMMANDS, main


def test_a_log_keeps_the_command_its_messages_and_its_exit_code(tmp_path, capsys):
    log = tmp_path / "run.log"
    assert main(["--log", str(log), "mu", "water", "--energy-kev", "60"]) == 0
    assert main([f"--log={log}", "spectrum", "--kv", "500"]) == 2
    printed = capsys.readouterr()
    assert "/mm" in printed.out and "got 500 kV" in printed.err
    lines = [line.split("raytwin: ", 1)[1] for line in log.read_text(encoding="utf-8").splitlines()]
    assert lines[1] == "exit code 0" and lines[-1] == "exit code 2"
    assert re.fullmatch(r"raytwin \S+: raytwin spectrum --kv 500", lines[2])
    assert "got 500 kV" in lines[3]


def test_a_log_that_cannot_be_written_is_one_line(tmp_path, capsys):
    assert main(["--log", str(tmp_path / "none" / "x.log"), "mu", "water", "--energy-kev", "60"]) == 2
    assert main(["--log"]) == 2
    errors = capsys.readouterr().err.splitlines()
    assert len(errors) == 2 and all("--log: got" in line for line in errors)


def test_completion_is_a_script_that_the_shell_reads_and_knows_every_command(capsys):
    pytest.importorskip("shtab")
    assert main(["completion", "bash"]) == 0
    script = capsys.readouterr().out
    subprocess.run(["bash", "-n"], input=script, text=True, check=True, timeout=30)
    assert all(re.search(rf"[( ']{name}[') ]", script) for name in COMMANDS)
    assert "--source-detector-mm" in script
