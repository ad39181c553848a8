"""Plants as goal-conditioned gymnasium environments. A module here that has an ENV_ID is a plant, `--env` its name.

A plant is constants and functions, no gymnasium code (`envs/cstr.py` is the pattern). It must name

    ENV_ID, DT                  gymnasium id, sampling time
    STATE_NAMES, STATE_UNITS, ACTION_NAMES, ACTION_UNITS
    X_LOW, X_HIGH               constraint box, (n_x,), infinite where there is no constraint
    U_LOW, U_HIGH               actuator limits, (n_u,)
    GOAL_INDEX                  which states the goal is about
    TRAIN_GOALS, EVAL_GOAL      goals of training (k, n_goal), goal of the evaluation (n_goal,)
    ode(x, u, psi, xp)          time derivative, components along the first axis; xp is numpy, torch or casadi
      or next_state(...)        the state one sampling time later, of a plant in discrete time
    PSI_NOMINAL, PSI_LOW, PSI_HIGH    if something is uncertain: its nominal value and its range, (n_psi,)

It may name, in place of the default in brackets:

    EPISODE_STEPS, TIME_UNIT    steps before truncation (50), unit of DT ("s")
    INIT_LOW, INIT_HIGH         box of initial states, finite; it also scales states (X_LOW, X_HIGH)
    OBS_LOW, OBS_HIGH           box that every reachable state stays in (infinite)
    MEASURED                    names of the states that have sensors (all)
    ANGLES                      indices of states that are angles: networks see sine and cosine (none)
    START, START_NOISE          a start state, and how far a seed moves it (the box's middle, a twentieth of its width)
    PSI_NAMES, SCENARIOS,       sets to draw psi from: "nominal", "mpc" (planners branch over it), "robust" (training);
      EVAL_PSI                  plants of the evaluation (from PSI_LOW and PSI_HIGH: ends and nominal, 10 and 7 each)
    GOAL_LOW, GOAL_HIGH         range of goals (the box of initial states)
    GOAL_REACHABLE              box of those that every scenario can hold, see `reachable_goals` (GOAL_LOW, GOAL_HIGH);
      or held_action(goal)      the action that holds a goal, infinite if none does
    ERROR_SCALE                 a large goal error, (n_goal,), for the networks (a fortieth of the width of the box of
                                initial states, or where that has none of the range of goals)
    REWARD_SIGMA2               sigma^2 of the Gaussian reward ((ERROR_SCALE / 5)^2)
    REWARD_TOLERANCE            half-width of the sparse reward (ERROR_SCALE / 5)
    MPC_SIGMA2, METRIC_SIGMA2   sigma^2 of the planners' stage cost and of the measures ((2 ERROR_SCALE)^2)
    MODEL_SUBSTEPS              Runge-Kutta steps per sampling time in predictions (4)
    step(x, u, psi)             the simulated plant, batched (8 Runge-Kutta steps)
    goal_error(achieved, goal, xp)    its squared norm enters the Gaussian (difference; of angles 1 - cos)
    percentage_error(achieved, goal)  for tables (percent of half the box's width)
    TRAINING                    arguments of sac_her_branching.py whose defaults it changes ({})
    EXPECT                      what sac_her_branching.py is to say of it before it begins ("")
    BENCHMARK                   the MPC that rl_mpc_deploy.py compares with: "horizon" (20), "slack_price" (2, n_x) below
                                and above, inf: a hard bound (all), "change_weight" (n_u,) (0)
    economic_cost(x, xp)        added to RL+MPC's stage cost, to choose among steady states that hold a goal (0)
    MISMATCH_SCALE              for --observe-mismatch: a large difference to the model after one step, (n_x,)
    GOALS, expert_cost, EXPERT_CHANGE_WEIGHT, animate    for goal_mpc.py: goals by name, another objective, a film

A family of plants (`envs/linear.py`) defines `make(dim, system)`, which returns an object with these names; one with a
linear-quadratic regulator has lqr, lq_cost, lq_value, feedback and baseline.

`plant.py` holds defaults and checks, `measures.py` what scripts ask of a plant, `goal_env.py` the environments, `mismatch.py`
what agents may observe of transitions; `control/`, `agents/` and `script/` are what the scripts share beside plants.
"""

import ast
import contextlib
import importlib
import inspect
import re
from functools import cache
from pathlib import Path

import gymnasium as gym
import numpy as np

