"""How good a trained agent is: the paper's protocol, on the same start states and plants whatever seed the agent was trained with."""

import numpy as np

import envs

SEED = 0


def evaluate(policy, goal, episodes, robust, seed=SEED):
    """Start states uniform in the plant's box, one episode each (cstr: 50 steps) to the goal (n_goal,).

    Robust: psi drawn per episode from the plant's evaluation set and held; otherwise the nominal plant. Returns of each
    episode, (episodes,), the mean absolute percentage error of its second half, its time outside constraints in percent of
    the steps (`envs.outside_constraints`), and whether its plant is held out from the training grid.
    """
    plant, rng = policy.plant, np.random.default_rng([seed, 1])
    steps = plant.EPISODE_STEPS
    x = envs.sample_states(plant, rng, episodes)
    psi = rng.choice(plant.EVAL_PSI, size=episodes)
    if not robust:
        psi = np.broadcast_to(plant.PSI_NOMINAL, psi.shape)
    errors, outside = [], []
    for _ in range(steps):
        x = plant.step(x, policy.act(x, goal), psi)
        errors.append(plant.percentage_error(x[:, plant.GOAL_INDEX], np.asarray(goal)))
        outside.append(-100 * envs.outside_constraints(plant, x))
    held_out = ~np.isclose(psi[:, None], plant.SCENARIOS["robust"]).all(-1).any(-1)
    return np.mean(errors[steps - steps // 2 :], axis=0), np.mean(outside, axis=0), held_out


def evaluation_row(policy, episodes):
    """Medians and 75th percentiles that evaluations.csv and tensorboard report, in percent. Raises ValueError if they are not finite."""
    row = {}
    for name in ("robust", "nominal"):
        errors, outside, held_out = evaluate(policy, policy.plant.EVAL_GOAL, episodes, name == "robust")
        row |= {f"{name}_median_ape": np.median(errors), f"{name}_p75_ape": np.quantile(errors, 0.75)}
        if name == "robust" and held_out.any():
            row["robust_held_out_median_ape"] = np.median(errors[held_out])
        row |= {
            f"{name}_median_outside": np.median(outside),
            f"{name}_p75_outside": np.quantile(outside, 0.75),
        }
    if not np.isfinite(list(row.values())).all():
        raise ValueError("the agent's actions are not finite: training diverged; try a lower --learning-rate")
    return {name: float(value) for name, value in row.items()}


def evaluation_table(row):
    """An `evaluation_row` as text."""
    lines = ["median [75th percentile] over starts      error, %      time outside constraints, %"]
    for name in ("robust", "nominal"):
        columns = [(row[f"{name}_median_{key}"], row[f"{name}_p75_{key}"]) for key in ("ape", "outside")]
        shown = "".join(f"{median:17.2f} [{p75:6.2f}]" for median, p75 in columns)
        lines.append(f"{name} evaluation".ljust(20) + shown)
    return "\n".join(lines)
