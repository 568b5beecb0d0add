"""Training options: how an option is declared, and the groups that make a `TrainConfig`."""
