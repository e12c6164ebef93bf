"""BIDS: from a data set with stacks and masks to a derivative data set, by one process of g3r-infer per session."""
