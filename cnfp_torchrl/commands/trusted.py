"""The option ``--trusted`` of commands that read runs, for `argparse`'s ``parents``."""

import argparse

TRUSTED = argparse.ArgumentParser(add_help=False)
TRUSTED.add_argument(
    "--trusted",
    action="append",
    default=[],
    metavar="PACKAGE",
    help="that a run's configuration may name beside this one, such as my_package.",
)
