"""What docs/unseen.md shows: parts of a head that no slice saw."""
