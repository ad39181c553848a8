"""What a plant is: the names that a module of this folder has, their defaults and checks, and Runge-Kutta steps."""

import copy
import itertools

import numpy as np


def stack(xp, rows):
    """Join the components of a derivative into one array, for numpy, torch and casadi alike (components along the first axis)."""
    if xp is np:
        return np.array(rows)  # half the time of np.stack at a batch of 1,024
    return xp.vertcat(*rows) if hasattr(xp, "vertcat") else xp.stack(rows)


def rk4(ode, x, u, psi, dt, substeps, xp=np):
    """Classical Runge-Kutta steps of `ode(x, u, psi, xp)` over `dt` with the input held (components along the first axis)."""
    h = dt / substeps
    for _ in range(substeps):
        k1 = ode(x, u, psi, xp)
        k2 = ode(x + h / 2 * k1, u, psi, xp)
        k3 = ode(x + h / 2 * k2, u, psi, xp)
        k4 = ode(x + h * k3, u, psi, xp)
        k2 += k3  # in place: a fifth faster than x + h / 6 * (k1 + 2 * (k2 + k3) + k4), which it computes
        k2 *= 2
        k2 += k1
        k2 += k4
        k2 *= h / 6
        x = x + k2
    return x


def stepper(ode, dt, substeps=8):
    """The simulated plant: `step(x, u, psi)`, the state one sampling time later with u held, batched over the leading axes, (..., n)."""

    def step(x, u, psi, substeps=substeps):
        first = [np.moveaxis(np.asarray(a, dtype=np.float64), -1, 0) for a in (x, u, psi)]
        x, u, psi = map(np.ascontiguousarray, first)
        return np.moveaxis(rk4(ode, x, u, psi, dt, substeps), 0, -1).copy()

    return step


def grid(*values):
    """All combinations of values of each parameter, (combinations, n_psi), the last parameter changing fastest."""
    return np.array(list(itertools.product(*values)), dtype=float)


REQUIRED = ["ENV_ID", "DT", "STATE_NAMES", "STATE_UNITS", "X_LOW", "X_HIGH", "ACTION_NAMES", "ACTION_UNITS"]
REQUIRED += ["U_LOW", "U_HIGH", "GOAL_INDEX", "TRAIN_GOALS", "EVAL_GOAL"]
# numbers per state, action, parameter and goal; of those with a star any number of rows
SHAPES = {"n_x": "X_LOW X_HIGH INIT_LOW INIT_HIGH OBS_LOW OBS_HIGH START START_NOISE MISMATCH_SCALE"}
SHAPES |= {"n_u": "U_LOW U_HIGH", "n_psi": "PSI_NOMINAL PSI_LOW PSI_HIGH", "*n_psi": "EVAL_PSI"}
SHAPES |= {"n_goal": "EVAL_GOAL GOAL_LOW GOAL_HIGH ERROR_SCALE", "*n_goal": "TRAIN_GOALS"}
SHAPES = {name: shape for shape, names in SHAPES.items() for name in names.split()}
POSITIVE = "DT ERROR_SCALE REWARD_SIGMA2 REWARD_TOLERANCE MPC_SIGMA2 METRIC_SIGMA2 MISMATCH_SCALE".split()
WHOLE = "EPISODE_STEPS", "MODEL_SUBSTEPS"
KEYS = {"BENCHMARK": ["horizon", "slack_price", "change_weight"]}
KEYS["TRAINING"] = ["hidden", "total_timesteps", "num_envs", "gamma"]
KEYS["TRAINING"] += ["steps_per_update", "learning_starts", "buffer_size", "alpha_init"]
MAY_BE_INFINITE = "X_LOW", "X_HIGH", "OBS_LOW", "OBS_HIGH"


