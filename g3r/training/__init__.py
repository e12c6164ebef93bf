"""Training of the networks with Lightning; imported by `g3r-pretrain` alone."""
