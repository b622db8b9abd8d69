"""The cases of this folder, in a process of their own: torch counts devices once, at its first way back."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.device import second_device as second

HERE = Path(__file__).parent


@pytest.mark.skipif(not second.supported(), reason="needs torch 2.9 or newer")
@pytest.mark.parametrize("cases", ["device_cases.py", "method_cases.py"])
def test_cases_pass_in_a_process_of_their_own(cases):
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(HERE / cases)]
    run = subprocess.run(
        command, cwd=HERE.parents[1], env=os.environ, capture_output=True, text=True, timeout=600
    )
    assert run.returncode == 0, run.stdout[-5000:] + run.stderr[-1000:]
