"""A scenario tree and its quadratic program (c/tree_qp.c says which), by HPIPM from the CasADi wheel or by a solver of CasADi's `conic`."""

import ctypes
import re
import subprocess
import sys

import casadi as ca
import numpy as np

from envs.control.compiled import C_SOURCES, WHEEL, compiled

TOLERANCE, MOST_ITERATIONS = 1e-9, 60
RIDGE = 1e-8  # on du, that of c/tree_qp.c
OUT_OF_REACH = 1e3  # half-widths of the box of initial states
MAX_NODES = 20_000


class ScenarioTree:
    """Nodes of a tree over S scenarios that branches at the first `robust_horizon` stages, numbered stage by stage.

    nodes: how many per stage 0 ... horizon; first: the number of each stage's first node; inner: how many have children.
    stage, parent (of the root: -1), scenario (on the way from the parent): of every node. child: of every node, under the first scenario
    where the tree branches; of a leaf itself. later: which node's action each node with children takes over one sampling time later, its
    child's; in the last stage its own.
    """

    def __init__(self, scenarios, horizon, robust_horizon):
        whole = all(isinstance(number, (int, np.integer)) for number in (horizon, robust_horizon))
        if not whole or horizon < 1 or robust_horizon < 0:
            raise ValueError(
                f"horizon is {horizon!r}, robust_horizon {robust_horizon!r}; they must be whole and at least 1 and 0"
            )
        leaves = scenarios ** min(robust_horizon, horizon)
        if leaves * horizon > MAX_NODES:
            raise ValueError(
                f"a robust horizon of {robust_horizon} gives {leaves} leaves; leaves times horizon may be {MAX_NODES} at most"
            )
        self.nodes = [scenarios ** min(t, robust_horizon) for t in range(horizon + 1)]
        self.first = np.cumsum([0, *self.nodes])
        self.inner = int(self.first[horizon])
        self.stage = np.repeat(np.arange(horizon + 1), self.nodes)
        self.parent, self.scenario = np.full(len(self.stage), -1), np.zeros(len(self.stage), dtype=int)
        # at each branching; S where none yet
        self.history = np.full((len(self.stage), max(robust_horizon, 1)), scenarios)
        for node in range(1, len(self.stage)):
            t, order = self.stage[node], node - self.first[self.stage[node]]
            branching = t <= robust_horizon
            self.parent[node] = self.first[t - 1] + (order // scenarios if branching else order)
            self.history[node] = self.history[self.parent[node]]
            self.scenario[node] = order % scenarios
            if branching:
                self.history[node, t - 1] = self.scenario[node]
        self.child = np.arange(len(self.stage))
        self.child[self.parent[:0:-1]] = np.arange(len(self.stage) - 1, 0, -1)
        self.later = np.where(self.child < self.inner, self.child, np.arange(len(self.stage)))[: self.inner]

    def by_stage(self, x, u):
        """Lists over stages: of x (nodes - 1, n_x), x_1 ... x_N as (n_x, nodes); of u (inner, n_u), u_0 ... u_{N-1} as (n_u, nodes)."""
        first = self.first[1:-1]
        return {
            "x": [part.T for part in np.split(x, first[1:] - 1)],
            "u": [part.T for part in np.split(u, first[:-1])],
        }

    def weights(self, weight):
        """Weight of every node from those of the scenarios (S,); the weights of a stage sum to one."""
        return np.append(weight, 1.0)[self.history].prod(axis=1)


def tree_qp(tree, n_x, n_u, active, changes, compile=True):
    """A `TreeQP`, or where that cannot be compiled or shall not be a `ConicQP`.

    active: (2, n_x), which states have a bound below and above; changes: whether a change of the actions has a price.
    """
    if compile:
        try:
            return TreeQP(tree, n_x, n_u, active, changes)
        except (OSError, subprocess.CalledProcessError) as error:
            print(
                f"notice: the quadratic programs go to PIQP, several times slower ({error})", file=sys.stderr
            )
    return ConicQP(tree, n_x, n_u, active, changes)


def pointer(array):
    return ctypes.c_void_p(array.ctypes.data)


class Shape(ctypes.Structure):
    """`tree_qp_shape` of tree_qp.h."""

    _fields_ = [(name, ctypes.c_int) for name in ("nodes", "inner", "nx", "nu", "rows", "changes")]
    _fields_ += [(name, ctypes.c_void_p) for name in ("parent", "stage", "row")]
    _fields_ += [("tolerance", ctypes.c_double), ("most", ctypes.c_int)]


class TreeQP:
    """HPIPM's tree solver (BSD licence), one instance with memory of its own.

    `solve` takes arrays with a row per edge (A, B, slope, hessian, x_low, x_high, price (edges, 2, rows)) or per node with children
    (u_low, u_high, change, moved), A, B and hessian transposed as CasADi stores them. It returns du (inner, n_u) and the cost there, or
    (None, nan) if the problem is not solved. `iterations`: of the last solve.
    `multipliers()` of the last solve: how the cost changes with the states of stage 1, (nodes of stage 1, n_x).
    """

    def __init__(self, tree, n_x, n_u, active, changes):
        sources = [(C_SOURCES / name).read_text() for name in ("real.h", "tree_qp.h", "tree_qp.c")]
        search = [f"-L{WHEEL}", "-lhpipm", "-lblasfeo", "-lm", f"-Wl,-rpath,{WHEEL}"]
        whole = re.sub(r'#include ".*"', "", "".join(sources))
        self.library = ctypes.CDLL(str(compiled(whole, f"-I{WHEEL / 'include'}", link=search)))
        self.library.tree_qp_size.restype = ctypes.c_size_t
        self.library.tree_qp_init.restype = ctypes.c_void_p
        self.row = np.flatnonzero(active.any(axis=0)).astype(np.int32)
        self.active = active[:, self.row]
        arrays = [
            np.ascontiguousarray(array, dtype=np.int32) for array in (tree.parent, tree.stage, self.row)
        ]
        sizes = map(int, (len(tree.parent), tree.inner, n_x, n_u, len(self.row), changes))
        shape = Shape(*sizes, *map(pointer, arrays), TOLERANCE, MOST_ITERATIONS)
        memory = np.empty(self.library.tree_qp_size(ctypes.byref(shape)), dtype=np.uint8)
        self.instance = ctypes.c_void_p(self.library.tree_qp_init(pointer(memory), ctypes.byref(shape)))
        self.kept = memory, arrays  # which the instance points to
        # what `solve` takes, in memory that stays where it is
        edges, rows, inner = len(tree.parent) - 1, len(self.row), (tree.inner, n_u)
        shapes = [(edges, n_x * n_x), (edges, n_x * n_u), (edges, n_x), (edges, n_x * n_x), inner, inner]
        shapes += [(edges, rows), (edges, rows), (edges, 2, rows), inner, inner]
        self.given, self.du = list(map(np.zeros, shapes)), np.zeros(inner)
        self.cost, self.counted = ctypes.c_double(), ctypes.c_int()
        self.memory, self.early = list(map(pointer, self.given)), tree.nodes[1]
        self.found = pointer(self.du), ctypes.byref(self.cost), ctypes.byref(self.counted)

    @property
    def iterations(self):
        return self.counted.value

    def solve(self, A, B, slope, hessian, u_low, u_high, x_low, x_high, price, change, moved, barrier):
        bounds = two_sided(self.active, x_low, x_high, price)
        for kept, value in zip(self.given, (A, B, slope, hessian, u_low, u_high, *bounds, change, moved)):
            kept[...] = np.reshape(value, kept.shape)
        status = self.library.tree_qp_solve(
            self.instance, *self.memory, ctypes.c_double(barrier), *self.found
        )
        solved = status == 0 and np.isfinite(self.du).all()
        return (self.du, self.cost.value) if solved else (None, np.nan)

    def multipliers(self):
        found = np.zeros((self.early, self.given[2].shape[1]))
        self.library.tree_qp_multipliers(self.instance, pointer(found))
        return found


def two_sided(active, x_low, x_high, price):
    """Bounds and prices with one out of reach, at the other's price, where there is none: solvers with masks or infinities do worse."""
    if active.all():
        return x_low, x_high, price
    low = np.where(active[0], x_low, np.minimum(x_high, 0) - OUT_OF_REACH)
    high = np.where(active[1], x_high, np.maximum(x_low, 0) + OUT_OF_REACH)
    return low, high, np.where(active, price, np.asarray(price)[:, ::-1])


def positive_part(hessian):
    """Projection of symmetric matrices (..., n, n) to positive semidefinite ones."""
    values, vectors = np.linalg.eigh((hessian + np.swapaxes(hessian, -1, -2)) / 2)
    return (vectors * np.maximum(values, 0)[..., None, :]) @ np.swapaxes(vectors, -1, -2)


class ConicQP:
    """The same by a solver of CasADi's `conic`, as one sparse problem in (dx, du, slack below, slack above)."""

    def __init__(self, tree, n_x, n_u, active, changes, plugin="piqp", options=None):
        parent, inner = tree.parent, tree.inner
        edges, self.row, self.iterations = len(parent) - 1, np.flatnonzero(active.any(axis=0)), 0
        rows = len(self.row)
        sizes = {"A": (n_x, n_x * edges), "B": (n_x, n_u * edges), "slope": (n_x, edges)}
        sizes |= {"hessian": (n_x, n_x * edges), "price": (2 * rows, edges)}
        sizes |= {"change": (n_u, inner), "moved": (n_u, inner)}
        p = {name: ca.MX.sym(name, *size) for name, size in sizes.items()}
        dx, du = ca.MX.sym("dx", n_x, edges), ca.MX.sym("du", n_u, inner)
        below, above = ca.MX.sym("below", rows, edges), ca.MX.sym("above", rows, edges)
        f, dynamics = ca.dot(p["price"], ca.vertcat(below, above)) + RIDGE / 2 * ca.sumsqr(du), []
        for e, before in enumerate(parent[1:]):
            A, B, hessian = (
                p[name][:, e * k : (e + 1) * k] for name, k in (("A", n_x), ("B", n_u), ("hessian", n_x))
            )
            f += ca.dot(p["slope"][:, e], dx[:, e]) + ca.bilin(hessian, dx[:, e], dx[:, e]) / 2
            dynamics.append(dx[:, e] - B @ du[:, int(before)] - (A @ dx[:, int(before) - 1] if before else 0))
        for i in range(inner):
            step = du[:, i] - (du[:, int(parent[i])] if i else 0)
            f += ca.dot(p["change"][:, i], step**2 + 2 * p["moved"][:, i] * step)
        bounded = dx[self.row.tolist(), :]
        problem = {
            "x": ca.veccat(dx, du, below, above),
            "p": ca.veccat(*p.values()),
            "f": f,
            "g": ca.veccat(*dynamics, bounded + below, bounded - above),
        }
        quiet = {"highs": {"highs": {"output_flag": False}}, "qpoases": {"printLevel": "none"}}.get(
            plugin, {}
        )
        self.solver = ca.qpsol("qp", plugin, problem, quiet | {"error_on_fail": False} | (options or {}))
        self.active = active[:, self.row]
        self.square, self.early = (edges, n_x, n_x), tree.nodes[1]
        self.zeros, self.shape, self.at = np.zeros(edges * n_x), (inner, n_u), edges * n_x

    def solve(self, A, B, slope, hessian, u_low, u_high, x_low, x_high, price, change, moved, barrier=None):
        low, high, price = (np.ravel(a) for a in two_sided(self.active, x_low, x_high, price))
        none, slack = np.full(low.size, np.inf), np.zeros(2 * low.size)
        found = self.solver(
            p=np.concatenate(
                [
                    np.ravel(a)
                    for a in (
                        A,
                        B,
                        slope,
                        positive_part(np.reshape(hessian, self.square)),
                        price,
                        change,
                        moved,
                    )
                ]
            ),
            lbg=np.concatenate([self.zeros, low, -none]),
            ubg=np.concatenate([self.zeros, none, high]),
            lbx=np.concatenate([self.zeros - np.inf, np.ravel(u_low), slack]),
            ubx=np.concatenate([self.zeros + np.inf, np.ravel(u_high), slack + np.inf]),
        )
        du = np.array(found["x"]).ravel()[self.at :][: u_low.size].reshape(self.shape)
        self.early_multipliers = -np.array(found["lam_g"]).ravel()[: self.early * self.square[1]]
        if not self.solver.stats()["success"] or not np.isfinite(du).all():
            return None, np.nan
        return du, float(found["f"])

    def multipliers(self):
        return self.early_multipliers.reshape(self.early, -1)
