"""The nouns: scans, kernels, atoms, and the map that is made of them. Frozen, numpy inside."""
