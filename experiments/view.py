"""Open the newest recording in a viewer: `python experiments/view.py [FILE or FOLDER] [--web]`."""

from cnfp_torchrl.visual.stream.view import main

if __name__ == "__main__":
    main()
