"""Evaluate a trained run: `python experiments/evaluate.py key=value ...`."""

from cnfp_torchrl.commands.evaluate import main

if __name__ == "__main__":
    main()