class Plant:
    """A plant module, or what its `make` returns, with what it leaves out; see `envs/__init__.py` for the names.

    It holds copies: arrays of floats, indices as lists. Raises ValueError, one sentence, for a name that is missing, of the wrong shape or
    out of order.
    """

    def __init__(self, source, name, options=()):
        self.source, self.name, self.options = source, name, dict(options)
        missing = [each for each in REQUIRED if not hasattr(source, each)]
        missing += [] if hasattr(source, "ode") or hasattr(source, "next_state") else ["ode"]
        if missing:
            raise ValueError(f"envs/{name}.py lacks {', '.join(missing)}")
        vars(self).update(_copies(source, name))
        _check(self, name)
        defaults = _defaults(self)
        self.own_step = getattr(source, "step", defaults["step"])
        benchmark = defaults["BENCHMARK"] | getattr(self, "BENCHMARK", {})  # may name some of it
        vars(self).update({k: v for k, v in defaults.items() if not hasattr(self, k)}, BENCHMARK=benchmark)
        _check(self, name)
        _try_a_step(self)

    def step(self, x, u, psi=None, *more, **options):
        """State one sampling time later, (..., n_x), of x (..., n_x), u (..., n_u), psi (..., n_psi) or the nominal ones.

        What else is given the plant's own `step` gets. Raises ValueError for another number of states, actions or parameters, which numpy
        might broadcast.
        """
        psi = self.PSI_NOMINAL if psi is None else psi
        for name, value, like in (("x", x, self.X_LOW), ("u", u, self.U_LOW), ("psi", psi, self.PSI_NOMINAL)):
            if np.shape(value)[-1:] != like.shape:
                raise ValueError(f"{name} has shape {np.shape(value)}; {self.ENV_ID} has {len(like)}")
        return self.own_step(x, u, psi, *more, **options)

    def __getattr__(self, name):
        if name == "source" or name.startswith("__"):  # not yet there, while it is copied
            raise AttributeError(name)
        if hasattr(self.source, name):
            return getattr(self.source, name)
        raise AttributeError(f"plant {self.name} has no {name}")

    def __reduce__(self):
        from envs import load  # a copy is the same plant: a module has no state

        return _reload, (load, self.name, self.options)

    def __repr__(self):
        return f"<plant {self.name}{self.options or ''}>"


def _reload(load, name, options):
    return load(name, **options)


def _floats(value):
    return np.array(value, dtype=float)


def _texts(value):
    return (value,) if isinstance(value, str) else tuple(value)


COPIES = dict.fromkeys(SHAPES, _floats)
COPIES |= dict.fromkeys(("GOAL_INDEX", "ANGLES"), lambda value: np.atleast_1d(value).tolist())
COPIES |= dict.fromkeys(("STATE_NAMES", "STATE_UNITS", "ACTION_NAMES", "ACTION_UNITS"), _texts)
COPIES |= dict.fromkeys(("MEASURED", "PSI_NAMES"), _texts)
COPIES |= dict.fromkeys(("SCENARIOS", "GOALS"), lambda sets: {k: _floats(v) for k, v in sets.items()})
COPIES |= {"GOAL_REACHABLE": _floats} | dict.fromkeys(KEYS, copy.deepcopy)


def _copies(source, name):
    """Copies of the constants that a plant's source has, in the types that everything else relies on."""
    found = {}
    for each in filter(lambda each: hasattr(source, each), COPIES):
        value = getattr(source, each)
        try:
            found[each] = COPIES[each](value)
        except (TypeError, ValueError, AttributeError) as error:
            raise ValueError(f"envs/{name}.py: {each} is {value!r} ({error})") from None
    return found


