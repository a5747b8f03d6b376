"""Evaluate a trained run: `python experiments/evaluate.py key=value ...`."""

from cnfp_torchrl.commands.console import evaluate

if __name__ == "__main__":
    evaluate()
