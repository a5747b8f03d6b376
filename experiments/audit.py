"""Audit the geometry of an environment: `python experiments/audit.py key=value ...`."""

from cnfp_torchrl.commands.audit import main

if __name__ == "__main__":
    main()
