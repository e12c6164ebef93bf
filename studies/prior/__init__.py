"""Accuracy of the prior: the tables of docs/prior.md."""
