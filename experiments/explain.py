"""Explain one step of a run: `python experiments/explain.py RUN --step N`."""

from cnfp_torchrl.visual.explain_run import main

if __name__ == "__main__":
    main()
