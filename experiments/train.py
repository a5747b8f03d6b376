"""Train a constrained policy: `python experiments/train.py key=value ...`."""

from cnfp_torchrl.commands.train import main

if __name__ == "__main__":
    main()
