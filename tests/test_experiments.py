"""Every experiment runs on a tiny budget and writes finite numbers; every committed figure can be redrawn from its CSV."""

import csv
import importlib
import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import tyro

import rl_mpc_deploy as deploy
from envs import cstr
from experiments import common, reproduce
from experiments.reactor import loops, offline, oracle, tune

ROOT = Path(__file__).parent.parent
TABLES = sorted(path.name for path in (ROOT / "experiments/results").glob("*.csv"))
FIGURES = sorted(path.name for path in (ROOT / "experiments/figures").iterdir())
TEXT = {
    "case",
    "kind",
    "c_B",  # a path, as text
    "env",
    "variant",
    "agent",
    "evaluation",
    "found_from",
    "visited_by",
    "scenarios",
    "machine",
    "controller",
    "critic",
    "psi",
    "objective",
    "equilibrium",
    "axis",
    "part",
    "barrier",
    "study",
    "solver",
    "detail",
    "peer",
    "ours_status",
    "peer_status",
    "peer_versions",
    "build",
    "language",
    "method",
    "starts",
}


def run(name, *arguments):
    command = [sys.executable, f"experiments/{name}.py", *map(str, arguments)]
    out = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=900)
    assert out.returncode == 0, out.stderr
    return out.stdout


def test_the_whole_reproduction_writes_every_table_and_figure(quick):
    for folder, committed in (("results", TABLES), ("figures", FIGURES)):
        assert sorted(path.name for path in (quick / folder).iterdir()) == committed
    assert all((quick / "figures" / name).stat().st_size > 10_000 for name in FIGURES)
    assert {path.name for path in (quick / "pretrained").iterdir()} == {
        path.name for path in (ROOT / "experiments/pretrained").glob("*.pt")
    }


@pytest.mark.parametrize("table", TABLES)
def test_a_table_has_the_columns_of_the_committed_one_and_finite_numbers(table, quick):
    rows = list(csv.DictReader(open(quick / "results" / table)))
    committed = list(csv.DictReader(open(ROOT / "experiments/results" / table)))
    assert rows and list(rows[0]) == list(committed[0])
    for row in rows + committed:
        # no number where a peer is not installed or did not converge, or a cross compiler is missing
        if table in ("benchmark_peers.csv", "embedded_room.csv"):
            row = {key: value for key, value in row.items() if value}
        for key, value in row.items():  # the weight of a hard bound is infinite
            assert key in TEXT or (key, value) == ("slack_weight", "inf") or np.isfinite(float(value)), (
                key,
                value,
            )
        assert "psi" not in row or len(json.loads(row["psi"])) == 2


def test_what_is_finished_is_not_repeated(quick):
    """Neither by the reproduction nor by an experiment, whose parts are kept one by one."""

    def written():
        kept = (
            path
            for path in (quick / "runs").rglob("*")
            if path.is_file() and path.suffix in (".csv", ".pt", ".json")
        )
        return {path: path.stat().st_mtime_ns for path in kept}

    before = written()
    assert f"{len(reproduce.STEPS)} steps done" in run(
        "reproduce", "--quick", "--out", quick, "--runs", quick / "runs"
    )
    for name, study in (("reactor/deploy", "deploy"), ("linear/value_mpc", "train")):
        kept = quick / "runs/experiments"
        run(name, "--study", study, "--quick", "--jobs", 1, "--out", quick, "--runs", kept)
    assert before == written()


# studies without a figure of their own
TABLE_ALONE = {
    "cstr_tune",
    "cstr_oracle",
    "cstr_stuck",
    "linear_value_mpc_train",
    "training_speed_profile",
    "embedded",
    "embedded_time",
}
DRAWN = [step for step in reproduce.STEPS if not step.name.startswith(("critic_", "reliability_"))]
DRAWN = [step for step in DRAWN if step.name not in TABLE_ALONE]


@pytest.mark.parametrize("step", DRAWN, ids=lambda step: step.name)
def test_figures_are_drawn_from_the_committed_tables(step, tmp_path):
    shutil.copytree(ROOT / "experiments/results", tmp_path / "results")
    module = importlib.import_module(step.command[0].removesuffix(".py").replace("/", "."))
    module.main(tyro.cli(module.Args, args=[*step.command[1:], "--plot-only", "--out", str(tmp_path)]))
    assert all(path.stat().st_size > 10_000 for path in (tmp_path / "figures").iterdir())


