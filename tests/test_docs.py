"""What README, docs/ and docstrings show is what happens: their commands and snippets run, their names exist."""

import ast
import importlib
import re
import shlex
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import tyro

import goal_mpc
import rl_mpc_deploy
import sac_her_branching
from experiments import reproduce

ROOT = Path(__file__).parent.parent

PAGES = {
    path.relative_to(ROOT).as_posix(): path.read_text()
    for path in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
}
SCRIPTS = {
    "sac_her_branching.py": sac_her_branching,
    "goal_mpc.py": goal_mpc,
    "rl_mpc_deploy.py": rl_mpc_deploy,
}
SOURCES = [
    path for pattern in ("*.py", "envs/**/*.py", "experiments/**/*.py") for path in sorted(ROOT.glob(pattern))
]

PLACES = ROOT, ROOT / "envs", ROOT / "experiments", *(ROOT / "experiments").glob("*/")


def commands():
    """Every command that starts a script, once, without its comment; {script: [words]}."""
    texts = [*PAGES.values(), *(ast.get_docstring(ast.parse(path.read_text())) or "" for path in SOURCES)]
    texts += [path.read_text() for path in (ROOT / "experiments/pretrained").glob("*.txt")]
    found = {}
    for text in texts:
        for script, words in re.findall(
            r"python ((?:experiments/(?:\w+/)?)?\w+\.py)((?: +[^\s`#&)]+)*)", text
        ):
            found[script, " ".join(words.split())] = None
    return [(script, shlex.split(words)) for script, words in found]


COMMANDS = [
    command
    for command in commands()
    if command[0] in SCRIPTS and "quadruple_tank" not in command[1] and command[1] != ["--help"]
]


@pytest.mark.parametrize(
    "script, words", COMMANDS, ids=lambda value: " ".join(value) if isinstance(value, list) else value
)
def test_every_command_of_the_three_scripts_runs(script, words, checkpoint, tmp_path):
    """End to end, with its own arguments, but for a few steps instead of many."""
    module = SCRIPTS[script]
    if "--resume" in words:
        run = str(interrupted(tmp_path))
        words = [word.replace("runs/NAME", run) for word in words]
        assert (sac_her_branching.main(tyro.cli(module.Args, args=words)) / "checkpoint.pt").exists()
        return
    trained = {"latest": str(checkpoint)}
    words = [trained.get(word, word.replace("runs/NAME/checkpoint.pt", str(checkpoint))) for word in words]
    shorter = {"@120": "@2", "@240": "@4", "360": "6"}
    words = [re.sub("@120|@240|^360$", lambda match: shorter[match[0]], word) for word in words]
    args = tyro.cli(module.Args, args=words)
    module.check(args)
    if getattr(args, "export_c", None):
        module.main(replace(args, export_c=tmp_path))
        assert (tmp_path / "rl_mpc.h").exists()
        return
    if module is sac_her_branching:
        few = dict(total_timesteps=640, learning_starts=320, num_envs=32, eval_episodes=4, buffer_size=3200)
    elif module is rl_mpc_deploy:
        few = dict(
            episodes=1, steps=2, jobs=1, compile=False
        )  # compiled, they run in test_the_worked_example
    else:
        few = dict(steps=min(args.steps, 6), animate=False, compile=False)
    module.main(replace(args, **few, out=tmp_path))
    assert list(tmp_path.rglob("*.csv"))


def interrupted(folder):
    """The folder of a run that has saved before its end."""
    few = dict(total_timesteps=640, learning_starts=320, eval_episodes=4, hidden=(8,), buffer_size=3200)
    run = sac_her_branching.main(sac_her_branching.Args(**few, out=folder))
    data = torch.load(run / "resume.pt", weights_only=True)
    torch.save(data | {"args": data["args"] | {"total_timesteps": 960}}, run / "resume.pt")
    return run


@pytest.mark.parametrize(
    "command",
    [command for command in commands() if command[0] not in SCRIPTS],
    ids=lambda c: " ".join([c[0], *c[1]]),
)
def test_every_command_of_an_experiment_is_a_step_of_the_reproduction(command):
    """Which runs all of them, on tiny budgets, in test_experiments.py; here their arguments are read."""
    script, words = command
    module = importlib.import_module(script.removesuffix(".py").replace("/", "."))
    args = tyro.cli(module.Args, args=words)
    assert (ROOT / script).exists()
    # critics.py calls the latter
    if script not in ("experiments/reproduce.py", "experiments/planner_value_iteration.py"):
        known = {step.command for step in reproduce.STEPS}
        assert script in {command[0] for command in known}
        if isinstance(study := getattr(args, "study", None), str):
            assert (script,) in known or (script, "--study", study) in known


def snippets():
    return [
        (page, code)
        for page, text in PAGES.items()
        for code in re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)
    ]


@pytest.mark.parametrize("page, code", snippets(), ids=lambda value: value[:30])
def test_python_snippets_run(page, code):
    out = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert out.returncode == 0, out.stderr


