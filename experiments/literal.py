"""The optimal control problem as eq:QMPC is printed, and with the conventions of do-mpc on top, for comparison with the authors' stack."""

import sys
from pathlib import Path

import casadi as ca
import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent))
import rl_mpc_deploy as deploy


class PrintedMPC(deploy.ScenarioMPC):
    """eq:QMPC as printed: stage cost and soft constraints at x_0 ... x_{N-1}, so that nothing bounds the last state but its value."""

    def node_cost(self, t, x, goal, slack_cost, mismatch=None):
        n = x.shape[1]
        if t < self.horizon:
            return ca.sum2(slack_cost + self.stage_cost.map(n)(x, goal)) / n
        return ca.sum2(self.terminal_cost.map(n)(x, goal)) / n

    def _bounds(self, price):
        bounds = super()._bounds(price)
        soft = (price > 0) & ~np.isinf(price)  # where the last node's constraint is soft, it is not there
        for name, bound, no_bound, p in (("below", "lbg", -np.inf, soft[0]), ("above", "ubg", np.inf, soft[1])):
            self.block(bounds["ubx"], name, self.horizon)[p] = 0.0
            self.block(bounds[bound], "box", self.horizon)[p] = no_bound
        return bounds


class LiteralMPC(PrintedMPC):
    """The same with slack summed over scenarios instead of averaged.

    With N = 1 every term of the terminal cost sees the state under the first scenario, as in do-mpc (read in its source, 4.6.5 to 5.1.2).
    """

    def node_cost(self, t, x, goal, slack_cost, mismatch=None):
        n = x.shape[1]
        if t == self.horizon == 1:
            return self.terminal_cost(x[:, 0], goal[:, 0])
        return super().node_cost(t, x, goal, n * slack_cost)
