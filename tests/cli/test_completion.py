"""The completion that the page on installing offers, in a real bash."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

PAGE = Path(__file__).parents[2] / "docs/guide/install.md"


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash")
@pytest.mark.parametrize(
    ("words", "offered"),
    [
        (["visdom-train", "me"], {"method:"}),
        (["visdom-train", "method", ":", "zipnerf-lite+v"], {"zipnerf-lite+vd"}),
        (["visdom-train", "method", ":"], {"ingp", "ingp+mask", "ingp+vd", "zipnerf-lite+vd"}),
        (["visdom-train", "--data", "fold"], set()),
    ],
)
def test_methods_complete_after_the_colon_which_is_a_word_in_bash(words, offered):
    (code,) = re.findall(r"```bash\n(_visdom_train.*?)```", PAGE.read_text(), re.S)
    listing = "".join(
        f"method:{name} a line\\n" for name in ("ingp", "ingp+mask", "ingp+vd", "zipnerf-lite+vd")
    )
    script = f"""
        visdom-methods() {{ printf '{listing}'; }}
        compopt() {{ :; }}
        {code}
        COMP_WORDS=({" ".join(words)}) COMP_CWORD={len(words) - 1}
        _visdom_train
        printf '%s\\n' "${{COMPREPLY[@]}}"
    """
    said = subprocess.run(["bash", "--norc", "-c", script], capture_output=True, text=True, check=True)
    assert set(said.stdout.split()) == offered
