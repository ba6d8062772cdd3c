"""Completion by Hydra's own function in a real bash."""

import os
import shutil
import subprocess
import sys

import pytest

BASH = shutil.which("bash") or ""
pytestmark = pytest.mark.skipif(not BASH, reason="bash is not installed")

PRESS_TAB = """
eval "$(mops-lightning --shell-completion install=bash)"
complete=$(complete -p mops-lightning | grep -o "[^ ]*_completion")
for COMP_LINE; do
    COMP_POINT=${#COMP_LINE}
    COMP_WORDS=($COMP_LINE)
    [[ $COMP_LINE == *" " ]] && COMP_WORDS+=("")
    COMP_CWORD=$((${#COMP_WORDS[@]} - 1))
    $complete
    echo "${COMPREPLY[@]}"
done
"""
"""What bash does when the tab key is pressed at the end of each given line."""


@pytest.fixture
def press_tab(tmp_path):
    """Return the candidates for each line, in a folder that holds the file ``reports.csv``."""
    program = tmp_path / "bin" / "mops-lightning"
    program.parent.mkdir()
    code = "import sys; from mops_lightning.cli.main import main; sys.exit(main())"
    program.write_text(f"#!{sys.executable}\n{code}\n")
    program.chmod(0o755)
    (tmp_path / "reports.csv").touch()
    path = f"{program.parent}{os.pathsep}{os.environ['PATH']}"

    def candidates(lines):
        done = subprocess.run(
            [BASH, "-c", PRESS_TAB, "bash", *lines],
            cwd=tmp_path,
            env={**os.environ, "PATH": path},
            capture_output=True,
            text=True,
            check=True,
        )
        assert done.stderr == ""
        return dict(zip(lines, map(str.split, done.stdout.splitlines()), strict=True))

    return candidates


def test_tab_completes_settings_subcommands_and_files(press_tab):
    expected = {
        "mops-lightning sam": ["sampler", "sampler."],
        "mops-lightning sampler=fm": ["sampler=fmops"],
        "mops-lightning sampler=fmops sampler.m_m": ["sampler.m_max="],
        "mops-lightning rep": ["report"],
        "mops-lightning mode": ["models"],
        "mops-lightning report rep": ["reports.csv"],
    }
    assert press_tab(expected) == expected


def test_tab_completes_options_of_subcommands(press_tab):
    pytest.importorskip("argcomplete")
    expected = {
        "mops-lightning report . --m": ["--metric", "--mixed"],
        "mops-lightning downsample a b --method f": ["fps"],
        "mops-lightning downsample a b --readout=m": ["--readout=matched"],
        "mops-lightning models pointnet.": ["pointnet.modelnet40"],
        "mops-lightning export mops.": ["mops.modelnet40-m32"],
        "mops-lightning models add --over": ["--overwrite"],
    }
    assert press_tab(expected) == expected
