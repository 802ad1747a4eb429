"""`python -m sart_toolkit`: the same as `sart`."""

from sart_toolkit.cli import main

if __name__ == "__main__":
    main()