def test_importing_experiments_leaves_the_backend_of_matplotlib_alone():
    names = [
        path.relative_to(ROOT).with_suffix("").as_posix().replace("/", ".")
        for path in (ROOT / "experiments").glob("*/*.py")
        if path.stem != "peer_do_mpc"  # which lives in an environment of its own
    ]
    code = f"import matplotlib; matplotlib.use('svg'); import {', '.join(names)}; print(matplotlib.get_backend())"
    out = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert out.stdout.strip() == "svg", out.stderr


def square(number):
    return [{"number": number, "square": number**2}]


def test_finished_cells_are_kept_until_the_code_changes(tmp_path, monkeypatch):
    def collect():
        rows = common.collect(square, [1, 2], tmp_path)
        assert rows == [{"number": "1", "square": "1"}, {"number": "2", "square": "4"}]
        return len(list((tmp_path / "parts").iterdir()))

    assert collect() == collect() == 2
    monkeypatch.setitem(common.CODE, ROOT / "experiments/reactor/loops.py", b"changed")
    assert collect() == 2
    monkeypatch.setitem(common.CODE, ROOT / "envs/cstr.py", b"changed")
    assert collect() == 4


def test_agents_are_told_apart_by_their_arguments_and_the_code(tmp_path, monkeypatch):
    def folder(kind=None, **settings):
        return common.agent_folder(settings, tmp_path, kind)

    assert folder() == folder(scenarios="robust", hidden=(64, 64)) == folder(add_plant_data=None)
    data = folder(add_plant_data=tmp_path / "a.npz")
    assert data == folder(add_plant_data=Path("a.npz"))  # whose name is of its contents
    before = {folder(), data, folder(seed=1), folder(gamma=0.95), folder(offline.ScenarioCritics)}
    monkeypatch.setitem(common.CODE, ROOT / "sac_her_branching.py", b"changed")
    assert len(before | {folder()}) == 6


def test_controllers_of_the_loops_are_those_of_the_deployment_script():
    """But for what they change: a benchmark of its own, or another class."""
    published = tuple(cstr.BENCHMARK.items())
    for name, options in (("nominal_mpc", {}), ("robust_mpc", {}), ("nominal_mpc", {"offset_free": True})):
        settings = deploy.Args(compile=False, iterations=1, **options)
        pair = deploy.build_controller(name, settings), loops.benchmark_mpc(name, settings, published)
        for x in (cstr.START, cstr.START + 0.01):
            assert (
                np.array_equal(*(mpc.make_step(x) for mpc in pair))
                and pair[0].stats["cost"] == pair[1].stats["cost"]
            )
    settings = deploy.Args(compile=False, horizon=2)
    pair = deploy.build_controller("rl_mpc", settings), loops.value_mpc(settings)
    for x in (cstr.START, cstr.START + 0.01):
        assert (
            np.array_equal(*(mpc.make_step(x) for mpc in pair))
            and pair[0].stats["cost"] == pair[1].stats["cost"]
        )


def test_the_peers_of_the_benchmark(quick):
    """They are not in the requirements of the tests: then their rows say so. The committed table holds them."""
    rows, committed = (
        list(csv.DictReader(open(folder / "results/benchmark_peers.csv")))
        for folder in (quick, ROOT / "experiments")
    )
    for row in rows:
        assert float(row["ours_ms_median"]) > 0 and row["ours_failed"] == "0"
        assert row["peer_status"] != "not installed" or row["ratio_of_medians"] == ""
    for row in committed:
        if row["same_optimum"] and row["critic"] == "random":
            assert float(row["same_optimum"]) < 1e-4, row["peer"]
        assert bool(row["ratio_of_medians"]) == (
            row["peer_failed"] == "0"
        )  # no ratio where the peer did not converge


def test_training_beside_its_peer_counts_what_both_did(quick):
    rows = list(csv.DictReader(open(quick / "results/training_speed_peer.csv")))
    assert int(rows[-1]["updates"]) > 30 and int(rows[-1]["step"]) >= 2000


def test_agents_are_needed_before_their_closed_loops(tmp_path):
    command = [
        sys.executable,
        "experiments/linear/value_mpc.py",
        "--runs",
        str(tmp_path),
        "--out",
        str(tmp_path),
    ]
    out = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600)
    assert out.returncode == 2 and "--study train" in out.stderr and "Traceback" not in out.stderr


