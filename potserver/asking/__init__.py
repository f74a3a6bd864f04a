"""What may be asked of a map: each question checks its arguments and becomes a plan whose parts come from one snapshot."""
