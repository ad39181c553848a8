"""A do-mpc controller as a process, for benchmark_peers.py: runs in an environment of its own (requirements-peers*.txt).

The first line of its standard input is a problem as JSON. Then it answers lines {"x": state, "new": whether an episode starts} with
lines of JSON: the action, the time of make_step, and what IPOPT said. The optimal control problems follow the authors' templates; the
model is this repository's, as Runge-Kutta steps (a discrete model) or as the ordinary differential equation (do-mpc's collocation).
"""

import json
import os
import sys
import tempfile
import time
from pathlib import Path

answers = os.fdopen(os.dup(1), "w")
os.dup2(2, 1)  # whatever else is printed must not get between the answers

import casadi as ca
import do_mpc
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
import envs


def silu(h):
    return h / (1 + ca.exp(-h))


def native_value(weights):
    """V(x, goal) in CasADi operations, float64."""
    w = {k: np.array(v) for k, v in weights.items()}
    x, goal = ca.MX.sym("x", w["x_center"].size), ca.MX.sym("goal", w["error_scale"].size)

    def mlp(name, h):
        n = len([k for k in w if k.startswith(name + "_w")])
        for i in range(n):
            h = w[f"{name}_w{i}"] @ h + w[f"{name}_b{i}"]
            h = silu(h) if i < n - 1 else h
        return h

    z = ca.vertcat(
        (x - w["x_center"]) / w["x_scale"], (goal - x[w["goal_index"].tolist()]) / w["error_scale"]
    )
    return ca.Function("V", [x, goal], [mlp("critic", ca.vertcat(z, ca.tanh(mlp("actor", z))))])


def l4casadi_value(weights):
    """The same network as a torch module behind L4CasADi, float32 as in the authors' scripts."""
    import l4casadi
    import torch

    w = {
        k: torch.tensor(v, dtype=torch.long if k == "goal_index" else torch.float32)
        for k, v in weights.items()
    }
    n_x = len(w["x_center"])

    class Value(torch.nn.Module):
        def forward(self, inputs):  # (1, n_x + n_goal)
            x, goal = inputs[..., :n_x], inputs[..., n_x:]
            z = torch.cat(
                [(x - w["x_center"]) / w["x_scale"], (goal - x[..., w["goal_index"]]) / w["error_scale"]],
                dim=-1,
            )

            def mlp(name, h):
                n = len([k for k in w if k.startswith(name + "_w")])
                for i in range(n):
                    h = torch.nn.functional.linear(h, w[f"{name}_w{i}"], w[f"{name}_b{i}"])
                    h = torch.nn.functional.silu(h) if i < n - 1 else h
                return h

            return mlp("critic", torch.cat([z, torch.tanh(mlp("actor", z))], dim=-1))

    network = l4casadi.L4CasADi(Value(), model_expects_batch_dim=True, device="cpu")
    x, goal = ca.MX.sym("x", n_x), ca.MX.sym("goal", len(w["error_scale"]))
    return ca.Function("V", [x, goal], [network(ca.vertcat(x, goal))])


