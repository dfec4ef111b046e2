"""The navigation task, its policy and its training."""
