"""Errors at the extremes: the tables of docs/numerics.md."""
