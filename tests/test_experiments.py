"""Every experiment runs on a tiny budget and writes finite numbers; every committed figure can be redrawn from its CSV."""

import csv
import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parent.parent
EXPERIMENTS = {
    "cstr_training": ["cstr_training.csv", "cstr_training_seeds.csv"],
    "cstr_profile": ["cstr_profile.csv"],
    "dip_performance": ["dip_performance.csv"],
    "dip_equilibria": ["dip_equilibria.csv", "dip_profile.csv"],
    "solve_time": ["solve_time_where.csv", "solve_time_scaling.csv"],
}
FIGURES = {name: name for name in EXPERIMENTS} | {"dip_equilibria": "dip_profile"}
LINEAR_TABLES = (
    "linear_scalability",
    "linear_scalability_sweep",
    "linear_value_mpc_training",
    "linear_value_mpc",
    "linear_value_mpc_profile",
    "linear_value_mpc_distance",
    "linear_value_mpc_times",
)
LINEAR_FIGURES = {
    "linear_scalability",
    "linear_scalability_jensen",
    "linear_scalability_sweep",
    "linear_value_mpc",
    "linear_value_mpc_distance",
    "linear_value_mpc_times",
}
LINEAR_STUDIES = [("linear_scalability", "main"), ("linear_scalability", "sweep")]
LINEAR_STUDIES += [("linear_value_mpc", study) for study in ("profile", "distance", "scaling")]
REACTOR = [  # script, study, tables, figures; in this order
    ("cstr_deploy", None, ["cstr_deploy"], ["cstr_deploy", "cstr_deploy_full"]),
    ("cstr_deploy", "critics", ["cstr_critics"], ["cstr_critics"]),
    ("cstr_deploy", "literal", ["cstr_literal"], ["cstr_literal"]),
    ("cstr_deploy", "expansion", ["cstr_expansion"], ["cstr_expansion"]),
    ("cstr_oracle", None, ["cstr_oracle", "cstr_oracle_gap"], []),
    ("cstr_frontier", None, ["cstr_frontier"], ["cstr_frontier"]),
    ("cstr_ablation", None, ["cstr_ablation"], ["cstr_ablation"]),
    ("cstr_shift", None, ["cstr_shift"], ["cstr_shift"]),
    ("cstr_shift", "critic", ["cstr_shift_critic"], ["cstr_shift_critic"]),
    ("cstr_tune", None, ["cstr_tune"], []),
    ("cstr_offline", None, ["cstr_offline"], ["cstr_offline"]),
    ("cstr_offline", "ablation", ["cstr_offline_ablation"], ["cstr_offline_ablation"]),
    ("cstr_offset_free", "training", ["cstr_offset_free_training"], ["cstr_offset_free_training"]),
    ("cstr_offset_free", None, ["cstr_offset_free", "cstr_offset_free_profile"], ["cstr_offset_free"]),
]
NO_RUNS = {"cstr_profile", "dip_equilibria", "solve_time"}  # too short to be kept in parts
TEXT = {
    "case",
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
}


def run(name, *arguments):
    command = [sys.executable, f"experiments/{name}.py", *map(str, arguments)]
    out = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600)
    assert out.returncode == 0, out.stderr


def check_table(table, folder):
    """The columns of the committed table, and finite numbers in both."""
    rows = list(csv.DictReader(open(folder / "results" / table)))
    committed = list(csv.DictReader(open(ROOT / "experiments/results" / table)))
    assert rows and list(rows[0]) == list(committed[0])
    for row in rows + committed:
        # the weight of a hard bound is infinite
        assert all(np.isfinite(float(value)) for key, value in row.items() if key not in TEXT and (key, value) != ("slack_weight", "inf"))
        assert "psi" not in row or len(json.loads(row["psi"])) == 2


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_quick_run(name, tmp_path):
    keep = ["--runs", tmp_path / "runs"] if name not in NO_RUNS else []
    run(name, "--quick", "--out", tmp_path, *keep)
    assert (tmp_path / "figures" / f"{FIGURES[name]}.png").stat().st_size > 10_000
    for table in EXPERIMENTS[name]:
        check_table(table, tmp_path)