def test_the_worked_example_from_equations_to_deployed_controller(tmp_path):
    """docs/your_own_plant.md in a folder that holds the three scripts and envs/ alone: its module, then its commands, shortened."""
    page = PAGES["docs/your_own_plant.md"]
    module = re.search(r"```python\n(.*?)```", page, flags=re.DOTALL)[1]
    assert len(module.splitlines()) < 100
    shutil.copytree(ROOT / "envs", tmp_path / "envs", ignore=shutil.ignore_patterns("__pycache__"))
    for script in SCRIPTS:
        shutil.copy(ROOT / script, tmp_path)
    (tmp_path / "envs/quadruple_tank.py").write_text(module)
    lines = re.findall(r"python (\w+\.py)([^`#\n]*--env quadruple_tank[^`#\n]*)", page)
    assert [script for script, _ in lines] == ["goal_mpc.py", "sac_her_branching.py", "rl_mpc_deploy.py"]
    short = {
        "goal_mpc.py": ["--steps", "5"],
        "rl_mpc_deploy.py": ["--steps", "5", "--episodes", "1"],
        "sac_her_branching.py": ["--total-timesteps", "9600", "--eval-every", "0", "--eval-episodes", "20"],
    }
    for script, words in lines:
        trained = next(tmp_path.glob("runs/*sac*/checkpoint.pt"), Path("none"))
        command = [
            sys.executable,
            script,
            *words.replace("runs/NAME/checkpoint.pt", str(trained)).split(),
            *short[script],
        ]
        out = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300)
        assert out.returncode == 0, out.stderr
    assert "RL+MPC" in out.stdout
    # the same controller in C
    command = [*command[:-4], "--export-c", "controller"]
    assert subprocess.run(command, cwd=tmp_path, timeout=300).returncode == 0
    out = subprocess.run(
        ["make", "-s", "-C", "controller"], cwd=tmp_path, capture_output=True, text=True, timeout=300
    )
    assert out.returncode == 0 and "100 of 100 actions" in out.stdout, out.stderr


def test_links_files_and_figures_exist():
    for page, text in PAGES.items():
        folder = (ROOT / page).parent
        for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", text):
            assert target.startswith("http") or (folder / target).exists(), (page, target)
        for path in re.findall(r"`([\w/]+\.(?:py|pt|txt|csv|png|gif|npz))`", text):
            if "NAME" not in path and ("/" in path or path.endswith(".py")) and "quadruple_tank" not in path:
                assert any((place / path).exists() for place in PLACES), (page, path)


def test_anchors_exist():
    for page, text in PAGES.items():
        for target, anchor in re.findall(r"\]\(([^)#]*)#([^)]+)\)", text):
            there = (
                PAGES[((ROOT / page).parent / target).resolve().relative_to(ROOT).as_posix()]
                if target
                else text
            )
            headings = re.findall(r"^#+ (.*)$", there, flags=re.MULTILINE)
            assert anchor in [
                re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings
            ], (page, anchor)


def test_arguments_and_names_of_the_code_that_pages_mention_exist():
    for page, text in PAGES.items():
        own = SCRIPTS.get(Path(page).stem + ".py")
        fields = {
            name
            for source in SOURCES
            for name in re.findall(r"^    (\w+): ", source.read_text(), flags=re.MULTILINE)
        } | {"help"}
        for argument in re.findall(r"`--([a-z][\w-]*)", text):
            name = argument.removeprefix("no-").replace("-", "_")
            assert name in fields or argument.replace("-", "_") in fields, (page, argument)
        for path, name in re.findall(r"`([\w/]+\.py):([\w.]+)`", text):
            source = next(place / path for place in PLACES if (place / path).exists())
            defined = {
                node.name
                for node in ast.walk(ast.parse(source.read_text()))
                if isinstance(node, (ast.FunctionDef, ast.ClassDef))
            }
            assert set(name.split(".")) <= defined | set(
                re.findall(r"^(\w+)\b.*=", source.read_text(), flags=re.MULTILINE)
            ), (
                page,
                path,
                name,
            )
        if own:  # a page's table has every argument of its script
            missing = [
                name for name in own.Args.__dataclass_fields__ if f"--{name.replace('_', '-')}" not in text
            ]
            assert not missing, (page, missing)


def test_the_table_of_labels_has_every_label_that_code_and_pages_name():
    label = re.compile(r"\b(?:eq|app):\w[\w-]*")
    texts = [*PAGES.values(), *(path.read_text() for path in SOURCES)]
    named = {found for text in texts for found in label.findall(text)}
    table = re.findall(r"^\| `((?:eq|app):[\w-]+)`", PAGES["docs/paper_labels.md"], flags=re.MULTILINE)
    assert named == set(table) and len(table) > 20


def test_citation_names_the_papers_title():
    """In the README and for those who cite."""
    title = "A view on learning robust goal-conditioned value functions: Interplay between RL and MPC"
    assert title in (ROOT / "CITATION.cff").read_text() and title in PAGES["README.md"].replace("\n", " ")
