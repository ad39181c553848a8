"""What the README shows is what happens."""

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()


def test_python_snippets_run():
    snippets = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
    assert snippets
    for snippet in snippets:
        out = subprocess.run([sys.executable, "-c", snippet], cwd=ROOT, capture_output=True, text=True, timeout=300)
        assert out.returncode == 0, out.stderr


def test_files_arguments_and_figures_that_it_names_exist():
    for path in re.findall(r"\]\(([^)]+)\)", README) + re.findall(r"`([\w/]+\.(?:py|pt|txt|csv|png|gif))`", README):
        if "NAME" not in path and ("/" in path or path.endswith(".py")):
            assert (ROOT / path).exists() or (ROOT / "envs" / path).exists(), path
    scripts = {name: (ROOT / name).read_text() for name in ("sac_her_branching.py", "goal_mpc.py", "rl_mpc_deploy.py")}
    for script, arguments in re.findall(r"python (\w+\.py)((?: +[^\s`#]+)*)", README):
        for argument in re.findall(r"--([\w-]+)", arguments):
            assert f"    {argument.replace('-', '_')}: " in scripts[script], (script, argument)
