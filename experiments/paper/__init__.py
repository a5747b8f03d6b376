"""The experiment of the paper: runs, kept data, statistics, figures and report."""
