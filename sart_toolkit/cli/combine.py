"""`sart merge` and `sart split`."""

from __future__ import annotations

from typing import Any

from sart_toolkit import pipeline
from sart_toolkit.cli.arguments import Merge, Split
from sart_toolkit.cli.console import ProgressDisplay
from sart_toolkit.cli.info import describe_dataset
from sart_toolkit.errors import InvalidInput


def merge_verb(args: Merge) -> dict[str, Any]:
    """`sart merge`."""
    with ProgressDisplay() as progress:
        dataset = pipeline.merge(
            args.datasets, args.out, overwrite=args.overwrite, progress=progress
        )
    return {"dataset": str(args.out), **describe_dataset(dataset)}


def split_verb(args: Split) -> dict[str, Any]:
    """`sart split`."""
    parts = None if args.parts is None else _fractions(args.parts)
    with ProgressDisplay() as progress:
        found = pipeline.split(
            args.dataset,
            args.out,
            parts=parts,
            n=args.n,
            by_source=args.by_source,
            seed=args.seed,
            overwrite=args.overwrite,
            progress=progress,
        )
    return {str(args.out / name): describe_dataset(dataset) for name, dataset in found.items()}


def _fractions(text: str) -> dict[str, float]:
    """Fractions by name, from NAME=FRACTION,...

    Raises:
        InvalidInput: it is something else, or has a name twice.
    """
    found: dict[str, float] = {}
    for word in text.split(","):
        name, _, number = word.partition("=")
        try:
            found[name] = float(number)
        except ValueError:
            raise InvalidInput(
                f"parts: expected NAME=FRACTION,... such as train=0.8,validation=0.2, got {word!r}"
            ) from None
    if len(found) < text.count(",") + 1:
        raise InvalidInput(f"parts: a name is there twice in {text!r}; give each its own")
    return found
