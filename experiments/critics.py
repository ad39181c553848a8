"""The critics that the repository ships: each is trained by the command that stands in its pretrained/NAME.txt.

    python experiments/critics.py                         # all of them; continues where it stopped
    python experiments/critics.py --critic cstr_robust    # one of them

Studies that train the same agent find it under --runs. Writes pretrained/NAME.pt.
"""

import shutil
import sys
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from experiments import common
from experiments.common import HERE, PLANNER, TRAINING

CRITICS = {  # script, its arguments
    "cstr_robust": (TRAINING, dict()),
    "cstr_nominal": (TRAINING, dict(scenarios="nominal")),
    "cstr_constrained": (TRAINING, dict(constraint_weight=3.0)),
    "cstr_offset_free": (TRAINING, dict(observe_mismatch=True, scenario_hold="episode")),
    "linear_robust": (TRAINING, dict(env="linear", dim=32, system=0)),
    "double_pendulum_planner": (PLANNER, dict()),
}
QUICK = {TRAINING: dict(total_timesteps=2000, hidden=(16, 16)), PLANNER: common.QUICK_PLANNER}


@dataclass(frozen=True)
class Args:
    critic: tuple[str, ...] = tuple(CRITICS)
    """which of them"""
    quick: bool = False
    """a smoke test on tiny budgets; without --out it writes to runs/quick"""
    out: Path = HERE
    """folder whose pretrained/ is written"""
    runs: Path = Path("runs/experiments")
    """where trained agents are kept"""


def main(args):
    for name in args.critic:
        if name not in CRITICS:
            common.fail(f"--critic {name} is none; choose from {', '.join(CRITICS)}")
        script, settings = CRITICS[name]
        settings = settings | (QUICK[script] if args.quick else {})
        (folder,) = common.train([settings], args.runs, 1, script=script)
        target = args.out / f"pretrained/{name}.pt"
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(folder / "checkpoint.pt", target.with_suffix(".part"))
        target.with_suffix(".part").replace(target)


if __name__ == "__main__":
    common.command_line(main, Args, __doc__)
