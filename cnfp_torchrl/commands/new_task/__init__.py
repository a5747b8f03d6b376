"""A task with a constraint on its actions: environment, judge and geometry."""
