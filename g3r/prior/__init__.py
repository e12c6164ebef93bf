"""The density-gated prior network (DGPN, G3R Sec. 2.3): gate, network and inference."""
