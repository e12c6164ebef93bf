"""Pictures of docs/report.md."""
