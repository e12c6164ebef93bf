"""BIDS: stacks and masks of a data set in, a derivative data set out, one process of g3r-infer for each session."""