from envs.goal_env import GoalEnv, VectorGoalEnv, reached_states  # noqa: F401
from envs.measures import (  # noqa: F401
    can_hold,
    checked_goal,
    checked_state,
    goal_reward,
    half_width,
    outside_constraints,
    reachable_goals,
    sample_states,
    scenario_set,
    state_range,
    time_near_goal,
)
from envs.mismatch import Mismatch  # noqa: F401
from envs.plant import Plant, grid, rk4, stack, stepper  # noqa: F401


def _env_id(path):
    """The text that a module assigns to ENV_ID; None if it does not, or is no file. One that is half written is a plant, too."""
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
        if "ENV_ID" not in text:
            return None
        assigned = [
            node for node in ast.walk(ast.parse(text)) if isinstance(node, (ast.Assign, ast.AnnAssign))
        ]
        text = "\n".join(map(ast.unparse, assigned))
    except OSError:  # a folder, a link to nothing
        return None
    except (SyntaxError, ValueError):
        pass
    found = re.search(r"""^[ \t]*ENV_ID\b[^=\n]*=\s*\(?["']([^"']+)["']""", text, re.MULTILINE)
    return found and found[1]


def _ids():
    """{name: ENV_ID} of the plants in this folder (and others on `envs.__path__`), read and not imported: a broken one harms no other."""
    files = sorted(path for folder in __path__ for path in Path(folder).glob("[!.]*.py"))
    found = {path.stem: _env_id(path) for path in files}
    return {name: env_id for name, env_id in found.items() if env_id}


def names():
    """Names of the plants in this folder, the values that `--env` takes."""
    return list(_ids())


def load(name, observe_mismatch=False, **options):
    """The `Plant` of `envs/NAME.py`, or of what its `make(**options)` returns if it has one; options that are None are left out.

    With observe_mismatch, True or its scale (n_x,), it is wrapped as a `Mismatch`. Raises ValueError, one sentence, for a plant that is not
    there (with the list of what is), cannot be imported, lacks a name or shares its ENV_ID, and for an option that it does not take.
    """
    plant = _load(name, tuple(sorted((k, v) for k, v in options.items() if v is not None)))
    if isinstance(observe_mismatch, (bool, np.bool_)):
        return Mismatch(plant) if observe_mismatch else plant
    return Mismatch(plant, observe_mismatch)


@cache
def _load(name, options):
    ids = _ids()
    if name not in ids:
        raise ValueError(f"--env {name!r} is not a plant of this folder; choose one of {', '.join(ids)}")
    same = sorted(other for other, env_id in ids.items() if env_id == ids[name])
    if len(same) > 1:
        raise ValueError(
            f"--env {name}: {' and '.join(f'envs/{other}.py' for other in same)} have the same ENV_ID; give one another"
        )
    if not _register(name, ids[name]):
        raise ValueError(f"envs/{name}.py: ENV_ID is {ids[name]!r}, {_trouble(ids[name])}")
    try:
        module = importlib.import_module(f"{__name__}.{name}")
    except (Exception, SystemExit) as error:  # whatever a half-written plant raises
        raise ValueError(f"envs/{name}.py cannot be imported ({type(error).__name__}: {error})") from error
    known = inspect.signature(module.make).parameters if hasattr(module, "make") else ()
    for option, _ in options:
        if option not in known:
            raise ValueError(f"--{option} is not an option of --env {name}")
    return Plant(module.make(**dict(options)) if hasattr(module, "make") else module, name, options)


def _register(name, env_id):
    """Tell gymnasium of a plant; returns whether it knows it: it may refuse the id, or have it already."""
    if env_id not in gym.registry:
        with contextlib.suppress(gym.error.Error):
            made_by = dict(entry_point="envs:GoalEnv", vector_entry_point="envs:VectorGoalEnv")
            gym.register(env_id, **made_by, kwargs={"plant": name})
    return env_id in gym.registry and gym.registry[env_id].kwargs.get("plant") == name


def _trouble(env_id):
    """Why gymnasium does not take an id."""
    if env_id not in gym.registry:
        return "which gymnasium refuses; it must be one text such as 'Word/Word-v0'"
    owner = gym.registry[env_id].kwargs.get("plant")
    return f"which is already that of {f'envs/{owner}.py' if owner else 'another environment'}"


for _name, _id in _ids().items():
    _register(_name, _id)