def _defaults(p):
    """Of every name that a plant need not have, its value."""
    given = lambda name, default: np.array(getattr(p, name, default), dtype=float)  # noqa: E731
    init_low, init_high = given("INIT_LOW", p.X_LOW), given("INIT_HIGH", p.X_HIGH)
    with np.errstate(invalid="ignore"):  # infinite boxes are refused below
        half, middle = (init_high - init_low) / 2, (init_low + init_high) / 2
    index, angles = p.GOAL_INDEX, getattr(p, "ANGLES", [])
    goal_low, goal_high = given("GOAL_LOW", init_low[index]), given("GOAL_HIGH", init_high[index])
    # a state may always start at one value
    wide = np.where(half[index] > 0, half[index], (goal_high - goal_low) / 2)
    scale = given("ERROR_SCALE", 0.05 * wide)
    width, turning = float(np.mean(scale)), np.isin(index, angles)

    nominal = given("PSI_NOMINAL", [])
    ends = [given(name, nominal) for name in ("PSI_LOW", "PSI_HIGH")]
    if nominal.size <= 2:
        robust, evaluated = (grid(*np.linspace(*ends, n).T) for n in (10, 7))
    else:  # a grid would be huge
        robust = np.random.default_rng(0).uniform(*ends, size=(1000, nominal.size))
        evaluated = np.random.default_rng(1).uniform(*ends, size=(200, nominal.size))
    few = grid(*np.transpose([nominal, *ends])) if nominal.size <= 3 else np.stack([nominal, *ends])
    few = np.concatenate([nominal[None], few[(few != nominal).any(axis=1)]])
    sets = {"nominal": nominal[None], "mpc": few, "robust": robust}

    def goal_error(achieved, goal, xp=np):
        error = achieved - goal
        if not turning.any():
            return error
        if hasattr(xp, "vertcat"):
            return xp.vertcat(*(1 - xp.cos(error[i]) if turn else error[i] for i, turn in enumerate(turning)))
        return xp.stack(
            [1 - xp.cos(error[..., i]) if turn else error[..., i] for i, turn in enumerate(turning)], -1
        )

    def percentage_error(achieved, goal):
        error = np.where(turning, (achieved - goal + np.pi) % (2 * np.pi) - np.pi, achieved - goal)
        return (100 * np.abs(error) / np.where(turning, np.pi, wide)).mean(-1)

    values = dict(
        EPISODE_STEPS=50,
        TIME_UNIT="s",
        INIT_LOW=init_low,
        INIT_HIGH=init_high,
        ANGLES=[],
        MODEL_SUBSTEPS=4,
        MEASURED=tuple(p.STATE_NAMES),
        TRAINING={},
        EXPECT="",
    )
    values |= dict(OBS_LOW=np.full(len(half), -np.inf), OBS_HIGH=np.full(len(half), np.inf))
    values |= dict(START=middle, START_NOISE=half / 10)
    values |= dict(
        PSI_NAMES=tuple(f"psi_{i + 1}" for i in range(nominal.size)),
        PSI_NOMINAL=nominal,
        SCENARIOS=sets,
        EVAL_PSI=evaluated,
    )
    values |= dict(
        GOAL_LOW=goal_low, GOAL_HIGH=goal_high, GOAL_REACHABLE=(goal_low, goal_high), ERROR_SCALE=scale
    )
    values |= dict(
        REWARD_SIGMA2=(width / 5) ** 2,
        REWARD_TOLERANCE=width / 5,
        MPC_SIGMA2=(2 * width) ** 2,
        METRIC_SIGMA2=(2 * width) ** 2,
    )
    benchmark = dict(
        horizon=20, slack_price=np.full((2, len(half)), np.inf), change_weight=np.zeros(len(p.U_LOW))
    )
    values |= dict(
        BENCHMARK=benchmark,
        economic_cost=lambda x, xp=np: 0,
        goal_error=goal_error,
        percentage_error=percentage_error,
    )
    if hasattr(p, "ode"):
        values["step"] = stepper(p.ode, p.DT)
    else:
        values["MODEL_SUBSTEPS"] = 1

        def step(x, u, psi):
            return np.moveaxis(
                p.next_state(*(np.moveaxis(np.asarray(a, dtype=float), -1, 0) for a in (x, u, psi))), 0, -1
            )

        values["step"] = step
    return values


