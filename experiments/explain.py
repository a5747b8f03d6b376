"""Explain one step of a run: `python experiments/explain.py RUN --step N`."""

from cnfp_torchrl.commands.explain import main

if __name__ == "__main__":
    main()
