"""The prior measured: the tables of docs/prior.md."""