def _check(p, name):
    """Shapes, order and finite numbers of the names that p has."""
    n_x, n_u, n_goal = len(p.STATE_NAMES), len(p.ACTION_NAMES), len(p.GOAL_INDEX)
    sizes = {"n_x": n_x, "n_u": n_u, "n_goal": n_goal, "n_psi": np.size(getattr(p, "PSI_NOMINAL", []))}

    def refuse(sentence):
        raise ValueError(f"envs/{name}.py: {sentence}")

    # names and indices
    for names, units in (("STATE_NAMES", "STATE_UNITS"), ("ACTION_NAMES", "ACTION_UNITS")):
        if len(getattr(p, units)) != len(getattr(p, names)):
            refuse(f"{units} are {len(getattr(p, units))}, {names} {len(getattr(p, names))}")
        if len(set(getattr(p, names))) < len(getattr(p, names)):
            refuse(f"{names} is {getattr(p, names)}; each may be there once")
    if not set(getattr(p, "MEASURED", ())) <= set(p.STATE_NAMES):
        refuse(f"MEASURED is {p.MEASURED}; it must be names of states")
    for each in ("GOAL_INDEX", "ANGLES"):
        found = getattr(p, each, [])
        whole = all(type(i) is int and 0 <= i < n_x for i in found)
        if not whole or len(set(found)) < len(found):
            refuse(f"{each} is {found}; it must be different indices of the {n_x} states")

    # arrays
    arrays = {each: (getattr(p, each), shape) for each, shape in SHAPES.items() if hasattr(p, each)}
    arrays |= {f"SCENARIOS[{k!r}]": (value, "*n_psi") for k, value in getattr(p, "SCENARIOS", {}).items()}
    arrays |= {f"GOALS[{k!r}]": (value, "n_goal") for k, value in getattr(p, "GOALS", {}).items()}
    if hasattr(p, "GOAL_REACHABLE"):
        ends = np.asarray(p.GOAL_REACHABLE)
        if ends.shape != (2, n_goal) or not (ends[0] <= ends[1]).all():  # nor is nan
            refuse(f"GOAL_REACHABLE is {ends.tolist()}; it must be {n_goal} lowest and as many highest goals")
    for each, (value, shape) in arrays.items():
        value, n, rows = np.asarray(value, dtype=float), sizes[shape.strip("*")], shape[0] == "*"
        if value.ndim != 1 + rows or value.shape[-1] != n or not len(value) and rows:
            refuse(f"{each} has shape {value.shape}; it must be {f'(any, {n})' if rows else (n,)}")
        if np.isnan(value).any() or not np.isfinite(value).all() and each not in MAY_BE_INFINITE:
            hint = "; give INIT_LOW and INIT_HIGH, where episodes start" * each.startswith("INIT")
            refuse(f"{each} is {value.tolist()}; it must be finite{hint}")

    # numbers
    for each in POSITIVE:
        value = np.asarray(getattr(p, each, 1.0))
        if value.ndim and each not in SHAPES or value.dtype.kind not in "iuf":
            refuse(f"{each} is {value.tolist()!r}; it must be a positive number")
        if not ((value > 0) & (value < np.inf)).all():
            hint = "; give it, or GOAL_LOW and GOAL_HIGH" if each == "ERROR_SCALE" else ""
            refuse(f"{each} is {value.tolist()}; it must be positive and finite{hint}")
    for each in WHOLE:
        value = getattr(p, each, 1)
        if not isinstance(value, (int, np.integer)) or value < 1:
            refuse(f"{each} is {value!r}; it must be a whole number of at least 1")

    # order
    inside = {"X": (), "U": (), "INIT": (), "OBS": ("INIT_LOW", "INIT_HIGH"), "PSI": ("PSI_NOMINAL",)}
    inside |= {"GOAL": ("EVAL_GOAL", "TRAIN_GOALS")}
    for box, names in inside.items():
        low, high = getattr(p, f"{box}_LOW", None), getattr(p, f"{box}_HIGH", None)
        if (low is None) != (high is None):
            refuse(f"{box}_LOW and {box}_HIGH belong together")
        if low is None:
            continue
        if (low > high).any() or box == "U" and (low == high).any():
            refuse(f"{box}_LOW is {low.tolist()}, {box}_HIGH {high.tolist()}; they are not in order")
        for each in filter(lambda each: hasattr(p, each), names):
            if not ((low <= getattr(p, each)) & (getattr(p, each) <= high)).all():
                found = getattr(p, each).tolist()
                refuse(
                    f"{each} {found} is not within {box}_LOW {low.tolist()} and {box}_HIGH {high.tolist()}"
                )

    # settings
    for each, known in KEYS.items():
        if not isinstance(getattr(p, each, {}), dict):
            refuse(f"{each} is {getattr(p, each)!r}; it must be a dict of {', '.join(known)}")
        unknown = set(getattr(p, each, {})) - set(known)
        if unknown:
            refuse(f"{each} has {', '.join(sorted(unknown))}; it takes {', '.join(known)}")
    for each in ("nominal", "mpc", "robust"):
        if each not in getattr(p, "SCENARIOS", [each]):
            refuse(f"SCENARIOS lacks {each!r}")


def _try_a_step(p):
    """From START with the middle action."""
    x, u, psi = (np.asarray(v, dtype=float) for v in (p.START, np.add(p.U_LOW, p.U_HIGH) / 2, p.PSI_NOMINAL))
    try:
        found = {"ode": np.asarray(p.ode(x, u, psi, np))} if hasattr(p, "ode") else {}
        found["step"] = np.asarray(p.step(x, u, psi))
    except Exception as error:  # whatever the plant's own equations raise
        raise ValueError(
            f"envs/{p.name}.py: a step from START fails ({type(error).__name__}: {error})"
        ) from error
    for each, value in found.items():
        if value.shape != x.shape or not np.isfinite(value).all():
            raise ValueError(
                f"envs/{p.name}.py: {each} at START gives {value.tolist()}; it must be {len(x)} finite numbers"
            )
