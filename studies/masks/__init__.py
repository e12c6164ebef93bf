"""What docs/masks.md shows: how good the automatic brain masks are."""
