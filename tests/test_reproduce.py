"""The whole reproduction: what it runs, in which order, and that nothing is lost on the way."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from experiments import critics, reproduce
from experiments.speed import embedded

ROOT = Path(__file__).parent.parent

# notes when it began in a file of its own, writes a result; "killer" kills who called it, at its first call
WORK = """
import os, signal, sys
from pathlib import Path
name, out = sys.argv[1], Path(sys.argv[sys.argv.index("--out") + 1])
(out / f"{name}.{os.getpid()}.started").touch()
if name == "killer" and len(list(out.glob("killer.*.started"))) == 1:
    os.kill(os.getppid(), signal.SIGKILL)
temporary = out / f"{name}.{os.getpid()}"
temporary.write_text(name)
temporary.replace(out / f"{name}.csv")
sys.exit(name == "bad")
"""


@pytest.fixture
def settings(tmp_path):
    (tmp_path / "work.py").write_text(WORK)
    (tmp_path / "out").mkdir()
    return reproduce.Args(runs=tmp_path / "runs", out=tmp_path / "out")


def steps(settings, *names, needs=()):
    return [reproduce.Step(name, (str(settings.runs.parent / "work.py"), name), 1.0, needs) for name in names]


def started(settings):
    return sorted(path.name.split(".")[0] for path in settings.out.glob("*.started"))


def test_every_table_and_figure_has_a_step():
    """Each script with a figure or a table of its own is run, with every study it knows."""
    commands = {" ".join(step.command) for step in reproduce.STEPS}
    for path in (ROOT / "experiments").glob("*/*.py"):
        text = path.read_text()
        if "command_line(main" not in text:
            continue
        line = next((line for line in text.splitlines() if "study: Literal[" in line), None)
        studies = json.loads(line[line.index("[") : line.index("]") + 1]) if line else [None]
        for study in studies:
            plain = path.relative_to(ROOT).as_posix()
            named = f"{plain} --study {study}"
            default = study in (None, studies[0]) and plain in commands
            assert named in commands or default or path.stem == "embedded", named
    run = {
        study for step in reproduce.STEPS if step.name.startswith("embedded") for study in step.command[2:]
    }
    assert run == embedded.STUDIES.keys()
    trained = {step.command[-1] for step in reproduce.STEPS if step.name.startswith("critic_")}
    assert (
        trained
        == critics.CRITICS.keys()
        == {path.stem for path in (ROOT / "experiments/pretrained").glob("*.pt")}
    )


def test_steps_wait_for_their_needs_and_what_measures_times_runs_by_itself():
    """Whatever ends first: here the last that began, or the first."""
    for ends in (-1, 0):
        left, running, done = list(reproduce.STEPS), [], set()
        while left or running:
            for step in reproduce.startable(left, done, running)[: 3 - len(running)]:
                assert done.issuperset(step.needs)
                left.remove(step)
                running.append(step)
            assert running and (len(running) == 1 or not any(step.alone for step in running))
            done.add(running.pop(ends).name)
        assert len(done) == len(reproduce.STEPS)
    chosen = [step.name for step in reproduce.wanted(reproduce.STEPS, ("cstr_frontier",))]
    assert chosen == [*reproduce.CRITICS, "cstr_deploy", "cstr_oracle", "cstr_frontier"]


def test_a_finished_step_is_not_repeated_and_a_failed_one_is(settings, capsys):
    reproduce.main(settings, steps(settings, "a", "b"))
    with pytest.raises(SystemExit):
        reproduce.main(settings, steps(settings, "a", "b", "bad"))
    with pytest.raises(SystemExit):
        reproduce.main(settings, steps(settings, "bad") + steps(settings, "c", needs=("bad",)))
    assert started(settings) == ["a", "b", "bad", "bad"] and "work.py bad" in capsys.readouterr().err


def test_a_lost_worker_loses_no_result_and_doubles_none(settings):
    from dask.distributed import LocalCluster

    names = ["s0", "s1", "killer", "s3", "s4", "s5"]
    with LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None) as cluster:
        settings.backend, settings.scheduler = "dask", cluster.scheduler_address
        reproduce.main(settings, steps(settings, *names))
    results = {path.stem: path.read_text() for path in settings.out.glob("*.csv")}
    assert results == {name: name for name in names}
    assert len(list((settings.runs / "done").iterdir())) == len(names)
    assert started(settings).count("killer") == 2


def test_the_command_line(settings, capsys):
    reproduce.main(reproduce.Args(list=True, only=("cstr_frontier",), runs=settings.runs, out=settings.out))
    assert "needs cstr_oracle" in capsys.readouterr().out
    bad = (
        dict(only=("nothing",)),
        dict(only=()),
        dict(jobs=0),
        dict(quick=True, out=reproduce.HERE),
        dict(backend="dask"),
        dict(scheduler="tcp://x:1"),
    )
    for options in bad:
        with pytest.raises(SystemExit):
            reproduce.main(reproduce.Args(**dict(runs=settings.runs, out=settings.out) | options))
        assert "--" + next(iter(options)) in capsys.readouterr().err


def test_a_cluster_needs_dask_and_nothing_else_does(tmp_path):
    code = "import sys; sys.modules['dask.distributed'] = None; from experiments import reproduce; from pathlib import Path; "
    code += f"print('imported'); here = Path({str(tmp_path)!r}); "
    code += (
        "reproduce.main(reproduce.Args(backend='dask', scheduler='tcp://localhost:1', out=here, runs=here))"
    )
    out = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert out.stdout.startswith("imported") and out.returncode == 2
    assert "requirements-experiments.txt" in out.stderr and "Traceback" not in out.stderr
