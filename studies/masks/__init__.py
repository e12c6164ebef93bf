"""Quality of the automatic brain masks: the tables of docs/masks.md."""
