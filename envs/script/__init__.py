"""What a script does around its algorithm: checks of arguments, paired closed loops, tables, the figure of an episode, Ctrl-C."""
