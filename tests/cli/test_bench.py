"""Benchmarks as processes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

from tests.cli.conftest import ROOT


def test_errors_and_control_c_of_a_real_process(project: Path) -> None:
    """No traceback, whatever the process was doing."""
    done = subprocess.run([sys.executable, ROOT / "cli.py", "bench", "x"], capture_output=True, text=True)
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    (project / "benchmarks").mkdir()
    (project / "benchmarks" / "long.py").write_text("import time\nprint('on', flush=True)\ntime.sleep(60)\n")
    process = subprocess.Popen(
        [sys.executable, ROOT / "cli.py", "bench", "long"],
        # a runner in the background ignores Ctrl-C, and its children would inherit that
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert process.stdout is not None
    while process.stdout.readline() != "on\n":
        pass
    os.killpg(process.pid, signal.SIGINT)
    _, error = process.communicate(timeout=20)
    assert process.returncode == 130
    assert "go on with: romnav bench long" in error