def test_linear_experiments(tmp_path):
    """Their studies build on each other; a second call finds everything done."""
    keep = ["--quick", "--out", tmp_path, "--runs", tmp_path / "runs"]
    for study in ("main", "sweep"):
        run("linear_scalability", "--study", study, *keep)
    for study in ("train", "profile", "distance", "scaling", "train", "profile"):
        run("linear_value_mpc", "--study", study, *keep)
    for table in LINEAR_TABLES:
        check_table(f"{table}.csv", tmp_path)
    assert {path.stem for path in (tmp_path / "figures").iterdir()} == LINEAR_FIGURES
    agents = list((tmp_path / "runs/agents").glob("*/*/wall_seconds.txt"))
    assert len(agents) == 3  # the second call trained none again


@pytest.mark.parametrize("name, study", LINEAR_STUDIES)
def test_linear_figures_are_drawn_from_the_committed_tables(name, study, tmp_path):
    shutil.copytree(ROOT / "experiments/results", tmp_path / "results")
    run(name, "--study", study, "--plot-only", "--out", tmp_path)
    assert all(path.stat().st_size > 10_000 for path in (tmp_path / "figures").iterdir())


def test_training_speed(tmp_path):
    for study in ("ablation", "peer", "profile"):
        run("training_speed", "--study", study, "--quick", "--out", tmp_path, "--runs", tmp_path / "runs")
        check_table(f"training_speed_{study}.csv", tmp_path)
    assert (tmp_path / "figures/training_speed.png").stat().st_size > 10_000
    rows = list(csv.DictReader(open(tmp_path / "results/training_speed_peer.csv")))
    assert int(rows[-1]["updates"]) > 30 and int(rows[-1]["step"]) >= 2000


def test_benchmark_without_peers_says_so_and_measures_the_rest(tmp_path):
    """The peers are not in the requirements of the tests; the committed table holds them."""
    keep = ["--out", tmp_path, "--runs", tmp_path / "runs"]
    run("benchmark_peers", "--quick", "--peers", tmp_path / "no", "--peers-new", tmp_path / "no", *keep)
    rows, committed = (list(csv.DictReader(open(folder / "results/benchmark_peers.csv"))) for folder in (tmp_path, ROOT / "experiments"))
    assert list(rows[0]) == list(committed[0])
    for row in rows:
        assert row["peer_status"] == "not installed" and row["ratio_of_medians"] == ""
        assert float(row["ours_ms_median"]) > 0 and row["ours_failed"] == "0"
    for row in committed:
        if row["same_optimum"] and row["critic"] == "random":
            assert float(row["same_optimum"]) < 1e-4, row["peer"]
        assert bool(row["ratio_of_medians"]) == (row["peer_failed"] == "0")  # no ratio where the peer did not converge


@pytest.mark.parametrize("name", ["training_speed", "benchmark_peers"])
def test_speed_figures_are_drawn_from_the_committed_tables(name, tmp_path):
    shutil.copytree(ROOT / "experiments/results", tmp_path / "results")
    run(name, "--plot-only", "--out", tmp_path)
    assert (tmp_path / f"figures/{name}.png").stat().st_size > 10_000


def test_agents_are_needed_before_their_closed_loops(tmp_path):
    command = [sys.executable, "experiments/linear_value_mpc.py", "--runs", str(tmp_path), "--out", str(tmp_path)]
    out = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600)
    assert out.returncode == 2 and "--study train" in out.stderr and "Traceback" not in out.stderr


@pytest.mark.parametrize(
    "name, arguments, words",
    [
        ("linear_scalability", ["--jobs", "0"], ["--jobs", "0"]),
        ("linear_scalability", ["--systems", "0"], ["--systems", "0"]),
        ("linear_value_mpc", ["--horizon", "0"], ["--horizon", "0"]),
        ("linear_value_mpc", ["--study", "train", "--dim", "600"], ["--dim", "600"]),
        ("linear_value_mpc", ["--plot-only", "--out", "{}"], ["--plot-only", "does not exist"]),
        ("linear_value_mpc", ["--out", "README.md/x"], ["--out", "cannot write"]),
    ],
)
def test_bad_arguments_get_one_sentence_and_exit_code_2(name, arguments, words, tmp_path):
    command = [sys.executable, f"experiments/{name}.py", "--runs", str(tmp_path), *(a.format(tmp_path) for a in arguments)]
    out = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600)
    assert out.returncode == 2 and "Traceback" not in out.stderr
    assert all(word in out.stderr for word in words), out.stderr


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_figures_are_drawn_from_the_committed_tables(name, tmp_path):
    shutil.copytree(ROOT / "experiments/results", tmp_path / "results")
    run(name, "--plot-only", "--out", tmp_path)
    assert (tmp_path / "figures" / f"{FIGURES[name]}.png").stat().st_size > 10_000