def build(problem):
    """The controller of a problem, and a function that gives the objective of its last solve."""
    plant, dt = envs.load(problem["env"]), envs.load(problem["env"]).DT
    discrete = problem["model"] == "rk4"
    model = do_mpc.model.Model("discrete" if discrete else "continuous", problem["symbols"])
    x = ca.vertcat(*(model.set_variable("_x", name) for name in plant.STATE_NAMES))
    u = ca.vertcat(*(model.set_variable("_u", name) for name in plant.ACTION_NAMES))
    psi = ca.vertcat(*(model.set_variable("_p", name) for name in plant.PSI_NAMES))
    xs, us, psis = (ca.SX.sym(name, v.numel()) for name, v in (("x", x), ("u", u), ("psi", psi)))
    rhs = plant.ode(xs, us, psis, ca)
    if discrete:
        rhs = envs.rk4(plant.ode, xs, us, psis, dt, plant.MODEL_SUBSTEPS, ca)
    rhs = ca.Function("rhs", [xs, us, psis], [rhs])(x, u, psi)
    for i, name in enumerate(plant.STATE_NAMES):
        model.set_rhs(name, rhs[i])
    model.setup()
    x = model.x.cat  # set-up has put symbols of its own in place of those above

    mpc = do_mpc.controller.MPC(model)
    options = {
        "ipopt.print_level": 0,
        "ipopt.sb": "yes",
        "print_time": 0,
        "ipopt.tol": problem["tol"],
        "ipopt.max_iter": 500,
        "ipopt.bound_relax_factor": 0.0,
    }
    mpc.set_param(
        n_horizon=problem["horizon"],
        n_robust=problem["robust_horizon"],
        t_step=dt,
        nlpsol_opts=options,
        store_full_solution=False,
    )
    if not discrete:
        mpc.set_param(
            state_discretization="collocation",
            collocation_type="radau",
            collocation_deg=problem["degree"],
            collocation_ni=1,
        )
    goal = np.array(problem["goal"])
    stage = ca.sumsqr(plant.goal_error(x[plant.GOAL_INDEX], goal, ca))
    if problem["sigma2"]:
        stage = -ca.exp(-stage / (2 * problem["sigma2"]))
    terminal = stage
    if "critic" in problem:
        value = {"l4casadi": l4casadi_value, "casadi": native_value}[problem["network"]](problem["critic"])
        terminal = -value(x, goal)
    mpc.set_objective(lterm=stage, mterm=terminal)
    mpc.set_rterm(**problem["change_weight"])
    for names, kind, scale in (
        (plant.STATE_NAMES, "_x", (plant.INIT_HIGH - plant.INIT_LOW) / 2),
        (plant.ACTION_NAMES, "_u", problem["u_scale"]),
    ):
        for name, value in zip(names, scale):
            mpc.scaling[kind, name] = value
    for i, name in enumerate(plant.ACTION_NAMES):
        mpc.bounds["lower", "_u", name], mpc.bounds["upper", "_u", name] = plant.U_LOW[i], plant.U_HIGH[i]
    for name, (low, high) in problem["hard"].items():
        if low is not None:
            mpc.bounds["lower", "_x", name] = low
        if high is not None:
            mpc.bounds["upper", "_x", name] = high
    for name, (high, price) in problem["soft"].items():
        mpc.set_nl_cons(name, model.x[name], ub=high, soft_constraint=True, penalty_term_cons=price)
    mpc.set_uncertainty_values(**{name: np.array(values) for name, values in problem["uncertainty"].items()})
    mpc.setup()
    objective = ca.Function("objective", [mpc.nlp["x"], mpc.nlp["p"]], [mpc.nlp["f"]])
    constant = ca.Function("stage", [x], [stage])

    def last_objective():
        """Without the stage cost of the measured state, a constant."""
        return float(objective(mpc.opt_x_num, mpc.opt_p_num)) - float(constant(mpc.x0.cat))

    return mpc, last_objective


def main():
    with tempfile.TemporaryDirectory() as folder:  # L4CasADi compiles into the current one
        os.chdir(folder)
        serve(*build(json.loads(sys.stdin.readline())))


def serve(mpc, last_objective):

    def answer(message):
        print(json.dumps(message), file=answers, flush=True)

    answer({"do-mpc": do_mpc.__version__, "casadi": ca.__version__})
    for line in sys.stdin:
        request = json.loads(line)
        x = np.array(request["x"])
        if request["new"]:
            mpc.reset_history()
            mpc.flags["initial_run"] = False  # no multipliers of the last episode
            mpc.u0 = np.zeros(mpc.model.n_u)
            mpc.x0 = x
            mpc.set_initial_guess()
        tick = time.perf_counter()
        u = mpc.make_step(x)
        milliseconds = 1e3 * (time.perf_counter() - tick)
        stats = mpc.solver_stats
        answer(
            {
                "u": u.ravel().tolist(),
                "ms": milliseconds,
                "success": bool(stats["success"]),
                "status": str(stats["return_status"]),
                "iterations": int(stats["iter_count"]),
                "objective": last_objective(),
            }
        )


if __name__ == "__main__":
    main()
