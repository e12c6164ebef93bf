"""Unseen parts of a head: the tables of docs/unseen.md."""
