"""Training of the networks with Lightning; imported only by `g3r-pretrain`."""
