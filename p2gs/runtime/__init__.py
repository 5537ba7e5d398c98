"""Runs the stages in order: what each needs and hands over, keys, training, resuming."""
