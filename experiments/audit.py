"""Audit the geometry of an environment: `python experiments/audit.py key=value ...`."""

from cnfp_torchrl.commands.console import audit

if __name__ == "__main__":
    audit()
