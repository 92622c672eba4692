"""The experiments that compare neighbor searches: run with `python -m experiments`. Nothing imports this package."""
