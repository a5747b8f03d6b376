"""Explain one step of a run: `python experiments/explain.py RUN --step N`."""

from cnfp_torchrl.commands.console import explain

if __name__ == "__main__":
    explain()