@pytest.mark.parametrize(
    "name, arguments, words",
    [
        ("linear/scalability", ["--jobs", "0"], ["--jobs", "0"]),
        ("linear/scalability", ["--systems", "0"], ["--systems", "0"]),
        ("linear/value_mpc", ["--horizon", "0"], ["--horizon", "0"]),
        ("linear/value_mpc", ["--study", "train", "--dim", "600"], ["--dim", "600"]),
        ("linear/value_mpc", ["--plot-only", "--out", "{}"], ["--plot-only", "does not exist"]),
        ("linear/value_mpc", ["--out", "README.md/x"], ["--out", "cannot write"]),
    ],
)
def test_bad_arguments_get_one_sentence_and_exit_code_2(name, arguments, words, tmp_path):
    command = [
        sys.executable,
        f"experiments/{name}.py",
        "--runs",
        str(tmp_path),
        *(a.format(tmp_path) for a in arguments),
    ]
    out = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600)
    assert out.returncode == 2 and "Traceback" not in out.stderr
    assert all(word in out.stderr for word in words), out.stderr


def test_the_animation_is_small_enough_for_the_readme():
    assert (ROOT / "experiments/figures/dip_profile.gif").stat().st_size < 2e6


def test_the_oracle_is_no_worse_than_any_controller():
    """In its own objective, but for local optima, which the table counts and which are few."""
    for row in csv.DictReader(open(ROOT / "experiments/results/cstr_oracle_gap.csv")):
        assert int(row["negative"]) <= 0.05 * int(row["draws"]), row
    found = list(csv.DictReader(open(ROOT / "experiments/results/cstr_oracle.csv")))
    for row in found:
        weight, slack = float(row["weight"]), float(row["slack"])
        assert float(row["objective"]) == pytest.approx(
            float(row["time_near_goal"]) - weight * slack, abs=1e-4
        )


def test_the_tuned_benchmark_is_the_best_of_its_table():
    rows = list(csv.DictReader(open(ROOT / "experiments/results/cstr_tune.csv")))
    for solver, tuned in (("anytime", tune.TUNED), ("IPOPT", tune.TUNED_IPOPT)):
        mine = [row for row in rows if row.get("solver", "IPOPT") == solver]
        assert tune.GRID[max(mine, key=lambda row: float(row["score"]))["variant"]] == tuned


def test_the_oracles_plan_is_feasible_and_better_than_its_guess():
    problem, x0, psi = (
        oracle.Oracle(20, compile=False),
        np.array([0.8, 0.4, 120.0, 118.0]),
        np.array([1.02, 0.95]),
    )
    guess = np.tile([20.0, -2000.0], (20, 1))
    u = problem.optimum(x0, psi, 5.0, guess)
    assert ((cstr.U_LOW - 1e-6 <= u) & (u <= cstr.U_HIGH + 1e-6)).all()
    (near, _, slack), (near_guess, _, slack_guess) = (
        oracle.measure(x0, psi, actions) for actions in (u, guess)
    )
    assert near - 5 * slack > near_guess - 5 * slack_guess
    assert -problem.objective == pytest.approx(near - 5 * slack, abs=1e-4)  # the model is the plant


def test_a_critic_per_scenario_equals_twin_critics_one_by_one():
    """offline.py's critics, all evaluated at once, against TwinCritic for each pair."""
    network = dict(n_in=5, n_u=2, hidden=[8, 8])
    many, z, a = offline.ManyCritics(3, **network), torch.randn(3, 4, 5), torch.randn(3, 4, 2)
    together, alone = many.each(z, a), many.each(z[0], a[0])
    for i in range(3):
        twin = offline.sac.TwinCritic(**network)
        twin.load_state_dict({k: v[2 * i : 2 * i + 2] for k, v in many.state_dict().items()})
        torch.testing.assert_close(together[i], twin(z[i], a[i]))
        torch.testing.assert_close(alone[i], twin(z[0], a[0]))
    torch.testing.assert_close(many(z[0], a[0]), alone.mean(0))


def test_shipped_critics_are_the_first_seed_of_the_committed_table():
    """experiments/pretrained/*.txt quotes the table; the table's first seed is the default command."""
    table = list(csv.DictReader(open(ROOT / "experiments/results/cstr_training_seeds.csv")))
    for scenarios in ("robust", "nominal"):
        row = next(row for row in table if row["scenarios"] == scenarios and row["seed"] == "0")
        text = (ROOT / f"experiments/pretrained/cstr_{scenarios}.txt").read_text()
        assert (
            f"{float(row['robust_median_ape']):.2f} %" in text
            and f"{float(row['nominal_median_ape']):.2f} %" in text
        )
    first = next(csv.DictReader(open(ROOT / "experiments/results/linear_value_mpc_training.csv")))
    text = (ROOT / "experiments/pretrained/linear_robust.txt").read_text()
    assert (first["n"], first["system"]) == ("32", "0") and f"{float(first['error_median']):.2f} %" in text
