"""Quality of a reconstruction against the truth or a held-out stack: image scores, rigid alignment, pose error."""
