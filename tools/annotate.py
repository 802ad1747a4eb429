"""Annotate a demonstration: `python tools/annotate.py DEMO`, the same as `sart annotate DEMO`."""

import sys

from sart_toolkit.cli import main

if __name__ == "__main__":
    main(["annotate", *sys.argv[1:]])
