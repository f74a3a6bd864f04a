"""Atoms: how they are learned, chosen, admitted and kept."""
