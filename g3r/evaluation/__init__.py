"""How good a reconstruction is, given the truth: image scores, rigid alignment, pose error."""
