"""What the scripts share beside the plants: compiled solvers, the figure of an episode, and a critic's second derivatives."""
