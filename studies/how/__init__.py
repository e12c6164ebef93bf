"""Pictures of docs/how.md."""
