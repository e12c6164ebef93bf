"""Cost of a cohort: docs/cohort.md."""
