"""What a cohort costs: docs/cohort.md."""
