"""Studies of faults that occur in practice: docs/stress.md."""
