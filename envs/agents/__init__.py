"""What a trained agent is beside its networks: scaling, checkpoint files, evaluation."""
