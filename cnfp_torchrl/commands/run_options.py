"""What commands that read runs have in common on their command lines: `argparse`'s ``parents``."""

import argparse

TRUSTED = argparse.ArgumentParser(add_help=False)
TRUSTED.add_argument(
    "--trusted",
    action="append",
    default=[],
    metavar="PACKAGE",
    help="that a run's configuration may name beside this one, such as my_package.",
)

FINISHED_RUN = argparse.ArgumentParser(add_help=False, parents=[TRUSTED])
FINISHED_RUN.add_argument("run", help="folder of a finished run")
FINISHED_RUN.add_argument(
    "--checkpoint",
    default="checkpoint.pt",
    help="of the run (%(default)s), or best.pt: its best policy during training",
)
