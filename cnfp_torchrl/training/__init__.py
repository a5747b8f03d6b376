"""Training and evaluation: collector, replay buffer, update, log."""
