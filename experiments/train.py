"""Train a constrained policy: `python experiments/train.py key=value ...`."""

from cnfp_torchrl.commands.console import train

if __name__ == "__main__":
    train()