def test_the_animation_is_small_enough_for_the_readme():
    assert (ROOT / "experiments/figures/dip_profile.gif").stat().st_size < 2e6


def test_reactor_study(tmp_path):
    """Its scripts build on each other; a second call of the first finds everything done."""
    keep = ["--quick", "--out", tmp_path, "--runs", tmp_path / "runs"]
    for name, study, _, _ in REACTOR:
        run(name, *(["--study", study] if study else []), *keep)
    kept = {path: path.stat().st_mtime_ns for path in (tmp_path / "runs").glob("*.csv")}
    run("cstr_deploy", *keep)
    assert kept == {path: path.stat().st_mtime_ns for path in (tmp_path / "runs").glob("*.csv")}
    for _, _, tables, figures in REACTOR:
        for table in tables:
            check_table(f"{table}.csv", tmp_path)
        assert all((tmp_path / f"figures/{figure}.png").stat().st_size > 10_000 for figure in figures)


@pytest.mark.parametrize("name, study, tables, figures", [part for part in REACTOR if part[2]])
def test_reactor_figures_are_drawn_from_the_committed_tables(name, study, tables, figures, tmp_path):
    shutil.copytree(ROOT / "experiments/results", tmp_path / "results")
    run(name, *(["--study", study] if study else []), "--plot-only", "--out", tmp_path)
    assert all((tmp_path / f"figures/{figure}.png").stat().st_size > 10_000 for figure in figures)


def test_the_oracle_is_no_worse_than_any_controller():
    """In its own objective, but for local optima, which the table counts and which are few."""
    for row in csv.DictReader(open(ROOT / "experiments/results/cstr_oracle_gap.csv")):
        assert int(row["negative"]) <= 0.05 * int(row["draws"]), row
    found = list(csv.DictReader(open(ROOT / "experiments/results/cstr_oracle.csv")))
    for row in found:
        weight, slack = float(row["weight"]), float(row["slack"])
        assert float(row["objective"]) == pytest.approx(float(row["time_near_goal"]) - weight * slack, abs=1e-4)


def test_the_tuned_benchmark_is_the_best_of_its_table():
    sys.path.insert(0, str(ROOT / "experiments"))
    import cstr_deploy
    import cstr_tune

    best = max(csv.DictReader(open(ROOT / "experiments/results/cstr_tune.csv")), key=lambda row: float(row["score"]))
    assert cstr_tune.GRID[best["variant"]] == cstr_deploy.TUNED


def test_the_oracles_plan_is_feasible_and_better_than_its_guess():
    sys.path.insert(0, str(ROOT / "experiments"))
    import cstr_oracle

    from envs import cstr

    problem, x0, psi = cstr_oracle.Oracle(20, compile=False), np.array([0.8, 0.4, 120.0, 118.0]), np.array([1.02, 0.95])
    guess = np.tile([20.0, -2000.0], (20, 1))
    u = problem.solve(x0, psi, 5.0, guess)
    assert ((cstr.U_LOW - 1e-6 <= u) & (u <= cstr.U_HIGH + 1e-6)).all()
    (near, _, slack), (near_guess, _, slack_guess) = (cstr_oracle.measure(x0, psi, actions) for actions in (u, guess))
    assert near - 5 * slack > near_guess - 5 * slack_guess
    assert -problem.last_objective == pytest.approx(near - 5 * slack, abs=1e-4)  # the model is the plant


def test_a_critic_per_scenario_equals_twin_critics_one_by_one():
    """cstr_offline.py's critics, all evaluated at once, against TwinCritic for each pair."""
    sys.path.insert(0, str(ROOT / "experiments"))
    import cstr_offline
    import torch

    network = dict(n_in=5, n_u=2, hidden=[8, 8])
    many, z, a = cstr_offline.ManyCritics(3, **network), torch.randn(3, 4, 5), torch.randn(3, 4, 2)
    together, alone = many.each(z, a), many.each(z[0], a[0])
    for i in range(3):
        twin = cstr_offline.sac.TwinCritic(**network)
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
        assert f"{float(row['robust_median_ape']):.2f} %" in text and f"{float(row['nominal_median_ape']):.2f} %" in text
    first = next(csv.DictReader(open(ROOT / "experiments/results/linear_value_mpc_training.csv")))
    text = (ROOT / "experiments/pretrained/linear_robust.txt").read_text()
    assert (first["n"], first["system"]) == ("32", "0") and f"{float(first['error_median']):.2f} %" in text
