"""A script per study, in folders by what it is about; `reproduce.py` runs all of them, `common.py` is what they share.

    pendulum/    goal-conditioned MPC on the double pendulum
    linear/      random linear systems: scalability, and the learned value in MPC
    reactor/     agents and controllers of the reactor, an oracle, and what makes them good or bad
    speed/       times of solving and of training, beside the field's tools
    trust/       what happens when things go wrong

results/ holds the tables that they wrote, figures/ the figures, pretrained/ the critics that the repository ships.
"""
