"""The field's tasks: training runs, their records and what they show."""
