"""Studies of what goes wrong in practice, for docs/stress.md."""
