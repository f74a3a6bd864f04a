"""How good maps are, scan by scan, on beams that they never saw: one protocol for ours and for its peers."""
